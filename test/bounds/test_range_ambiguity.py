"""Confusion of ranges, compared with the plain definition and with known periods."""

import dataclasses
import math

import numpy as np
import pytest

from rhs_isac_ros.bounds.range_ambiguity import range_confusion_error, range_confusion_error_of
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, MeasurementModel, Scenario

ENERGIES = np.array([5.0, 30.0])


def plain_error(frequencies, energies, max_lag):
    """Sum w r^2 / (1/2 + sum w) over the minima of the mismatch on a fine grid."""
    lags = np.linspace(0, max_lag, 40_000)
    mismatch = sum(1 - np.cos(2 * np.pi * f * lags / SPEED_OF_LIGHT_MPS) for f in frequencies)
    minima = [n for n in range(1, len(lags) - 1)
              if mismatch[n] <= mismatch[n - 1] and mismatch[n] < mismatch[n + 1]]
    total = 0.0
    for energy in energies:
        weights = [2 * (1 - lags[n] / max_lag) * math.erfc(
            math.sqrt(energy * mismatch[n] / len(frequencies) / 2)) / 2 for n in minima]
        squares = [weight * lags[n]**2 for weight, n in zip(weights, minima, strict=True)]
        total += sum(squares) / (0.5 + sum(weights))
    return total / len(energies)


@pytest.mark.parametrize('frequencies', [
    (2.5e9,), (2.5e9, 3e9), (2.5e9, 2.55e9, 2.7e9, 3e9), (2e9, 2.02e9, 2.06e9)])
def test_the_error_is_that_of_the_definition(frequencies):
    (error,) = range_confusion_error(np.array([frequencies]), ENERGIES, 12.0)
    assert error == pytest.approx(plain_error(frequencies, ENERGIES, 12.0), rel=0.02)


def test_each_plan_of_many_has_its_own_error():
    rng = np.random.default_rng(0)
    plans = np.sort(rng.uniform(2.5e9, 3e9, size=(300, 3)), axis=1)
    errors = range_confusion_error(plans, ENERGIES, 12.0)
    for row in (0, 127, 128, 299):
        assert errors[row] == pytest.approx(
            range_confusion_error(plans[[row]], ENERGIES, 12.0)[0], rel=0.05)


def test_unequal_spacing_has_the_lower_error():
    equal, unequal = range_confusion_error(
        1e9 * np.array([[2.5, 2.6, 2.7, 2.8], [2.5, 2.52, 2.57, 2.8]]), 50 + 0 * ENERGIES, 12.0)
    assert unequal < 0.1 * equal


@pytest.fixture(scope='module')
def scenario():
    return Scenario(n_subbands=2, n_frames=2, n_feeds=2, elements_per_side=4,
                    roi_size_m=(8, 6, 2))


def error_of(scenario, n=40):
    model = MeasurementModel(scenario, random_codebook(scenario, np.random.default_rng(0)))
    positions = scenario.sample_positions(n, np.random.default_rng(1))
    return range_confusion_error_of(model, positions, np.random.default_rng(2))


def test_bands_that_repeat_within_the_region_are_confused(scenario):
    """50 MHz repeat after 6 m, 500 MHz after 0.6 m; 20 MHz after 15 m, beyond the region."""
    bands = [(2.5e9, 3e9), (2.5e9, 2.52e9)]
    often, never = (error_of(dataclasses.replace(scenario, center_frequencies_hz=pair))
                    for pair in bands)
    assert often > 0.1
    assert error_of(dataclasses.replace(scenario, center_frequencies_hz=bands[0],
                                        noise_psd_dbm_hz=-100.0)) > often
    assert never != often


def test_a_strong_signal_without_multipath_is_not_confused(scenario):
    clear = dataclasses.replace(
        scenario, center_frequencies_hz=(2.5e9, 2.52e9, 2.58e9, 2.9e9), multipath_to_los_db=-60.0,
        noise_psd_dbm_hz=-190.0)
    assert error_of(clear) < 1e-6


def test_a_region_shorter_than_a_wavelength_has_no_confused_ranges(scenario):
    assert error_of(dataclasses.replace(scenario, roi_size_m=(0.02, 0.02, 0.02))) == 0
