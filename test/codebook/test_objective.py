"""Objectives, samples of the region of interest, and pairs of confusable positions."""

import dataclasses
import math

import numpy as np
import pytest

from rhs_isac_ros.bounds import PairwiseErrorCost, crlb
from rhs_isac_ros.codebook import OBJECTIVES, SAMPLINGS, objective, optimize, random_codebook
from rhs_isac_ros.codebook.problem import Problem
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.model.multipath import multipath_covariance


def test_the_relative_error_of_the_average_bound_is_below_a_thousandth(table1, shipped):
    scenario = table1.scenario
    positions = scenario.sample_positions(200, np.random.default_rng(0))
    bound = objective.average_bound(scenario, positions, np.random.default_rng(0))
    for codebook in (shipped, random_codebook(scenario, np.random.default_rng(1))):
        exact = crlb(scenario, codebook, positions).mean()
        assert bound.value(codebook) == pytest.approx(exact, rel=1e-3)


@pytest.mark.parametrize('seed', range(3))
def test_ambiguity_is_the_pairwise_error_cost_of_the_plain_equations(
        scenario, plain, random_beams, seed, monkeypatch):
    """|p - p'|^2 Q(sqrt(q / 2)), with five pairs for each position."""
    monkeypatch.setattr(objective, '_PAIRS_PER_POSITION', 5)
    rng = np.random.default_rng(seed)
    codebook, positions = random_beams(scenario, rng), scenario.sample_positions(4, rng)
    value = objective.ambiguity(scenario, positions, np.random.default_rng(seed)).value(codebook)
    firsts = np.array([position for position in positions for _ in range(5)])
    seconds = objective.draw_confusable(scenario, firsts, np.random.default_rng(seed))
    p = plain(scenario, codebook.analog, codebook.digital)
    inverse = np.linalg.inv(p.covariance(0, multipath_covariance(scenario)[0]))
    total = 0.0
    for a, b in zip(firsts, seconds, strict=True):
        difference = p.mean(a, 0) - p.mean(b, 0)
        q = (difference.conj() @ inverse @ difference).real
        total += np.sum((a - b)**2) * math.erfc(math.sqrt(q / 2) / math.sqrt(2)) / 2
    assert value == pytest.approx(total / 20, rel=1e-3)


PHASES = {'phase_std_rad': 0.4, 'band_phase_std_rad': 0.8}


@pytest.mark.parametrize(('name', 'phases'), [
    *((name, {}) for name in OBJECTIVES), ('ambiguity', PHASES), ('error', PHASES)])
def test_gradients_agree_with_finite_differences(name, phases, random_beams):
    rng = np.random.default_rng(0)
    scenario = Scenario(
        **phases, center_frequencies_hz=(1.8e9, 2.9e9), n_subbands=2, n_frames=2, n_feeds=2,
        elements_per_side=3, max_power_w=0.02, roi_center_m=(3, 0, 0), roi_size_m=(2, 2, 2))
    problem = Problem(scenario, OBJECTIVES[name](
        scenario, scenario.sample_positions(12, rng), rng))
    variables = problem.pack(random_beams(scenario, rng))
    # Move off the bounds, and change the scale of the combining vectors.
    variables[:problem.n_analog] = 0.1 + 0.8 * variables[:problem.n_analog]
    variables[problem.n_analog:] *= 1.9
    value, gradient = problem.value_and_gradient(variables)
    assert value == pytest.approx(problem.value(variables), rel=1e-12)
    # The phases are found by iteration.
    tolerance = 3e-5 if phases else 1e-5
    for _ in range(4):
        direction = rng.normal(size=variables.shape)
        difference = (problem.value(variables + 1e-5 * direction)
                      - problem.value(variables - 1e-5 * direction)) / 2e-5
        assert gradient @ direction == pytest.approx(
            difference, abs=tolerance * np.linalg.norm(gradient) * np.linalg.norm(direction))


def test_error_weights_pairs_by_a_power_of_their_volumes(scenario, random_beams, monkeypatch):
    monkeypatch.setattr(objective, '_PAIRS_PER_POSITION', 5)
    rng = np.random.default_rng(0)
    codebook, positions = random_beams(scenario, rng), scenario.sample_positions(4, rng)
    value = OBJECTIVES['error'](scenario, positions, np.random.default_rng(1)).value(codebook)
    firsts = np.repeat(positions, 5, axis=0)
    seconds = objective.draw_confusable(scenario, firsts, np.random.default_rng(1), objective.WIDE)
    volumes = objective.confusable_volumes(scenario, firsts, seconds, objective.WIDE)
    costs = np.array([PairwiseErrorCost(scenario, a[None], b[None]).value(codebook)
                      for a, b in zip(firsts, seconds, strict=True)])
    expected = np.sum(volumes**0.6 * costs) / np.sum(volumes**0.6)
    assert value == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize('name', ['ambiguity', 'error'])
@pytest.mark.parametrize(('change', 'greater'), [
    ({'band_phase_std_rad': 2 * np.pi}, 1.05), ({'phase_std_rad': 2 * np.pi}, 1.0)])
def test_unknown_phases_raise_the_cost_of_confusions(
        scenario, random_beams, name, change, greater):
    codebook = random_beams(scenario, np.random.default_rng(0))
    positions = scenario.sample_positions(20, np.random.default_rng(1))
    known, unknown = (OBJECTIVES[name](world, positions, np.random.default_rng(2)).value(codebook)
                      for world in (scenario, dataclasses.replace(scenario, **change)))
    assert unknown > greater * known


def test_optimising_the_ambiguity_lowers_it_on_held_out_pairs(scenario):
    result = optimize(scenario, method='lbfgs', objective='ambiguity', n_positions=128, seed=1,
                      max_steps=30)
    rng = np.random.default_rng(99)
    firsts = scenario.sample_positions(1500, rng)
    held_out = PairwiseErrorCost(
        scenario, firsts, objective.draw_confusable(scenario, firsts, rng))
    start = random_codebook(scenario, np.random.default_rng(1))
    bound = optimize(scenario, n_positions=128, seed=1, max_steps=30)
    found = held_out.value(result.codebook)
    assert found < 0.8 * held_out.value(start)
    # Optimising the bound is a different goal.
    assert found < held_out.value(bound.codebook)
    assert bound.codebook.average_crlb_m2 < result.codebook.average_crlb_m2


@pytest.mark.parametrize('name', OBJECTIVES)
def test_the_generator_determines_the_random_pairs(scenario, small, name):
    positions = scenario.sample_positions(5, np.random.default_rng(0))
    one, same, other = (
        OBJECTIVES[name](scenario, positions, np.random.default_rng(seed)).value(small.codebook)
        for seed in (1, 1, 2))
    assert one == same
    assert (one == other) == (name not in ('ambiguity', 'error'))


@pytest.mark.parametrize('name', OBJECTIVES)
def test_an_empty_sample_is_an_error(small, name):
    with pytest.raises(ValueError, match='expected .*at least one'):
        OBJECTIVES[name](small.scenario, np.zeros((0, 3)), np.random.default_rng(0))


def test_nuisance_is_the_bound_with_unknown_phases_and_the_region_as_prior(table1):
    positions = table1.vectors['positions']
    value = OBJECTIVES['nuisance'](
        table1.scenario, positions, np.random.default_rng(0)).value(table1.codebook)
    unknown = dataclasses.replace(table1.scenario, band_phase_std_rad=2 * np.pi)
    expected = crlb(unknown, table1.codebook, positions, region_prior=True).mean()
    assert value == pytest.approx(expected, rel=1e-3)
    assert value > crlb(
        table1.scenario, table1.codebook, positions, region_prior=True).mean()


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


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('n', [1, 2, np.int64(128)])
def test_sobol_puts_one_point_in_each_slice(n, seed):
    low, high = LOPSIDED.roi_bounds_m
    unit = (objective.sobol(LOPSIDED, n, np.random.default_rng(seed)) - low) / (high - low)
    np.testing.assert_array_equal(
        np.sort(np.floor(unit * n), axis=0), np.tile(np.arange(n)[:, None], 3))


@pytest.mark.parametrize('bands', BANDS)
@pytest.mark.parametrize('region', [LOPSIDED, Scenario()], ids=['lopsided', 'table1'])
def test_confusable_positions_differ_and_are_in_the_region(region, bands):
    scenario = dataclasses.replace(region, center_frequencies_hz=BANDS[bands])
    low, high = scenario.roi_bounds_m
    positions = np.vstack([
        scenario.sample_positions(300, np.random.default_rng(0)), scenario.roi_bounds_m])
    before = positions.copy()
    one, same, other = (
        objective.draw_confusable(scenario, positions, np.random.default_rng(seed))
        for seed in (1, 1, 2))
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
    others = objective.draw_confusable(scenario, positions, np.random.default_rng(3))
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
    others = objective.draw_confusable(scenario, positions, np.random.default_rng(3))
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
    others = objective.draw_confusable(scenario, positions, np.random.default_rng(1))
    low, high = scenario.roi_bounds_m
    assert ((others >= low) & (others <= high)).all()
    assert np.mean((others != positions).any(axis=1)) > 0.9


def test_sums_weighted_with_volumes_are_integrals():
    """Of a smooth function about one position, in three dimensions."""
    scenario = dataclasses.replace(WIDE_REGION, center_frequencies_hz=(2.5e9,))
    centre = np.array([50.0, 0, 0])
    positions = np.tile(centre, (60_000, 1))
    others = objective.draw_confusable(
        scenario, positions, np.random.default_rng(3), objective.WIDE)
    volumes = objective.confusable_volumes(scenario, positions, others, objective.WIDE)
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
    others = objective.draw_confusable(scenario, positions, np.random.default_rng(0))
    assert (others[:, 2] == height).all()
    lags = np.abs(np.linalg.norm(others, axis=1) - np.linalg.norm(positions, axis=1))
    lags = lags[(lags > 0.3) & (lags < 15)]
    assert len(lags) > 1000
    period = 0.5995849
    away = np.abs((lags / period + 0.5) % 1 - 0.5) * period
    assert np.mean(away < 0.0125) > 4 * np.mean((away > 0.0375) & (away < 0.05))
