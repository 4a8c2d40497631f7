"""Samples of the region of interest, and pairs of confusable positions."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.codebook import SAMPLINGS
from rhs_isac_ros.codebook.objective import (
    WIDE,
    confusable_volumes,
    draw_confusable,
    sobol,
)
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario

LOPSIDED = Scenario(roi_center_m=(4, 1, -2), roi_size_m=(2, 6, 1))
# Large enough that the lags of a position at its centre are not truncated.
WIDE_REGION = Scenario(roi_center_m=(50, 0, 0), roi_size_m=(90, 90, 90))
BANDS = {'two': (2.5e9, 3.0e9), 'one': (2.5e9,), 'three': (2.0e9, 2.3e9, 3.1e9)}


@pytest.mark.parametrize('n', [1, 2, 3, 64, 100, 1000])
@pytest.mark.parametrize('name', SAMPLINGS)
def test_samples_are_in_the_region_and_depend_on_the_generator(name, n):
    low, high = LOPSIDED.roi_bounds_m
    one, same, other = (
        SAMPLINGS[name](LOPSIDED, n, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one.shape == (n, 3)
    assert one.dtype == np.float64
    assert ((one >= low) & (one <= high)).all()
    assert len(np.unique(one, axis=0)) == n
    np.testing.assert_array_equal(one, same)
    assert not np.isin(one, other).any()


@pytest.mark.parametrize('name', SAMPLINGS)
def test_samples_are_uniform(name):
    low, high = LOPSIDED.roi_bounds_m
    unit = (SAMPLINGS[name](LOPSIDED, 8000, np.random.default_rng(0)) - low) / (high - low)
    np.testing.assert_allclose(unit.mean(axis=0), 0.5, atol=0.015)
    np.testing.assert_allclose(np.cov(unit.T), np.eye(3) / 12, atol=0.004)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('n', [1, 2, 128])
def test_sobol_puts_one_point_in_each_slice(n, seed):
    low, high = LOPSIDED.roi_bounds_m
    unit = (sobol(LOPSIDED, n, np.random.default_rng(seed)) - low) / (high - low)
    np.testing.assert_array_equal(
        np.sort(np.floor(unit * n), axis=0), np.tile(np.arange(n)[:, None], 3))


@pytest.mark.parametrize('n', [100, 256])
def test_sobol_integrates_a_smooth_function_more_accurately(n):
    """(1 + sin x)(2 + y^2) exp(z / 2), whose mean over the region is known."""
    def function(points):
        x, y, z = points.T
        return (1 + np.sin(x)) * (2 + y**2) * np.exp(z / 2)

    (x0, y0, z0), (x1, y1, z1) = LOPSIDED.roi_bounds_m
    exact = (1 + (np.cos(x0) - np.cos(x1)) / (x1 - x0)) * (
        2 + (y1**3 - y0**3) / 3 / (y1 - y0)) * (
        2 * (np.exp(z1 / 2) - np.exp(z0 / 2)) / (z1 - z0))
    spread = {}
    for sample in (Scenario.sample_positions, sobol):
        errors = [function(sample(LOPSIDED, n, np.random.default_rng(seed))).mean() / exact - 1
                  for seed in range(20)]
        spread[sample] = np.sqrt(np.mean(np.square(errors)))
    assert spread[sobol] < 0.3 * spread[Scenario.sample_positions]
    assert spread[Scenario.sample_positions] < 0.2


@pytest.mark.parametrize('bands', BANDS)
@pytest.mark.parametrize('region', [LOPSIDED, Scenario()], ids=['lopsided', 'table1'])
def test_confusable_positions_differ_and_are_in_the_region(region, bands):
    scenario = dataclasses.replace(region, center_frequencies_hz=BANDS[bands])
    low, high = scenario.roi_bounds_m
    positions = np.vstack([
        scenario.sample_positions(300, np.random.default_rng(0)), scenario.roi_bounds_m])
    before = positions.copy()
    one, same, other = (
        draw_confusable(scenario, positions, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(positions, before)
    assert one.shape == positions.shape
    assert ((one >= low) & (one <= high)).all()
    np.testing.assert_array_equal(one, same)
    assert (one != other).any(axis=1).all()
    assert (one != positions).any(axis=1).all()
    lags = np.abs(np.linalg.norm(one, axis=1) - np.linalg.norm(positions, axis=1))
    assert 0.2 < np.mean(lags < 1e-9) < 0.5


def lags_of(bands, n=20_000):
    """Return the range lags below 20 m of positions at the centre of a wide region."""
    scenario = dataclasses.replace(WIDE_REGION, center_frequencies_hz=BANDS[bands])
    positions = np.tile([50.0, 0, 0], (n, 1))
    others = draw_confusable(scenario, positions, np.random.default_rng(3))
    lags = np.linalg.norm(others, axis=1) - 50
    same = np.abs(lags) < 1e-9
    assert same.mean() == pytest.approx(0.3, abs=0.02)
    # Beyond, some were out of the region.
    return lags[~same & (np.abs(lags) < 20)]


@pytest.mark.parametrize('bands', BANDS)
def test_lags_have_the_documented_density(bands):
    """exp(-sum_i (1 - cos 2 pi f_i lag / v_0)), for lags of either sign."""
    lags = lags_of(bands)
    count = len(lags)
    assert count > 3000
    assert np.mean(lags > 0) == pytest.approx(0.5, abs=3 / np.sqrt(count))
    frequencies = np.array(BANDS[bands])[:, None]
    grid = np.linspace(0, 20, 200_000)
    density = np.exp(-np.sum(
        1 - np.cos(2 * np.pi * frequencies * grid / SPEED_OF_LIGHT_MPS), axis=0))
    expected = np.cumsum(density) / density.sum()
    found = np.searchsorted(np.sort(np.abs(lags)), grid, side='right') / count
    # Kolmogorov-Smirnov test; 1.95 is exceeded with a probability of 0.001.
    assert np.abs(found - expected).max() < 1.95 / np.sqrt(count)
    # Mean phase within a period.
    phase = np.exp(2j * np.pi * frequencies * np.abs(lags) / SPEED_OF_LIGHT_MPS).mean(axis=1)
    wanted = (np.exp(2j * np.pi * frequencies * grid / SPEED_OF_LIGHT_MPS) * density).sum(
        axis=1) / density.sum()
    np.testing.assert_allclose(phase, wanted, atol=4 / np.sqrt(count))
    assert (phase.real > 0.3).all()


@pytest.mark.parametrize('side', [5, 20])
def test_confusable_positions_lie_within_a_beam(side):
    """Smaller surfaces have wider beams; the elements are 0.3 wavelengths apart."""
    scenario = dataclasses.replace(WIDE_REGION, elements_per_side=side)
    positions = np.tile([50.0, 0, 0], (5000, 1))
    others = draw_confusable(scenario, positions, np.random.default_rng(3))
    angles = np.arctan2(np.linalg.norm(others[:, 1:], axis=1), others[:, 0])
    wavelengths = SPEED_OF_LIGHT_MPS / np.array([2.5e9, 3e9])
    width = wavelengths.min() / (side * 0.3 * wavelengths.mean())
    assert np.quantile(angles, 0.02) < 0.1 * width
    assert 0.05 * width < np.median(angles) < 0.3 * width
    assert 0.3 * width < angles.max() < 1.7 * width
    # The spread is the same along y and z.
    np.testing.assert_allclose(np.std(others[:, 1]), np.std(others[:, 2]), rtol=0.1)


@pytest.mark.parametrize('size', [(0.02, 0.02, 0.02), (2.0, 1e-3, 1e-3), (1e-6, 4.0, 4.0)])
def test_thin_regions_have_confusable_pairs(size):
    scenario = Scenario(roi_size_m=size)
    positions = scenario.sample_positions(200, np.random.default_rng(0))
    others = draw_confusable(scenario, positions, np.random.default_rng(1))
    low, high = scenario.roi_bounds_m
    assert ((others >= low) & (others <= high)).all()
    assert np.mean((others != positions).any(axis=1)) > 0.9


def test_sums_weighted_with_volumes_are_integrals():
    """Of a smooth function about one position, in three dimensions."""
    scenario = dataclasses.replace(WIDE_REGION, center_frequencies_hz=(2.5e9,))
    centre = np.array([50.0, 0, 0])
    positions = np.tile(centre, (60_000, 1))
    others = draw_confusable(scenario, positions, np.random.default_rng(3), WIDE)
    volumes = confusable_volumes(scenario, positions, others, WIDE)
    scale = np.array([12.0, 8.0, 8.0])

    def average(shift):
        """Gaussians whose integrals are equal."""
        return np.mean(volumes * np.exp(-np.sum(((others - centre - shift) / scale)**2, axis=1)))

    inner = average(np.zeros(3))
    for shift in ([6.0, 0, 0], [0, 4.0, 0], [0, 0, -4.0], [-6.0, 3.0, 0]):
        assert average(np.array(shift)) == pytest.approx(inner, rel=0.2)


@pytest.mark.parametrize('height', [0.0, 1.5])
def test_pairs_in_a_flat_region_keep_their_height_and_their_lags(height):
    """Range lags are whole periods of the bands, as in a region with an extent."""
    scenario = Scenario(roi_center_m=(50, 0, height), roi_size_m=(40, 40, 0))
    positions = np.tile([50.0, 0, height], (4000, 1))
    others = draw_confusable(scenario, positions, np.random.default_rng(0))
    assert (others[:, 2] == height).all()
    lags = np.abs(np.linalg.norm(others, axis=1) - np.linalg.norm(positions, axis=1))
    lags = lags[(lags > 0.3) & (lags < 15)]
    assert len(lags) > 1000
    period = 0.5995849
    away = np.abs((lags / period + 0.5) % 1 - 0.5) * period
    assert np.mean(away < 0.0125) > 4 * np.mean((away > 0.0375) & (away < 0.05))
