"""Calibration files."""

import dataclasses
import json

import numpy as np
import pytest

from rhs_isac_ros.calibration import (
    Calibration,
    CalibrationError,
    calibrate,
    known_states,
    load_surface,
)
from rhs_isac_ros.calibration.calibration import report
from rhs_isac_ros.model import PathChannel, Scenario


@pytest.fixture(scope='module')
def calibration(scenario, beams, damaged, send):
    return calibrate(scenario, [send(scenario, beams, damaged(3), 20)])


@pytest.fixture
def file(calibration, tmp_path):
    calibration.save(tmp_path / 'calibration.npz')
    return tmp_path / 'calibration.npz'


def rewrite(file, **changes):
    """Change arrays of a file; None removes one."""
    with np.load(file) as archive:
        arrays = dict(archive) | changes
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})


def test_a_file_holds_the_whole_calibration(calibration, file, scenario, beams):
    loaded = Calibration.load(file)
    assert loaded.id == calibration.id
    assert (loaded.scenario_id, loaded.about) == (scenario.id, calibration.about)
    assert loaded.about['pilots'] == 20
    assert loaded.about['converged'] and loaded.about['rounds'] < 20
    assert loaded.about['codebooks'] == [beams.id]
    assert loaded.about['prior']['element_error_rms'] == scenario.element_error_rms
    np.testing.assert_array_equal(loaded.surface.factor, calibration.surface.factor)
    assert load_surface(str(file), scenario).id == calibration.surface.id
    assert load_surface('', scenario) is None


def test_a_file_holds_standard_deviations(calibration, file):
    with np.load(file) as archive:
        np.testing.assert_allclose(
            np.concatenate([archive['gains_std'], archive['offsets_std'],
                            archive['band_gains_std']]),
            calibration.surface.std())


def test_known_states_are_the_coefficients_of_0_and_1(scenario, tmp_path):
    known_states(scenario, 0.5 + 0.25j, -1).save(tmp_path / 'states.npz')
    surface = load_surface(str(tmp_path / 'states.npz'), scenario)
    assert surface.is_exact
    for state, coefficient in ((0.0, 0.5 + 0.25j), (1.0, -1.0)):
        applied = surface.applied(np.full((2, scenario.n_elements), state))
        np.testing.assert_allclose(applied, coefficient)
    assert (surface.band_gains == 1).all()


def test_a_file_for_another_scenario_is_refused(file, scenario):
    other = dataclasses.replace(scenario, refractive_index=2.2)
    with pytest.raises(CalibrationError) as caught:
        load_surface(str(file), other)
    text = str(caught.value)
    assert text.startswith(f'{file}: scenario_id: {scenario.id}, ')
    assert text.endswith(f'expected {other.id}')
    assert '\n' not in text


@pytest.mark.parametrize(('changes', 'error'), [
    ({'gains': np.ones(3)}, r'gains.*|offsets: shape \(25,\), expected \[3\]'),
    ({'factor': np.ones((4, 2))}, r'factor: shape \(4, 2\), expected \[52, R\]'),
    ({'factor': np.ones(4)}, 'factor: shape'),
    ({'offsets': np.full(25, np.nan)}, 'offsets: not finite'),
    ({'failed_probability': np.full(25, 1.5)}, 'failed_probability: 1.5 to 1.5, expected 0 to 1'),
    ({'gains': np.array(['a'])}, 'gains: .*of type <U1, expected numbers'),
    ({'failed_probability': np.full(25, 0.1j)}, 'failed_probability: complex numbers'),
    ({'factor': None}, 'not a calibration, expected a calibration file of format 1'),
    ({'extra': np.ones(1)}, 'not a calibration'),
    ({'about': json.dumps({'format': 2})}, 'not a calibration'),
    ({'about': 'garbage'}, 'cannot be read'),
])
def test_a_malformed_file_is_named(file, changes, error):
    rewrite(file, **changes)
    with pytest.raises(CalibrationError, match=error) as caught:
        Calibration.load(file)
    assert str(caught.value).startswith(f'{file}: ')


def test_a_file_of_another_kind_is_named(tmp_path):
    (tmp_path / 'file').write_bytes(b'garbage')
    with pytest.raises(CalibrationError, match='file: cannot be read'):
        Calibration.load(tmp_path / 'file')


def test_a_calibration_applies_wherever_the_surface_hangs(calibration, scenario):
    user = np.array([[8.0, 0.0, 0.0]])
    hall = PathChannel(user, np.array([[1e-4 + 0j]]), user[None], np.array([[0]]), 2.75e9)
    calibration.check(dataclasses.replace(
        scenario, pose={'position_m': [0, 3, 1]}, channel=hall))


def test_another_number_of_elements_is_refused(calibration):
    wrong = dataclasses.replace(calibration, scenario_id=Scenario().id)
    with pytest.raises(CalibrationError, match=r'N_B, N_E = \(2, 25\), expected \(2, 100\)'):
        wrong.check(Scenario())


def test_the_report_warns_of_an_estimation_that_did_not_converge(calibration, scenario):
    about = calibration.about | {'converged': False, 'rounds': 30}
    text = report(dataclasses.replace(calibration, about=about), scenario)
    assert 'warning: the estimation did not converge in 30 rounds' in text
    assert 'warning' not in report(calibration, scenario)


def test_the_report_lists_failures_errors_and_gains(calibration, scenario):
    lines = report(calibration, scenario).splitlines()
    assert lines[0] == f'20 pilots, scenario {scenario.id}'
    (failed,) = np.nonzero(calibration.surface.failed)
    assert lines[1].startswith(f'failed elements: {len(failed)} of 25 ')
    stuck = [line for line in lines if 'stuck at' in line]
    assert [f'element {m} (row {m // 5}, column {m % 5})' in line
            for m, line in zip(failed, stuck, strict=True)] == [True] * len(failed)
    assert sum(line.startswith('band ') for line in lines) == 2
    errors = [float(line.split()[6]) for line in lines
              if line.startswith('  ') and 'stuck' not in line]
    assert errors == sorted(errors, reverse=True)
    assert len(errors) == 5
    working = ~calibration.surface.failed
    rms = 100 * np.sqrt(np.mean(np.abs(calibration.surface.gains[working] - 1)**2))
    known = 100 * np.sqrt(np.mean(calibration.surface.std()[:25][working]**2))
    assert f'errors of working elements: {rms:.2f} % rms, known to {known:.2f} % rms' in lines


def test_states_of_elements_are_those_of_a_board_of_amplitudes():
    with pytest.raises(ValueError, match="^board: 'phase' with states of elements, expected 'pap"):
        known_states(Scenario(board='phase'), 0, 1)
