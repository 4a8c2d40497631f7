"""The likelihood of positions and nuisance parameters."""

import dataclasses

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import binom

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.elements import ElementErrors
from rhs_isac_ros.model.geometry import to_polar, to_positions
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.positioning.dispersed import DispersedLikelihood, InterpolatedCovariance
from rhs_isac_ros.positioning.failures import FailureModel
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.offsets import Alignment
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.system import System

SCENARIO = Scenario(
    center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
ALL = {'user_gain_std_db': 1.0, 'carrier_offset_std_hz': 500.0, 'phase_std_rad': 0.5,
       'timing_std_s': 1e-8, 'band_phase_std_rad': 0.3}
# Signals of which about half of the combinations consist of thermal noise.
NOISY = ALL | {'noise_psd_dbm_hz': -135.0}
# Multipath that differs from frame to frame, and so reveals no offset of the carrier.
FADING = ALL | {'frame_duration_s': 0.01, 'max_user_speed_mps': 5.0, 'carrier_offset_std_hz': 3.0}


@pytest.fixture(scope='module')
def likelihood(case) -> Likelihood:
    return Likelihood(System(case.scenario, case.codebook))


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


def declaring(**changes) -> Scenario:
    return dataclasses.replace(SCENARIO, **changes)


def without_values(n):
    return np.zeros((n, 0))


def repeated(signals, n):
    """Return the signals of one phase for n points."""
    return select(signals, np.zeros(n, int))


def test_the_value_is_the_gaussian_log_likelihood(case, likelihood):
    """Up to a constant, it is the log density of the signals before whitening."""
    rng = np.random.default_rng(0)
    n_bands, n_rows = case.vectors['cov'].shape[:2]
    noise = 1e-7 * rng.normal(size=(n_bands, n_rows, 2)) @ [1, 1j]
    received = case.vectors['mean'][:, 0] + noise
    exact = 0.0
    for y, means, covariance in zip(
            received, case.vectors['mean'], case.vectors['cov'], strict=True):
        residual = (y - means).T
        weighed = np.linalg.solve(covariance, residual)
        exact = exact - np.sum(residual.conj() * weighed, axis=0).real
    points = to_polar(case.vectors['positions'])
    local = likelihood.local(points, without_values(len(points)),
                             repeated(likelihood.signals(received[None]), len(points)))
    np.testing.assert_allclose(local.value - local.value[0], exact - exact[0],
                               rtol=1e-6, atol=1e-6 * np.abs(exact).max())
    np.testing.assert_array_equal(local.residual, -local.value)


@pytest.mark.parametrize('changes', [{}, ALL, NOISY], ids=['position', 'all parameters', 'noise'])
def test_the_gradient_is_that_of_the_log_likelihood(codebook, changes):
    scenario, rng = declaring(**changes), np.random.default_rng(3)
    likelihood = Likelihood(System(scenario, codebook))
    position = np.array([[4.2, 0.3, -0.1]])
    signals = likelihood.signals(MeasurementModel(scenario, codebook).sample(position, rng))
    values = 0.3 * rng.normal(size=(1, len(likelihood.nuisance)))
    points = to_polar(position + 0.003)
    _, gradient, information, _ = likelihood.local(points, values, signals)
    np.testing.assert_allclose(information, np.swapaxes(information, 1, 2), rtol=1e-9)
    assert (np.linalg.eigvalsh(information / np.sqrt(
        np.einsum('mp,mq->mpq', *[np.diagonal(information, axis1=1, axis2=2)] * 2))) > 0).all()

    def value(change):
        return likelihood.local(points + change[:3], values + change[3:], signals).value[0]

    scale = 1e-4 / np.sqrt(np.diagonal(information[0]))
    for index, step in enumerate(np.diag(scale)):
        difference = (value(step) - value(-step)) / (2 * scale[index])
        assert difference == pytest.approx(gradient[0, index], rel=1e-3, abs=1e-3 / scale[index])


@pytest.mark.parametrize('changes', [{}, ALL, NOISY, FADING], ids=[
    'position', 'all parameters', 'noise', 'fading'])
def test_the_information_is_the_covariance_of_the_gradient(codebook, changes):
    """Averaged over signals at the true parameters, without the prior.

    The information about parameters that move the multipath varies from phase to phase.
    """
    rng = np.random.default_rng(4)
    scenario = declaring(**changes)
    likelihood = Likelihood(System(scenario, codebook))
    point = to_polar(np.array([[4.2, 0.3, -0.1]]))
    unimpaired = dataclasses.replace(scenario, **{
        name: 0.0 for name in changes.keys() & ALL.keys()})
    received = MeasurementModel(unimpaired, codebook).sample(
        np.tile(to_positions(point), (2000, 1)), rng)
    _, gradients, informations, _ = likelihood.local(
        np.tile(point, (2000, 1)), np.zeros((2000, len(likelihood.nuisance))),
        likelihood.signals(received))
    information = informations.mean(axis=0)
    information -= np.diag([*likelihood.nuisance.floor, *likelihood.nuisance.precision])
    scale = np.sqrt(np.diag(information))
    found = np.cov(gradients.T) / np.outer(scale, scale)
    np.testing.assert_allclose(found, information / np.outer(scale, scale), atol=0.15)


def test_the_signals_alone_reveal_the_offsets_of_carrier_and_timing(codebook):
    scenario = declaring(carrier_offset_std_hz=2e3, timing_std_s=1e-7)
    likelihood = Likelihood(System(scenario, codebook))
    spread = tabulate(likelihood.model)['spread']
    rng = np.random.default_rng(5)
    values = rng.normal(size=(20, 2))
    positions = scenario.sample_positions(20, rng)
    received = MeasurementModel(SCENARIO, codebook).sample(positions, rng)
    received = received * nuisance_of(scenario).factors(values * [2e3, 1e-7])
    found = Alignment(likelihood, spread).values_of_each(received)
    assert np.abs(found - values).max() < 0.3
    # Parameters whose likelihood has one maximum are not searched for on a grid.
    likelihood.nuisance.needs_search = np.zeros(2, bool)
    local = Alignment(likelihood, spread)
    np.testing.assert_array_equal(
        local.values_of_each(received), local.values_of_each(received, np.zeros((20, 2))))


def test_errors_of_elements_have_the_covariance_at_the_position(codebook):
    scenario = declaring(element_error_rms=0.05)
    likelihood = Likelihood(System(scenario, codebook))
    exact = MeasurementModel(scenario, codebook)
    positions = np.array([[3.2, 0.1, 0.0], [4.8, 0.1, 0.0]])
    received = exact.sample(positions[:1], np.random.default_rng(6))
    local = DispersedLikelihood(likelihood).local(
        to_polar(positions), without_values(2), repeated(likelihood.signals(received), 2))
    # The value is relative to that of the likelihood with the average covariance.
    average = np.sum(np.linalg.slogdet(exact.covariance())[1])
    for n, covariance in enumerate(exact.covariance_at(positions)):
        difference = received[0] - exact.mean(positions)[n]
        energy = sum(np.vdot(d, np.linalg.solve(c, d)).real
                     for d, c in zip(difference, covariance, strict=True))
        assert local.residual[n] == pytest.approx(energy, rel=1e-6)
        value = average - energy - np.sum(np.linalg.slogdet(covariance)[1])
        assert local.value[n] == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize('changes', [
    {}, {'failed_element_share': 0.05}, {'roi_size_m': (2, 0, 0)},
    {'user_gain': lambda angles: np.cos(angles)**2}],
    ids=['errors', 'errors and failures', 'line', 'gain pattern'])
def test_the_covariance_at_the_position_is_interpolated(codebook, changes):
    """The stated error is that of whitened covariances. Beyond the region, they are exact."""
    model = MeasurementModel(declaring(element_error_rms=0.1, **changes), codebook)
    positions = model.scenario.sample_positions(50, np.random.default_rng(5))
    covariance_at = InterpolatedCovariance.of(model)
    assert isinstance(covariance_at, InterpolatedCovariance)
    errors = model.whitener @ (covariance_at(positions) - model.covariance_at(positions)
                               ) @ np.conj(np.swapaxes(model.whitener, 1, 2))
    assert np.linalg.norm(errors, axis=(2, 3)).max() < 2e-5
    beyond = positions + [3.0, 0.0, 0.0]
    np.testing.assert_array_equal(covariance_at(beyond), model.covariance_at(beyond))


def test_covariances_of_an_estimated_surface_are_not_interpolated(codebook):
    surface = ElementErrors(np.ones(36), np.full(36, np.nan))
    model = MeasurementModel(SCENARIO, codebook, surface)
    assert InterpolatedCovariance.of(model) == model.covariance_at


def test_the_likelihood_is_the_average_over_the_number_of_failures(codebook):
    scenario = declaring(element_error_rms=0.02, failed_element_share=0.02)
    exact = System(scenario, codebook)
    likelihood = Likelihood(exact)
    user = np.array([[4.2, 0.3, -0.1]])
    received = exact.sample(user, np.random.default_rng(7))
    positions = user + [[0.001, 0.002, 0], [0, 0, 0.003]]
    average = exact.covariance_at(positions)
    intact = MeasurementModel(
        dataclasses.replace(scenario, failed_element_share=0.0), codebook).covariance_at(positions)
    residuals = received - exact.mean(positions)
    # The probability of more than six failures is below 1e-5.
    counts, expected = np.arange(7), np.empty(2)
    for n in range(2):
        values = binom.logpmf(counts, 36, 0.02)
        for count in counts:
            for d, first, second in zip(residuals[n], intact[n], average[n], strict=True):
                covariance = first + count / (36 * 0.02) * (second - first)
                values[count] -= np.vdot(d, np.linalg.solve(covariance, d)).real
                values[count] -= np.linalg.slogdet(covariance)[1]
        expected[n] = logsumexp(values)
    expected += np.sum(np.linalg.slogdet(exact.covariance())[1])
    found = DispersedLikelihood(likelihood).local(
        to_polar(positions), without_values(2), repeated(likelihood.signals(received), 2)).value
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.01)
    assert np.diff(found)[0] == pytest.approx(np.diff(expected)[0], abs=0.01)


@pytest.mark.parametrize(('changes', 'conditional'), [
    ({'element_error_rms': 0.03}, DispersedLikelihood),
    ({'element_error_rms': 0.03, 'failed_element_share': 0.02}, DispersedLikelihood),
    ({'failed_element_share': 0.02}, lambda one: FailureModel(one).failed_set((3, 17))),
], ids=['errors', 'errors and failures', 'failures of a set'])
def test_nuisance_parameters_and_element_errors_combine(codebook, changes, conditional):
    """The value at parameters is that of the signals, and the noise, divided by their factors."""
    scenario, rng = declaring(**NOISY, **changes), np.random.default_rng(1)
    likelihood = Likelihood(System(scenario, codebook))
    position = np.array([[4.2, 0.3, -0.1]])
    received = MeasurementModel(scenario, codebook).sample(position, rng)
    values = 0.3 * rng.normal(size=(1, len(likelihood.nuisance)))
    found = conditional(likelihood).local(
        to_polar(position), values, likelihood.signals(received))
    gain_db = values[0, 0]
    alone = Likelihood(System(declaring(
        **changes, noise_psd_dbm_hz=scenario.noise_psd_dbm_hz - gain_db), codebook))
    divided = received / np.exp(
        np.tensordot(values, nuisance_of(scenario).scaled_patterns, axes=1))
    expected = conditional(alone).local(
        to_polar(position), without_values(1), alone.signals(divided))
    gain = gain_db * np.log(10) / 20
    prior = values[0] @ values[0] / 2 + 2 * received.size * gain
    # Each value omits a constant.
    expected_value = expected.value[0] - prior + likelihood.log_det - alone.log_det
    assert found.value[0] == pytest.approx(expected_value, rel=1e-9)
    assert found.residual[0] == pytest.approx(expected.residual[0], rel=1e-9)
    np.testing.assert_allclose(found.gradient[0, :3], expected.gradient[0], rtol=1e-6)
    np.testing.assert_allclose(found.information[0, :3, :3], expected.information[0], rtol=1e-6)


def test_the_profile_over_the_gain_is_the_maximum_with_its_prior(codebook):
    prior = Likelihood(System(declaring(user_gain_std_db=3.0), codebook)).nuisance
    std, energy, n_rows = 3 * np.log(10) / 20, 40.0, 30
    amplitude = np.linspace(5.0, 80.0, 200)
    gain = np.linspace(-4 * std, 4 * std, 20_001)
    values = (-np.exp(-2 * gain) * energy + 2 * np.exp(-gain) * amplitude[:, None]
              - 2 * n_rows * gain - gain**2 / (2 * std**2))
    value, found = prior.maximised_over_gain(amplitude, energy, n_rows)
    np.testing.assert_allclose(value, values.max(axis=1), atol=0.05)
    np.testing.assert_allclose(found, gain[values.argmax(axis=1)], atol=0.05 * std)
