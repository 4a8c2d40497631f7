"""The exhaustive posterior of scenarios that declare deviations."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import norm, qmc

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.imperfections import draw_surface
from rhs_isac_ros.model.nuisance import nuisance_parameters, nuisance_patterns
from rhs_isac_ros.positioning import exhaustive_errors, exhaustive_posterior

SCENARIO = Scenario(n_subbands=2, n_frames=3, elements_per_side=4, angular_spread_deg=5.0,
                    roi_center_m=(4, 0, 0), roi_size_m=(1, 1, 0.5))
N_PHASES, LOG2_POINTS, N_VALUES = 2, 9, 300


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


def draw(codebook, **changes):
    """A declaring scenario, and the signals of some phases."""
    scenario, rng = dataclasses.replace(SCENARIO, **changes), np.random.default_rng(2)
    positions = scenario.sample_positions(N_PHASES, rng)
    return scenario, MeasurementModel(scenario, codebook).sample(positions, rng)


def grid() -> np.ndarray:
    """The points of the posterior, which it draws in the region of interest."""
    return qmc.Sobol(3, seed=0).random(2**LOG2_POINTS) * [1, 1, 0.5] + [3.5, -0.5, -0.25]


def log_density(received, mean, covariance):
    """Log-density of signals [N_B, S] at means [..., N_B, S], summed over the bands."""
    residual = received - mean
    solved = np.matmul(np.linalg.inv(covariance), residual[..., None])[..., 0]
    energy = np.sum(residual.conj() * solved, axis=(-1, -2)).real
    return -energy - np.linalg.slogdet(covariance)[1].sum(axis=-1)


def check(estimate, phase: int, log_likelihood):
    weight = np.exp(log_likelihood - log_likelihood.max())
    points = grid()
    np.testing.assert_allclose(
        estimate.mean[phase], np.average(points, axis=0, weights=weight), atol=2e-3)
    np.testing.assert_allclose(estimate.covariance[phase], np.cov(
        points.T, aweights=weight, ddof=0), atol=2e-3)


@pytest.mark.parametrize('changes', [
    {'user_gain_std_db': 2.0}, {'carrier_offset_std_hz': 3e3}, {'timing_std_s': 5e-8},
    {'phase_std_rad': 0.5}, {'phase_std_rad': 7.0},
], ids=lambda changes: ' '.join(f'{name} {value:g}' for name, value in changes.items()))
def test_a_parameter_is_integrated_out(codebook, changes):
    """A plain sum over values of the parameter has the same moments."""
    scenario, received = draw(codebook, **changes)
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS)
    model = MeasurementModel(SCENARIO, codebook)
    mean, covariance = model.mean(grid()), model.covariance()
    noise = scenario.noise_power_w * np.eye(covariance.shape[1])
    (parameter,), (pattern,) = nuisance_parameters(scenario), nuisance_patterns(scenario)
    values = parameter.std * np.linspace(-5, 5, N_VALUES)
    for phase, signals in enumerate(received):
        terms = []
        for value in values:
            factor = np.exp(value * pattern)
            scaled = factor[:, :, None] * (covariance - noise) * factor[:, None].conj() + noise
            prior = norm.logpdf(value, scale=parameter.std)
            terms.append(log_density(signals, factor * mean, scaled) + prior)
        check(estimate, phase, np.logaddexp.reduce(terms, axis=0))


def test_phases_of_the_bands_are_integrated_out(codebook):
    scenario, received = draw(codebook, band_phase_std_rad=7.0)
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS)
    model = MeasurementModel(SCENARIO, codebook)
    mean, covariance = model.mean(grid()), model.covariance()
    angles = 2 * np.pi * np.arange(N_VALUES) / N_VALUES
    for phase, signals in enumerate(received):
        total = 0.0
        for band in range(2):
            one = slice(band, band + 1)
            total += np.logaddexp.reduce([
                log_density(signals[one], np.exp(1j * angle) * mean[:, one], covariance[one])
                for angle in angles], axis=0)
        check(estimate, phase, total)


def test_element_errors_have_the_covariance_at_every_point(codebook):
    scenario, received = draw(codebook, element_error_rms=0.05)
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS)
    model = MeasurementModel(scenario, codebook)
    mean, covariance = model.mean(grid()), model.covariance_at(grid())
    for phase, signals in enumerate(received):
        check(estimate, phase, log_density(signals, mean, covariance))


def test_drawn_points_keep_the_moments(codebook, monkeypatch):
    """Most points are not drawn, and the sums keep their expectation."""
    scenario, received = draw(codebook, element_error_rms=0.05)
    exact = exhaustive_posterior(scenario, codebook, received, 12)
    monkeypatch.setattr(exhaustive_errors, '_N_EXACT', 400)
    drawn = exhaustive_posterior(scenario, codebook, received, 12)
    np.testing.assert_allclose(drawn.mean, exact.mean, atol=0.03)
    np.testing.assert_allclose(drawn.covariance, exact.covariance, atol=0.01)
    assert not np.array_equal(drawn.mean, exact.mean)


def test_errors_of_a_known_surface_are_part_of_the_model(codebook):
    scenario, received = draw(codebook, element_error_rms=0.05)
    surface = draw_surface(scenario, np.random.default_rng(3))
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS, surface=surface)
    model = MeasurementModel(scenario, codebook, surface)
    mean, covariance = model.mean(grid()), model.covariance()
    for phase, signals in enumerate(received):
        check(estimate, phase, log_density(signals, mean, covariance))


@pytest.mark.parametrize('changes', [
    {'user_gain_std_db': 1.0, 'timing_std_s': 1e-8}, {'band_phase_std_rad': 0.3},
    {'user_gain_std_db': 1.0, 'element_error_rms': 0.01},
], ids=lambda changes: ' '.join(changes))
def test_other_combinations_are_refused(codebook, changes):
    scenario, received = draw(codebook, **changes)
    with pytest.raises(ValueError, match='expected'):
        exhaustive_posterior(scenario, codebook, received, LOG2_POINTS)
