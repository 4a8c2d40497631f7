"""What all impairments of the signals have in common, and their nuisance parameters together."""

import numpy as np
import pytest
from impairment_checks import CHECKS

from rhs_isac_ros.model import Linear, MeasurementModel, Scenario
from rhs_isac_ros.model.impairments import BUILT_IN, Nuisance, draw_factors, nuisance_of

# A new impairment needs a strength here, and no other test.
BUILT_IN_STRENGTHS = {
    'user_gain_std_db': 2.0, 'carrier_offset_std_hz': 700.0, 'phase_std_rad': 0.4,
    'timing_std_s': 30e-9, 'band_phase_std_rad': 0.4}
# Phases of the frames that follow a random walk, whose prior covariance is a full matrix.
WALK = '''
import numpy as np
from rhs_isac_ros.model import Impairment, Linear

class Walk(Impairment):
    def __init__(self, strength):
        self.strength = strength

    def size(self, scenario):
        return scenario.n_frames

    def linear(self, scenario):
        n = scenario.n_frames
        frames = 1j * np.tile(np.eye(n), scenario.n_subbands)[:, None]
        return Linear(np.repeat(frames, scenario.n_bands, axis=1),
                      self.strength * np.tri(n))
'''


@pytest.fixture(scope='module')
def uncertain() -> Scenario:
    return Scenario(**BUILT_IN_STRENGTHS)


@pytest.mark.parametrize('check', CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize('field', [one.field for one in BUILT_IN])
def test_every_built_in_impairment(field, check):
    check({field: BUILT_IN_STRENGTHS[field]})


@pytest.mark.parametrize('check', CHECKS, ids=lambda check: check.__name__)
def test_an_impairment_of_another_package(install, check):
    install('random_walk', WALK, {'rhs_isac_ros.impairments': {'random_walk': 'Walk'}})
    check({'impairments': {'random_walk': 0.1}})


def test_table_1_has_no_nuisance_parameters(table1):
    nuisance = nuisance_of(table1.scenario)
    assert len(nuisance) == 0
    assert nuisance.patterns.shape == nuisance.scaled_patterns.shape == (0, 2, 32)
    assert nuisance.phases.shape == nuisance.scaled_phases.shape == (2, 0)
    np.testing.assert_array_equal(nuisance.factors(np.zeros((3, 0))), np.ones((3, 2, 32)))
    rng = np.random.default_rng(0)
    assert draw_factors(table1.scenario, 5, rng, rng) is None


def test_impairments_are_independent_of_each_other(table1):
    patterns = np.random.default_rng(0).normal(size=(3, 2, 32)) * 1j
    roots = np.array([[2.0, 0.0], [1.0, 3.0]]), np.array([[0.5]])
    nuisance = Nuisance(table1.scenario, [
        Linear(patterns[:2], roots[0], needs_search=True), Linear(patterns[2:], roots[1])])
    assert len(nuisance) == 3
    np.testing.assert_array_equal(nuisance.needs_search, [True, True, False])
    np.testing.assert_allclose(nuisance.scaled_patterns, np.stack(
        [2 * patterns[0] + patterns[1], 3 * patterns[1], 0.5 * patterns[2]]))
    white = np.random.default_rng(1).normal(size=3)
    values = np.concatenate([roots[0] @ white[:2], roots[1] @ white[2:]])
    np.testing.assert_allclose(
        nuisance.factors(values), np.exp(np.tensordot(white, nuisance.scaled_patterns, axes=1)))


def test_arrays_are_read_only(uncertain):
    nuisance = nuisance_of(uncertain)
    for array in (nuisance.patterns, nuisance.scaled_patterns, nuisance.phases):
        with pytest.raises(ValueError, match='read-only'):
            array[..., 0] = 1


def test_directions_of_the_mean_match_finite_differences(uncertain, shipped):
    """Per standard normal number, as the bounds use them."""
    nuisance = nuisance_of(uncertain)
    stds = np.concatenate([np.diag(one.linear(uncertain).root) for one in BUILT_IN])
    mean = MeasurementModel(uncertain, shipped).mean(
        uncertain.sample_positions(3, np.random.default_rng(1)))
    directions = nuisance.scaled_patterns * mean[:, None]
    for index in range(len(nuisance)):
        step = stds * (1e-4 * np.eye(len(nuisance))[index])
        numeric = (nuisance.factors(step) - nuisance.factors(-step)) * mean / 2e-4
        np.testing.assert_allclose(
            directions[:, index], numeric, atol=1e-6 * np.abs(numeric).max())


def test_parameters_that_move_the_multipath_change_measurements_of_a_band(uncertain):
    np.testing.assert_array_equal(
        nuisance_of(uncertain).moves_multipath, [False, True, False, True, False, False])


def test_only_parameters_that_turn_whole_bands_have_phases(uncertain):
    np.testing.assert_array_equal(
        nuisance_of(uncertain).phases, [[0, 0, 0.4, 0, 0.4, 0], [0, 0, 0.4, 0, 0, 0.4]])


def test_moves_and_phases_refer_to_standard_normal_numbers(install):
    """The first change of a random walk turns all frames alike, and each later one only some."""
    install('walk_of_phases', WALK, {'rhs_isac_ros.impairments': {'walk_of_phases': 'Walk'}})
    nuisance = nuisance_of(Scenario(impairments={'walk_of_phases': 0.1}))
    np.testing.assert_array_equal(nuisance.moves_multipath, [False, True, True, True])
    np.testing.assert_allclose(nuisance.phases, 0.1 * np.array([[1, 0, 0, 0]] * 2))


def test_scaled_phases_have_a_column_for_each_phase():
    assert nuisance_of(Scenario(timing_std_s=1e-8)).scaled_phases.shape == (2, 0)
    np.testing.assert_array_equal(
        nuisance_of(Scenario(phase_std_rad=0.3)).scaled_phases, [[0.3], [0.3]])
    np.testing.assert_array_equal(
        nuisance_of(Scenario(phase_std_rad=0.3, band_phase_std_rad=0.5)).scaled_phases,
        [[0.3, 0.5, 0.0], [0.3, 0.0, 0.5]])
