"""The bound with nuisance parameters and the region of interest as a prior."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb, crlb, crlb_of, fisher, fisher_information
from rhs_isac_ros.bounds.nuisance import marginal_information, region_information
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.nuisance import nuisance_factors, nuisance_parameters

DECLARED = {
    'user_gain_std_db': 2.0, 'carrier_offset_std_hz': 700.0, 'phase_std_rad': 0.4,
    'timing_std_s': 30e-9, 'band_phase_std_rad': 0.7}
ERRORS = {'element_error_rms': 0.1, 'failed_element_share': 0.05}
# Declared deviations, one at a time and together.
CASES = [{name: value} for name, value in DECLARED.items()] + [
    {'element_error_rms': 0.1}, {'failed_element_share': 0.05}, DECLARED | ERRORS]


@pytest.fixture(scope='module')
def uncertain() -> Scenario:
    """Two bands with little correlation, and every deviation declared."""
    return Scenario(
        center_frequencies_hz=(1.2e9, 3.1e9), n_subbands=2, n_frames=3, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-4,
        roi_center_m=(3, 0, 0), roi_size_m=(2, 3, 2), **DECLARED, **ERRORS)


@pytest.fixture(scope='module')
def codebook(uncertain, random_beams) -> Codebook:
    return random_beams(uncertain, np.random.default_rng(0))


def test_nothing_declared_gives_the_plain_bound(case):
    positions = case.vectors['positions']
    model = MeasurementModel(case.scenario, case.codebook)
    joint = fisher.joint_information_of(model, positions)
    np.testing.assert_allclose(
        marginal_information(joint), case.vectors['fim'], rtol=1e-8,
        atol=1e-9 * np.abs(case.vectors['fim']).max())
    # A deviation too small to matter, through the code of nuisance parameters.
    tiny = dataclasses.replace(case.scenario, band_phase_std_rad=1e-9, user_gain_std_db=1e-9)
    np.testing.assert_allclose(
        crlb(tiny, case.codebook, positions), case.vectors['crlb'], rtol=1e-8)


def test_the_bound_is_that_of_the_joint_information(uncertain, codebook):
    """Position and nuisance parameters by finite differences of the mean, and the whole
    matrix inverted."""
    model = MeasurementModel(uncertain, codebook)
    position = uncertain.sample_positions(1, np.random.default_rng(1))
    stds = np.array([p.std for p in nuisance_parameters(uncertain)])
    n_parameters = 3 + len(stds)

    def mean(values):
        factors = nuisance_factors(uncertain, values[None, 3:] * stds)
        return model.whiten(model.mean(position + values[:3]) * factors).ravel()

    steps = 1e-5 * np.eye(n_parameters)
    slopes = np.stack([(mean(step) - mean(-step)) / 2e-5 for step in steps])
    information = 2 * (slopes @ slopes.conj().T).real
    information[3:, 3:] += np.eye(len(stds))
    expected = np.trace(np.linalg.inv(information)[:3, :3])
    assert crlb_of(model, position)[0] == pytest.approx(expected, rel=1e-5)
    information[:3, :3] += np.diag(12 / np.array(uncertain.roi_size_m)**2)
    expected = np.trace(np.linalg.inv(information)[:3, :3])
    assert crlb_of(model, position, region_prior=True)[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize('declared', CASES, ids=lambda declared: '+'.join(declared)[:24])
def test_a_declared_deviation_raises_the_bound(table1, declared):
    scenario = dataclasses.replace(table1.scenario, **declared)
    bound = crlb(scenario, table1.codebook, table1.vectors['positions'])
    assert (bound > 1.0001 * table1.vectors['crlb']).all()


def test_the_region_is_an_upper_limit(small):
    mute = dataclasses.replace(small.scenario, user_gain=1e-6, noise_psd_dbm_hz=-100)
    bound = crlb(mute, small.codebook, small.vectors['positions'], region_prior=True)
    np.testing.assert_allclose(bound, np.sum(np.square(mute.roi_size_m)) / 12, rtol=1e-3)
    np.testing.assert_allclose(
        np.linalg.inv(region_information(mute)), np.diag(np.square(mute.roi_size_m) / 12))


def test_equation_12_is_that_of_the_position_alone(table1):
    declared = dataclasses.replace(table1.scenario, **DECLARED)
    np.testing.assert_array_equal(
        fisher_information(declared, table1.codebook, table1.vectors['positions']),
        fisher_information(table1.scenario, table1.codebook, table1.vectors['positions']))


@pytest.mark.parametrize('region_prior', [False, True])
@pytest.mark.parametrize('tolerance', [0, 1e-7], ids=['exact', 'compressed'])
@pytest.mark.parametrize('declared', [{}, DECLARED, ERRORS, DECLARED | ERRORS],
                         ids=['none', 'nuisance', 'errors', 'all'])
def test_average_and_gradients_are_those_of_the_bound(
        uncertain, codebook, declared, tolerance, region_prior):
    nothing = dict.fromkeys([*DECLARED, *ERRORS], 0.0)
    scenario = dataclasses.replace(uncertain, **(nothing | declared))
    positions = scenario.sample_positions(3, np.random.default_rng(2))
    average = AverageCrlb(scenario, positions, tolerance, region_prior=region_prior)
    value, by_analog, by_digital = average(codebook)
    assert average.value(codebook) == pytest.approx(value, rel=1e-12)

    def bound(analog, digital):
        return crlb(scenario, Codebook(analog, digital), positions,
                    region_prior=region_prior).mean()

    assert value == pytest.approx(bound(codebook.analog, codebook.digital), rel=1e-5)
    rng, step = np.random.default_rng(3), 1e-5
    for _ in range(3):
        analog = rng.normal(size=by_analog.shape)
        digital = rng.normal(size=(*by_digital.shape, 2)) @ [1, 1j] * np.abs(codebook.digital)
        ahead, behind = (bound(np.clip(codebook.analog + sign * step * analog, 0, 1),
                               codebook.digital + sign * step * digital) for sign in (1, -1))
        expected = np.sum(by_analog * analog) + np.sum(np.conj(by_digital) * digital).real
        assert (ahead - behind) / (2 * step) == pytest.approx(expected, rel=2e-4)
