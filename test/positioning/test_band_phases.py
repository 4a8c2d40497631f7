"""Phases of the bands that are neither known nor uniform."""

import dataclasses

import numpy as np
import pytest
from scipy.special import ive
from scipy.stats import qmc

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.positioning.band_phases import BandPhases
from rhs_isac_ros.positioning.unknowns import Unknowns
from rhs_isac_ros.positioning.whitened import WhitenedModel

SCENARIO = Scenario(
    center_frequencies_hz=(2.5e9, 2.54e9, 2.6e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(8, 0, 0), roi_size_m=(8, 2, 1), band_phase_std_rad=0.8)
N_PHASES, LOG2_POINTS, N_HARMONICS = 15, 14, 6
UNIFORM_RAD = 2 * np.pi


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


def log_factors(outputs, std):
    """The series of the factor of each band, [..., N_B], whose terms have closed forms."""
    concentration, angle = 2 * np.abs(outputs), np.angle(outputs)
    total = np.ones(outputs.shape)
    for n in range(1, N_HARMONICS + 1):
        total += (2 * np.exp(-(n * std)**2 / 2) * np.cos(n * angle)
                  * ive(n, concentration) / ive(0, concentration))
    return np.log(total)


def posterior_means(scenario, codebook, received):
    """Means of the posterior, from a sum over points all over the region."""
    model = WhitenedModel(scenario, codebook)
    low, high = scenario.roi_bounds_m
    points = qmc.Sobol(3, seed=1).random_base2(LOG2_POINTS) * (high - low) + low
    templates = model.mean(points)
    energy = np.sum(np.abs(templates)**2, axis=(1, 2))
    means = []
    for signals in model.whiten(received):
        outputs = np.einsum('pbs,bs->pb', templates.conj(), signals)
        concentration = 2 * np.abs(outputs)
        value = concentration + np.log(ive(0, concentration))
        value += log_factors(outputs, scenario.band_phase_std_rad)
        value = value.sum(axis=1) - energy
        means.append(np.average(points, axis=0, weights=np.exp(value - value.max())))
    return np.array(means)


def test_the_mean_is_that_of_the_posterior_with_the_prior_of_the_phases(codebook):
    scenario, rng = SCENARIO, np.random.default_rng(3)
    positions = scenario.sample_positions(N_PHASES, rng)
    received = MeasurementModel(scenario, codebook).sample(positions, rng)
    uniform = dataclasses.replace(scenario, band_phase_std_rad=UNIFORM_RAD)
    reference = posterior_means(scenario, codebook, received)
    declared, silent = (
        np.mean(np.sum((make_estimator('bayes', one, codebook).estimate(received).mean
                        - reference)**2, axis=1)) for one in (scenario, uniform))
    assert declared < 0.2 * silent


@pytest.mark.parametrize('phase_std_rad', [0.0, 0.5, UNIFORM_RAD])
def test_the_factors_average_the_series_over_a_wavelength(codebook, phase_std_rad):
    """The carriers are close, so that the average nearly removes a phase that all bands share."""
    scenario = dataclasses.replace(SCENARIO, phase_std_rad=phase_std_rad)
    model = WhitenedModel(scenario, codebook)
    rng = np.random.default_rng(4)
    outputs = rng.uniform(5, 20, (3, 50)) * np.exp(1j * rng.uniform(-np.pi, np.pi, (3, 50)))
    found, offsets_m = BandPhases(model, Unknowns(model)).factors(outputs)
    wavenumbers = 2 * np.pi * np.array(SCENARIO.center_frequencies_hz) / 299792458
    wavelength = 2 * np.pi / wavenumbers.mean()
    ranges = np.linspace(-0.5, 0.5, 200, endpoint=False) * wavelength
    turned = outputs.T[:, None] * np.exp(1j * ranges[:, None] * wavenumbers)
    expected = np.log(np.mean(np.exp(log_factors(turned, 0.8).sum(axis=2)), axis=1))
    np.testing.assert_allclose(found, expected, atol=0.25 if phase_std_rad else 0.05)
    assert np.all(np.abs(offsets_m) < wavelength / 2)
