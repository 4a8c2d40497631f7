"""The posterior as a weighted sum over the whole region, and with failed elements."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import qmc

from rhs_isac_ros.model import MeasurementModel, Scenario, draw_surface
from rhs_isac_ros.model.elements import ElementErrors
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.positioning import simulate_pairs

SCENARIO = Scenario(n_subbands=2, n_frames=3, elements_per_side=4, angular_spread_deg=5.0,
                    roi_center_m=(4, 0, 0), roi_size_m=(1, 1, 0.5))
N_PHASES, LOG2_POINTS, N_VALUES = 2, 9, 300
FAILING = Scenario(
    center_frequencies_hz=(2.5e9, 3.1e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1), failed_element_share=0.02)
POSITION = np.array([[4.2, 0.3, -0.1]])
FILE = Path(__file__).parents[2] / 'scripts' / 'benchmarks' / 'parts' / 'exhaustive_posterior.py'


def load_reference():
    spec = importlib.util.spec_from_file_location('exhaustive_posterior', FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


reference = load_reference()
exhaustive_posterior = reference.exhaustive_posterior
posterior_with_truth = reference.posterior_with_truth


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


def log_densities(received, mean, covariance):
    """Log-densities [N, P] of signals [N, N_B, S] at means [P, N_B, S], summed over the bands."""
    residual = (received[:, None] - mean)[..., None]
    solved = np.matmul(np.linalg.inv(covariance), residual)
    energy = np.sum(residual.conj() * solved, axis=(-1, -2, -3)).real
    return -energy - np.linalg.slogdet(covariance)[1].sum(axis=-1)


def check(estimate, log_likelihoods):
    points = grid()
    for phase, log_likelihood in enumerate(log_likelihoods):
        weight = np.exp(log_likelihood - log_likelihood.max())
        np.testing.assert_allclose(
            estimate.mean[phase], np.average(points, axis=0, weights=weight), atol=2e-3)
        np.testing.assert_allclose(estimate.covariance[phase], np.cov(
            points.T, aweights=weight, ddof=0), atol=2e-3)


def test_moments_match_the_plain_likelihood(plain, random_beams):
    scenario = Scenario(n_subbands=2, elements_per_side=4, roi_center_m=(4, 0, 0),
                        roi_size_m=(1, 1, 0.5))
    codebook = random_beams(scenario, np.random.default_rng(1))
    received = simulate_pairs(scenario, codebook, 5, 0)[1]
    estimate = exhaustive_posterior(scenario, codebook, received, 13)

    p, spatial = plain(scenario, codebook.analog, codebook.digital), multipath_covariance(scenario)
    points = qmc.Sobol(3, seed=0).random(2**13) * [1, 1, 0.5] + [3.5, -0.5, -0.25]
    log_likelihood = np.zeros((5, 2**13))
    for band in range(2):
        residual = received[:, None, band] - p.mean(points, band)
        solved = np.linalg.solve(p.covariance(band, spatial[band]), residual[..., None])[..., 0]
        log_likelihood -= np.sum(residual.conj() * solved, axis=2).real
    weights = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    for row, weight in enumerate(weights):
        expected = np.average(points, axis=0, weights=weight)
        np.testing.assert_allclose(estimate.mean[row], expected, atol=1e-3)
        np.testing.assert_allclose(
            estimate.covariance[row], np.cov(points.T, aweights=weight, ddof=0), atol=1e-3)


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


def test_element_errors_have_the_covariance_at_every_point(codebook):
    scenario, received = draw(codebook, element_error_rms=0.05)
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS)
    model = MeasurementModel(scenario, codebook)
    mean, covariance = model.mean(grid()), model.covariance_at(grid())
    check(estimate, log_densities(received, mean, covariance))


def test_errors_of_a_known_surface_are_part_of_the_model(codebook):
    scenario, received = draw(codebook, element_error_rms=0.05)
    surface = draw_surface(scenario, np.random.default_rng(3))
    estimate = exhaustive_posterior(scenario, codebook, received, LOG2_POINTS, surface=surface)
    model = MeasurementModel(scenario, codebook, surface)
    mean, covariance = model.mean(grid()), model.covariance()
    check(estimate, log_densities(received, mean, covariance))


def sample_with(random_beams, failed, seed):
    """A codebook, a surface with failed elements, and signals of one phase."""
    codebook = random_beams(FAILING, np.random.default_rng(1))
    rng = np.random.default_rng(seed)
    stuck = np.full(FAILING.n_elements, np.nan)
    stuck[list(failed)] = rng.uniform(size=len(failed))
    surface = ElementErrors(np.ones(FAILING.n_elements, complex), stuck)
    model = MeasurementModel(
        dataclasses.replace(FAILING, failed_element_share=0.0), codebook, surface)
    return codebook, surface, model.sample(POSITION, rng)


def test_the_posterior_with_the_truth_is_that_of_the_search_if_it_misses_nothing(random_beams):
    codebook, surface, received = sample_with(random_beams, (3, 17), 0)
    estimate = posterior_with_truth(FAILING, codebook, received, [surface], POSITION)
    error = estimate.mean[0] - POSITION[0]
    assert error @ np.linalg.solve(estimate.covariance[0], error) < 16


def test_the_posterior_with_the_truth_requires_rare_failures(random_beams):
    codebook, surface, received = sample_with(random_beams, (3,), 0)
    intact = dataclasses.replace(FAILING, failed_element_share=0.0)
    with pytest.raises(ValueError, match='failed_element_share: 0, expected'):
        posterior_with_truth(intact, codebook, received, [surface], POSITION)
