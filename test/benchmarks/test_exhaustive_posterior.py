"""The posterior as a weighted sum over the whole region."""

import dataclasses

import numpy as np
import pytest
from parts.exhaustive_posterior import exhaustive_posterior
from scipy.stats import qmc

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.impairments import nuisance_of

SCENARIO = Scenario(n_subbands=2, n_frames=3, elements_per_side=4, angular_spread_deg=5.0,
                    roi_center_m=(4, 0, 0), roi_size_m=(1, 1, 0.5))
N_SHOTS, LOG2_POINTS, N_VALUES = 2, 8, 300


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


def draw(codebook, **changes):
    """A declaring scenario, and the signals of some shots."""
    scenario, rng = dataclasses.replace(SCENARIO, **changes), np.random.default_rng(2)
    positions = scenario.sample_positions(N_SHOTS, rng)
    return scenario, MeasurementModel(scenario, codebook).sample(positions, rng)


def grid() -> np.ndarray:
    """The points of the posterior, which it draws in the region of interest."""
    return qmc.Sobol(3, seed=0).random(2**LOG2_POINTS) * [1, 1, 0.5] + [3.5, -0.5, -0.25]


def log_densities(received, mean, covariance):
    """Log-densities [N, P] of signals [N, N_B, S] at means [P, N_B, S], summed over the bands."""
    residual = (received[:, None] - mean)[..., None]
    solved = np.matmul(np.linalg.inv(covariance), residual)
    energy = np.sum(residual.conj() * solved, axis=(-1, -2, -3)).real
    return -energy - np.linalg.slogdet(covariance)[1].sum(axis=-1)


def check(estimate, log_likelihoods):
    points = grid()
    for shot, log_likelihood in enumerate(log_likelihoods):
        weight = np.exp(log_likelihood - log_likelihood.max())
        np.testing.assert_allclose(
            estimate.mean[shot], np.average(points, axis=0, weights=weight), atol=2e-3)
        np.testing.assert_allclose(estimate.covariance[shot], np.cov(
            points.T, aweights=weight, ddof=0), atol=2e-3)


@pytest.mark.parametrize('changes', [
    {'user_gain_std_db': 2.0}, {'carrier_offset_std_hz': 3e3}, {'timing_std_s': 5e-8},
    {'phase_std_rad': 0.5}, {'phase_std_rad': 7.0},
    {'user_gain_std_db': 1.0, 'timing_std_s': 1e-8}, {'band_phase_std_rad': 0.3},
    {'user_gain_std_db': 1.0, 'element_error_rms': 0.03},
], ids=lambda changes: ' '.join(f'{name} {value:g}' for name, value in changes.items()))
def test_impairments_are_integrated_out(codebook, changes):
    """A plain sum over values of the parameters has the same moments."""
    scenario, received = draw(codebook, **changes)
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS)
    model, nuisance = MeasurementModel(scenario, codebook), nuisance_of(scenario)
    mean, covariance = model.mean(grid()), (
        model.covariance_at(grid()) if scenario.element_error_rms else model.covariance())
    noise = scenario.noise_power_w * np.eye(covariance.shape[-1])
    # Two parameters are narrow; a single one may be a phase that turns several times.
    line = np.linspace(-5, 5, N_VALUES) if len(nuisance) == 1 else np.linspace(-4, 4, 21)
    values = np.stack(np.meshgrid(*[line] * len(nuisance)), axis=-1).reshape(-1, len(nuisance))
    terms = []
    for value in values:
        factor = np.exp(np.tensordot(value, nuisance.scaled_patterns, axes=1))
        scaled = factor[:, :, None] * (covariance - noise) * factor[:, None].conj() + noise
        terms.append(log_densities(received, factor * mean, scaled) - value @ value / 2)
    check(estimate, np.logaddexp.reduce(terms, axis=0))


def test_phases_of_the_bands_are_integrated_out(codebook):
    scenario, received = draw(codebook, band_phase_std_rad=7.0)
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS)
    model = MeasurementModel(SCENARIO, codebook)
    mean, covariance = model.mean(grid()), model.covariance()
    angles = 2 * np.pi * np.arange(N_VALUES) / N_VALUES
    total = 0.0
    for band in range(2):
        one = slice(band, band + 1)
        total += np.logaddexp.reduce([
            log_densities(received[:, one], np.exp(1j * angle) * mean[:, one], covariance[one])
            for angle in angles], axis=0)
    check(estimate, total)


@pytest.mark.parametrize('rms', [0.0, 0.05])
def test_element_errors_have_the_covariance_at_every_point(codebook, rms):
    scenario, received = draw(codebook, element_error_rms=rms)
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS)
    model = MeasurementModel(scenario, codebook)
    covariance = model.covariance_at(grid()) if rms else model.covariance()
    check(estimate, log_densities(received, model.mean(grid()), covariance))
