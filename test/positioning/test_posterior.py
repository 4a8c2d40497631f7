"""Samples of the posterior, and phases of the bands that are neither known nor uniform."""

import dataclasses

import numpy as np
import pytest
from scipy.special import i0e, ive
from scipy.stats import multivariate_normal, norm, qmc

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import estimators, make_estimator
from rhs_isac_ros.positioning.dispersed import DispersedLikelihood
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.posterior import (
    _SPREAD,
    BandPhases,
    Samples,
    _log_density,
    log_share,
)
from rhs_isac_ros.positioning.search import Modes
from rhs_isac_ros.system import System

SCENARIO = Scenario(
    center_frequencies_hz=(2.5e9, 2.54e9, 2.6e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(8, 0, 0), roi_size_m=(8, 2, 1), band_phase_std_rad=0.8)
N_PHASES, LOG2_POINTS, N_HARMONICS = 8, 14, 6
UNIFORM_RAD = 2 * np.pi


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


def log_factors(outputs, std):
    """The series of the factor of each band, [..., N_B], whose terms have closed forms."""
    concentration, angle = 2 * np.abs(outputs), np.angle(outputs)
    total = constant = i0e(concentration)
    for n in range(1, N_HARMONICS + 1):
        total = total + (2 * np.exp(-(n * std)**2 / 2) * np.cos(n * angle)
                         * ive(n, concentration))
    return np.log(total / constant)


def posterior_moments(scenario, codebook, received, log2_points):
    """Means [N, 3] and covariances [N, 3, 3], from a sum over points all over the region."""
    model = MeasurementModel(scenario, codebook)
    low, high = scenario.roi_bounds_m
    points = qmc.Sobol(3, seed=1).random_base2(log2_points) * (high - low) + low
    whitened, values = np.swapaxes(model.whiten(received), 0, 1), []
    for block in np.split(points, max(len(points) // 2**14, 1)):
        templates = model.whiten(model.mean(block))
        energy = np.sum(np.abs(templates)**2, axis=(1, 2))
        outputs = np.matmul(whitened, np.conj(np.moveaxis(templates, 0, 2)))
        concentration = 2 * np.abs(outputs)
        value = concentration + np.log(i0e(concentration))
        if scenario.band_phase_std_rad < UNIFORM_RAD:
            value += log_factors(outputs, scenario.band_phase_std_rad)
        values.append(value.sum(axis=0) - energy)
    values = np.hstack(values)
    weights = np.exp(values - values.max(axis=1, keepdims=True))
    return (np.array([np.average(points, axis=0, weights=one) for one in weights]),
            np.array([np.cov(points.T, aweights=one, ddof=0) for one in weights]))


def test_the_shares_of_overlapping_modes_follow_their_densities():
    rng, n = np.random.default_rng(4), 4
    roots = rng.normal(size=(n, 3, 3)) + 3 * np.eye(3)
    means, curvature = rng.normal(5, 1, (n, 3)), roots @ np.swapaxes(roots, 1, 2)
    fields = dict.fromkeys(Modes._fields, np.zeros(n))
    gradient = 0.1 * curvature.sum(axis=2)
    modes = Modes(**fields | {
        'points': means - 0.1, 'gradient': gradient, 'curvature': curvature})
    points = rng.normal(5, 1, (n, 5, 3))
    widening = _SPREAD**2
    density = np.stack([multivariate_normal(mean, widening * np.linalg.inv(one)).pdf(points)
                        for mean, one in zip(means, curvature, strict=True)])
    np.testing.assert_allclose(
        np.exp(log_share(points, modes, np.zeros((n, 0)))),
        np.einsum('mms->ms', density) / density.sum(axis=0), rtol=1e-9)
    # Modes with other velocities have points of their own.
    assert not log_share(points, modes, np.tile(2.0 * np.arange(n)[:, None], 3)).any()


@pytest.mark.slow
def test_the_mean_is_that_of_the_posterior_with_the_prior_of_the_phases(codebook):
    scenario, rng = SCENARIO, np.random.default_rng(3)
    positions = scenario.sample_positions(N_PHASES, rng)
    received = MeasurementModel(scenario, codebook).sample(positions, rng)
    uniform = dataclasses.replace(scenario, band_phase_std_rad=UNIFORM_RAD)
    reference, _ = posterior_moments(scenario, codebook, received, LOG2_POINTS)
    declared, silent = (
        np.mean(np.sum((make_estimator('bayes', one, codebook).estimate(received).mean
                        - reference)**2, axis=1)) for one in (scenario, uniform))
    assert declared < 0.2 * silent


# The average over a wavelength nearly removes a phase that all bands share, unless the carriers
# are far apart. Unlikely phases then have a noticeable part in it, and the wrapped normal
# distribution is only close to their density.
@pytest.mark.slow
@pytest.mark.parametrize(('frequencies_hz', 'phase_std_rad', 'tolerance'), [
    ((2.5e9, 2.54e9, 2.6e9), 0.0, 0.02), ((2.5e9, 2.54e9, 2.6e9), UNIFORM_RAD, 0.02),
    ((2.4e9, 3.5e9, 5.8e9), 0.5, 0.4)])
def test_the_factors_average_the_series_over_a_wavelength_and_the_shared_phase(
        random_beams, frequencies_hz, phase_std_rad, tolerance):
    scenario = dataclasses.replace(
        SCENARIO, center_frequencies_hz=frequencies_hz, phase_std_rad=phase_std_rad)
    likelihood = Likelihood(System(scenario, random_beams(scenario, np.random.default_rng(1))))
    rng = np.random.default_rng(4)
    outputs = rng.uniform(5, 20, (3, 25)) * np.exp(1j * rng.uniform(-np.pi, np.pi, (3, 25)))
    phases = BandPhases(likelihood)
    found, shares = phases.factors(outputs)
    wavenumbers = 2 * np.pi * np.array(frequencies_hz) / 299792458
    wavelength = 2 * np.pi / wavenumbers.mean()
    ranges = np.linspace(-0.5, 0.5, 100, endpoint=False) * wavelength
    shared = np.arange(-10, 10) * np.pi / 10
    weights = (shared == 0 if phase_std_rad == 0 else np.ones(20) if phase_std_rad == UNIFORM_RAD
               else np.exp(-shared**2 / (2 * phase_std_rad**2)))
    turned = outputs.T[:, None, None] * np.exp(1j * (
        ranges[:, None, None] * wavenumbers + shared[:, None]))
    likely = np.exp(log_factors(turned, 0.8).sum(axis=3)) @ weights / weights.sum()
    np.testing.assert_allclose(found, np.log(likely.mean(axis=1)), atol=tolerance)
    np.testing.assert_allclose(
        shares @ phases.offsets_m, likely @ ranges / likely.sum(axis=1), atol=wavelength / 10)
    drawn_m = phases.drawn_m(np.repeat(shares[:1], 1000, axis=0))
    np.testing.assert_allclose(
        np.mean(drawn_m[:, None] == phases.offsets_m, axis=0), shares[0], atol=0.01)


@pytest.mark.parametrize('std_rad', [0.3, 1.5, 3.0])
def test_a_wrapped_density_is_the_sum_over_all_turns(std_rad):
    angles = np.linspace(-5, 5, 41)
    turns = 2 * np.pi * np.arange(-4, 5)
    expected = 2 * np.pi * norm(scale=std_rad).pdf(angles[:, None] + turns).sum(axis=1)
    np.testing.assert_allclose(_log_density(angles, std_rad), np.log(expected), atol=0.01)


@pytest.mark.parametrize('std_rad, is_informative', [
    (0.0, False), (0.3, False), (0.8, True), (UNIFORM_RAD, False)])
def test_only_broad_phases_are_left_to_the_samples(codebook, std_rad, is_informative):
    scenario = dataclasses.replace(SCENARIO, band_phase_std_rad=std_rad)
    assert BandPhases(Likelihood(System(scenario, codebook))).is_informative is is_informative


@pytest.mark.parametrize('size', [3, 6])
def test_covariances_of_few_samples_cover_another_one(size):
    n_shots, n = 4000, 20
    white = np.random.default_rng(3).standard_normal((n_shots, n + 1, size))
    means, covariances = Samples.of(
        white[:, 1:], np.zeros((n_shots, n)), np.arange(n_shots), size + 2).moments()
    errors = white[:, 0] - means
    squares = np.sum(errors * np.linalg.solve(covariances, errors[..., None])[..., 0], axis=1)
    assert squares.mean() == pytest.approx(size, rel=0.04)


def test_no_covariance_is_that_of_a_few_samples():
    """If one sample has all the weight, others count until the covariance is known."""
    positions = np.random.default_rng(4).standard_normal((3, 128, 6))
    log_weights = np.zeros((3, 128))
    log_weights[0, 0], log_weights[1, :100] = 50.0, -3.0
    shots = np.arange(3)
    samples = Samples.of(positions, log_weights, shots, n_fitted=8)
    n = 1 / np.sum(samples.weights**2, axis=1)
    assert 16 <= n[0] < 30
    _, covariances = samples.moments()
    assert np.linalg.eigvalsh(covariances[0]).min() > 0.5
    # Others keep their weights, and all their evidence.
    plain = Samples.of(positions, log_weights, shots)
    np.testing.assert_allclose(samples.weights[1:], plain.weights[1:])
    np.testing.assert_allclose(samples.log_evidence, plain.log_evidence)


@pytest.mark.slow
def test_random_phases_of_the_bands_leave_the_moments_of_the_posterior(random_beams):
    """The modes extend over the range and overlap."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(14, 0, 0), roi_size_m=(8, 4, 2), band_phase_std_rad=7.0)
    codebook = random_beams(scenario, np.random.default_rng(1))
    rng = np.random.default_rng(7)
    positions = scenario.sample_positions(25, rng)
    received = MeasurementModel(scenario, codebook).sample(positions, rng)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)
    assert estimate.fix.all()
    mean, covariance = posterior_moments(scenario, codebook, received, 15)
    variance = np.trace(covariance, axis1=1, axis2=2)
    difference = np.sum((estimate.mean - mean)**2, axis=1)
    assert np.mean(difference) < 0.04 * np.mean(variance)
    predicted = np.trace(estimate.covariance, axis1=1, axis2=2)
    assert np.mean(predicted) == pytest.approx(np.mean(variance), rel=0.15)


def test_samples_have_the_element_errors_at_their_positions(codebook, monkeypatch):
    """Their weights come from the likelihood that has refined the modes."""
    scenario, draw, used = dataclasses.replace(
        SCENARIO, band_phase_std_rad=UNIFORM_RAD, element_error_rms=0.05
    ), estimators.draw_broad_samples, []

    def record(likelihood, conditionals, *arguments):
        used.extend(conditionals)
        return draw(likelihood, conditionals, *arguments)

    monkeypatch.setattr(estimators, 'draw_broad_samples', record)
    rng = np.random.default_rng(4)
    received = MeasurementModel(scenario, codebook).sample(scenario.sample_positions(1, rng), rng)
    make_estimator('bayes', scenario, codebook).estimate(received)
    assert [type(one) for one in used] == [DispersedLikelihood]
