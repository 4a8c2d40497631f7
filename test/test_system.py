"""A system: its parts, its file, and the pairs of positions and signals that it simulates."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from rhs_isac_ros.bounds import crlb, crlb_of
from rhs_isac_ros.calibration import Calibration, known_states
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.link import choose_beam, steer
from rhs_isac_ros.model import MeasurementModel, Scenario, draw_surface
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.system import System

CONFIG = Path(__file__).parents[1] / 'config'
LAB = {'scenario': 'lab.yaml', 'codebook': 'codebook_lab.yaml', 'calibration': 'lab_states.npz'}


@pytest.fixture(scope='module')
def setting(random_beams):
    scenario = Scenario(n_subbands=2, n_frames=2, elements_per_side=3, n_feeds=2)
    return scenario, random_beams(scenario, np.random.default_rng(0))


@pytest.fixture
def written(tmp_path):
    """Function that writes the file of the lab with changes, and returns its path."""
    def write(**changes):
        content = {name: str(CONFIG / file) for name, file in LAB.items()} | changes
        path = tmp_path / 'system.yaml'
        path.write_text(yaml.safe_dump({name: file for name, file in content.items() if file}))
        return path
    return write


def test_a_system_has_the_signals_and_the_bound_of_its_parts(setting):
    system, positions = System(*setting), np.array([[8.0, 1.0, 0.2], [14.0, -4.0, -0.9]])
    np.testing.assert_array_equal(system.crlb(positions), crlb(*setting, positions))
    drawn, expected = (model.sample(positions, np.random.default_rng(1))
                       for model in (system, MeasurementModel(*setting)))
    np.testing.assert_array_equal(drawn, expected)


def test_a_known_surface_belongs_to_the_model(small):
    surface = draw_surface(
        Scenario(**small.scenario.changes() | {'element_error_rms': 0.1}),
        np.random.default_rng(1))
    parts, positions = (small.scenario, small.codebook, surface), np.array([[8.0, 1.0, 0.2]])
    np.testing.assert_array_equal(
        System(*parts).crlb(positions), crlb_of(MeasurementModel(*parts), positions))


def test_beams_are_those_for_the_coefficients_of_an_estimated_surface(small):
    scenario, place = small.scenario, np.array([8.0, 1.0, 0.2])
    n = scenario.n_elements
    estimate = SurfaceEstimate(np.exp(1j * np.arange(n)), np.zeros(n), np.ones(scenario.n_bands),
                               np.zeros((2 * n + scenario.n_bands, 0)), np.zeros(n))
    for surface in (None, estimate):
        system = System(scenario, small.codebook, surface)
        np.testing.assert_array_equal(
            system.steer(place).analog, steer(scenario, place, 0, surface).analog)
        assert system.choose_beam(place, np.eye(3)).expected_bps == choose_beam(
            scenario, place, np.eye(3), surface=surface).expected_bps
    drawn = draw_surface(
        Scenario(**scenario.changes() | {'element_error_rms': 0.1}), np.random.default_rng(1))
    with pytest.raises(ValueError, match='surface: known errors of elements, expected an estim'):
        System(scenario, small.codebook, drawn).steer(place)


def test_a_codebook_of_other_sizes_is_named(setting, small):
    with pytest.raises(CodebookError, match=f'codebook {small.codebook.id}: analog: shape'):
        System(setting[0], small.codebook)


def test_an_argument_of_another_class_is_named(setting):
    scenario, codebook = setting
    system = System(scenario, codebook)
    with pytest.raises(TypeError, match='^scenario: System, expected a Scenario'):
        make_estimator('bayes', system, codebook)
    calibration = known_states(scenario, 0, 1)
    with pytest.raises(TypeError, match='^surface: Calibration, expected the surface of a Cal'):
        System(scenario, codebook, calibration)
    assert System(scenario, codebook, calibration.surface).surface is calibration.surface


def test_a_file_names_scenario_codebook_and_calibration(written):
    system = System.from_yaml(written())
    assert system.scenario == Scenario.from_yaml(CONFIG / 'lab.yaml')
    assert system.codebook.id == Codebook.load(CONFIG / 'codebook_lab.yaml').id
    assert system.surface.id == Calibration.load(CONFIG / 'lab_states.npz').surface.id
    assert System.from_yaml(written(calibration=None)).surface is None


@pytest.mark.parametrize(('changes', 'message'), [
    ({'codebook': None}, "system.yaml: .* expected the keys"),
    ({'place': 'x'}, "system.yaml: .*place.* expected the keys"),
    ({'codebook': str(CONFIG / 'codebook.yaml')}, 'config/codebook.yaml: analog: shape'),
    ({'scenario': str(CONFIG / 'quick.yaml')}, 'lab_states.npz: scenario_id: '),
    ({'scenario': 'none.yaml'}, 'none.yaml: cannot be read'),
    ({'scenario': 3}, 'system.yaml: unsupported operand'),
])
def test_an_invalid_file_is_named(written, changes, message):
    with pytest.raises(ValueError, match=message):
        System.from_yaml(written(**changes))


def test_a_sequence_is_the_same_however_it_is_divided(setting):
    positions, received = System(*setting).pairs(1500, 3)
    for size in (1, 400, 512, 700):
        parts = [System(*setting).pairs(min(size, 1500 - first), 3, first)
                 for first in range(0, 1500, size)[:3]]
        for whole, part in zip((positions, received), zip(*parts, strict=True), strict=True):
            part = np.concatenate(part)
            assert part.tobytes() == whole[:len(part)].tobytes()


def test_pairs_do_not_change_between_versions(setting):
    """The expected positions are the first draws of NumPy's generator."""
    scenario = setting[0]
    rng = np.random.default_rng([11, 10, 0])
    expected = rng.uniform(*scenario.roi_bounds_m, (512, 3))
    np.testing.assert_array_equal(System(*setting).pairs(5, 11)[0], expected[:5])


def test_seeds_and_chunks_give_different_pairs(setting):
    first, second = System(*setting).pairs(1024, 0)[0], System(*setting).pairs(1024, 1)[0]
    assert len(np.unique(np.concatenate([first, second]), axis=0)) == 2048


def test_signals_are_those_of_the_positions(setting):
    model, (positions, received) = MeasurementModel(*setting), System(*setting).pairs(512, 0)
    white = model.whiten(received - model.mean(positions))
    # The standard deviation of the mean of 4096 squares is 0.016.
    assert np.mean(np.abs(white)**2) == pytest.approx(1, abs=0.065)


@pytest.mark.parametrize(('arguments', 'message'), [
    ((-1, 0), 'n: -1, expected at least 0'), ((1, -2), 'seed: -2'), ((1, 0, -3), 'first: -3')])
def test_negative_numbers_are_errors(setting, arguments, message):
    with pytest.raises(ValueError, match=message):
        System(*setting).pairs(*arguments)


def test_no_pairs_are_empty_and_another_codebook_is_an_error(setting, small):
    positions, received = System(*setting).pairs(0, 0)
    assert (positions.shape, received.shape) == ((0, 3), (0, 2, 4))
    with pytest.raises(CodebookError):
        System(setting[0], small.codebook).pairs(1, 0)
