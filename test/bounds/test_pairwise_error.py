"""The error caused by the confusion of pairs of positions."""

import dataclasses
import math

import numpy as np
import pytest

from rhs_isac_ros.bounds.pairwise_error import PairwiseErrorCost, best_phases
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.multipath import multipath_covariance

N_PAIRS = 9


def make_scenario(noise_psd_dbm_hz):
    return Scenario(
        center_frequencies_hz=(1.2e9, 2e9), n_subbands=2, n_frames=3, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-3,
        noise_psd_dbm_hz=noise_psd_dbm_hz, roi_center_m=(3, 0, 0), roi_size_m=(2, 4, 2))


@pytest.fixture(scope='module')
def scenario():
    """The noise is such that pairs are sometimes confused."""
    return make_scenario(-95)


@pytest.fixture(scope='module')
def codebook(scenario, random_beams):
    return random_beams(scenario, np.random.default_rng(0))


@pytest.fixture(scope='module')
def pairs(scenario):
    return scenario.sample_positions(2 * N_PAIRS, np.random.default_rng(1)).reshape(2, -1, 3)


def plain_distances(p, firsts, seconds, spatial):
    """q of every pair, by its definition."""
    q = np.zeros(len(firsts))
    for i in range(p.scenario.n_bands):
        inverse = np.linalg.inv(p.covariance(i, spatial[i]))
        for n, delta in enumerate(p.mean(firsts, i) - p.mean(seconds, i)):
            q[n] += (delta.conj() @ inverse @ delta).real
    return q


def plain_terms(p, firsts, seconds, spatial):
    """|p - p'|^2 Q(sqrt(q / 2)) of every pair; Q(x) = erfc(x / sqrt(2)) / 2."""
    return np.array([
        math.dist(first, second)**2 * math.erfc(math.sqrt(q / 2) / math.sqrt(2)) / 2
        for first, second, q in zip(
            firsts, seconds, plain_distances(p, firsts, seconds, spatial), strict=True)])


@pytest.fixture(scope='module')
def plain_of(scenario, plain):
    """Callable that takes analog, digital and positions and returns the terms of all pairs."""
    spatial = multipath_covariance(scenario)

    def of(analog, digital, firsts, seconds):
        return plain_terms(plain(scenario, analog, digital), firsts, seconds, spatial)
    return of


def assert_near(outcome, expected, tolerance):
    for actual, wanted in zip(outcome, expected, strict=True):
        assert np.isfinite(actual).all()
        np.testing.assert_allclose(
            actual, wanted, rtol=0, atol=tolerance * np.abs(wanted).max())


def test_the_cost_contains_the_error_probability_of_a_likelihood_decision(
        scenario, codebook, pairs, plain):
    """Signals of the first position are drawn and the likelihoods of both are compared."""
    p = plain(scenario, codebook.analog, codebook.digital)
    rng, n_draws = np.random.default_rng(2), 20_000
    spatial = multipath_covariance(scenario)
    q = plain_distances(p, *pairs, spatial)
    n = int(np.argmin(np.abs(q - 2)))
    ratio = np.zeros(n_draws)
    for i in range(2):
        covariance = p.covariance(i, spatial[i])
        inverse = np.linalg.inv(covariance)
        first, second = p.mean(pairs[:, n], i)
        noise = rng.normal(size=(n_draws, 6, 2)) @ [1, 1j] / np.sqrt(2)
        signals = first + noise @ np.linalg.cholesky(covariance).T
        for sign, mean in ((1, first), (-1, second)):
            offsets = signals - mean
            ratio += sign * np.einsum('na,ab,nb->n', offsets.conj(), inverse, offsets).real
    wrong = np.mean(ratio > 0)
    single = PairwiseErrorCost(scenario, *pairs[:, n:n + 1], tolerance=1e-7)
    expected = single.value(codebook) / math.dist(*pairs[:, n])**2
    assert 0.1 < expected < 0.3
    assert wrong == pytest.approx(expected, abs=4 * math.sqrt(expected / n_draws))


@pytest.mark.slow
@pytest.mark.parametrize('tolerance', [0, 1e-7], ids=['exact', 'compressed'])
@pytest.mark.parametrize('seed', [0, 1, 2])
def test_gradients_are_the_limit_of_differences_of_the_value(
        scenario, pairs, plain_of, random_beams, seed, tolerance, assert_gradients):
    rng = np.random.default_rng(seed)
    codebook = random_beams(scenario, rng)
    weights = rng.uniform(0.2, 3, N_PAIRS)

    def value(analog, digital):
        return np.mean(weights * plain_of(analog, digital, *pairs))

    actual, *gradients = PairwiseErrorCost(
        scenario, *pairs, weights, tolerance=tolerance)(codebook)
    assert actual == pytest.approx(value(codebook.analog, codebook.digital), rel=1e-8)
    assert_gradients(gradients, value, codebook, rng)


@pytest.mark.parametrize('tolerance', [0, 1e-6], ids=['exact', 'compressed'])
def test_a_pair_of_the_same_position_costs_nothing(scenario, codebook, pairs, tolerance):
    expected = PairwiseErrorCost(scenario, *pairs, tolerance=tolerance)(codebook)
    same = np.concatenate([pairs, pairs[[0, 0], :2]], axis=1)
    outcome = PairwiseErrorCost(scenario, *same, tolerance=tolerance)(codebook)
    assert_near(outcome, [x * N_PAIRS / (N_PAIRS + 2) for x in expected], 1e-5)


@pytest.mark.parametrize('tolerance', [0, 1e-6], ids=['exact', 'compressed'])
def test_pairs_with_equal_signals_are_confused_half_of_the_time(
        scenario, codebook, pairs, tolerance):
    """A surface with all elements off receives nothing."""
    dark = Codebook(np.zeros_like(codebook.analog), codebook.digital)
    value, by_analog, by_digital = PairwiseErrorCost(scenario, *pairs, tolerance=tolerance)(dark)
    assert value == pytest.approx(np.mean(np.sum((pairs[0] - pairs[1])**2, axis=1)) / 2, rel=1e-14)
    assert np.isfinite(by_analog).all()
    np.testing.assert_array_equal(by_digital, 0)


@pytest.mark.parametrize('tolerance', [0, 1e-6], ids=['exact', 'compressed'])
@pytest.mark.parametrize('are_equal', [True, False], ids=['equal', 'never confused'])
def test_pairs_without_an_error_cost_nothing_and_cause_no_warning(
        scenario, codebook, pairs, are_equal, tolerance):
    """A position very near the surface cannot be confused with another one."""
    near = np.tile([1e-4, 0.0, 0.0], (N_PAIRS, 1))
    value, by_analog, by_digital = PairwiseErrorCost(
        scenario, pairs[0], pairs[0] if are_equal else near, tolerance=tolerance)(codebook)
    assert value == 0
    np.testing.assert_array_equal(by_analog, 0)
    np.testing.assert_array_equal(by_digital, 0)


@pytest.mark.parametrize(('n_first', 'n_second'), [(0, 0), (3, 2), (1, 3), (2, 0)])
def test_positions_that_are_not_pairs_are_errors(scenario, n_first, n_second):
    with pytest.raises(
            ValueError, match=f'^second_positions: {n_second} positions, expected .* {n_first}, '):
        PairwiseErrorCost(scenario, np.ones((n_first, 3)), np.ones((n_second, 3)))


@pytest.fixture(scope='module')
def many(scenario):
    """The cost of 400 pairs."""
    positions = scenario.sample_positions(800, np.random.default_rng(2)).reshape(2, -1, 3)
    return PairwiseErrorCost(scenario, *positions, tolerance=1e-6)


def test_a_sample_of_all_pairs_has_the_cost_and_the_gradients_of_all_pairs(many, codebook):
    sample = many.sample(codebook, 400, np.random.default_rng(0))
    assert_near(sample(codebook), many(codebook), 1e-5)


@pytest.mark.slow
def test_the_mean_over_samples_is_the_cost_of_all_pairs(many, codebook, random_beams, scenario):
    """Also for another codebook than that of the samples, whose costs scatter more."""
    other = random_beams(scenario, np.random.default_rng(5))
    rng = np.random.default_rng(1)
    samples = [many.sample(codebook, 40, rng) for _ in range(300)]
    for beams, spread in ((codebook, 0.03), (other, 2.0)):
        values = np.array([sample.value(beams) for sample in samples])
        assert values.std() < spread * values.mean()
        assert values.mean() == pytest.approx(
            many.value(beams), abs=4 * values.std() / np.sqrt(len(values)))


@pytest.mark.parametrize('n', [1, 17, 399])
def test_a_sample_holds_each_pair_at_most_once(many, codebook, n):
    sample = many.sample(codebook, n, np.random.default_rng(n))
    assert sample.rows.n_items == n
    coefficients = sample.rows.coefficients[0]
    assert len(np.unique(coefficients, axis=0)) == n
    assert coefficients.dtype == np.complex64


@pytest.mark.parametrize('n', [0, 401])
def test_a_sample_of_another_number_of_pairs_is_an_error(many, codebook, n):
    with pytest.raises(ValueError, match=f'^n: {n}, expected 1 to 400, '):
        many.sample(codebook, n, np.random.default_rng(0))


def test_exact_differences_are_not_sampled(scenario, codebook, pairs):
    with pytest.raises(ValueError, match='^differences: not compressed'):
        PairwiseErrorCost(scenario, *pairs).sample(codebook, 2, np.random.default_rng(0))


@pytest.mark.slow
@pytest.mark.parametrize('phases', [
    {'phase_std_rad': 0.2}, {'phase_std_rad': 6.3}, {'band_phase_std_rad': 0.2},
    {'band_phase_std_rad': 6.3}, {'phase_std_rad': 0.5, 'band_phase_std_rad': 0.5}])
def test_hardly_any_phases_are_better(phases):
    """Compared with a search over all phases."""
    rng, (scales, precision) = (
        np.random.default_rng(0), nuisance_of(Scenario(**phases)).scaled_phases)
    products = rng.exponential(3.0, (50, 2)) * np.exp(2j * np.pi * rng.uniform(size=(50, 2)))
    found, penalties = best_phases(products, scales, precision)
    grid = np.linspace(-np.pi, np.pi, 181)
    if scales.shape[1] == 1:
        every = np.stack([grid, grid], axis=1)
    else:
        every = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    inverse = np.linalg.pinv(scales / precision @ scales.T, rcond=1e-14)

    def cost(theta, penalty):
        return penalty - 2 * np.sum((products * np.exp(-1j * theta)).real, axis=-1)

    least = np.min([cost(theta, theta @ inverse @ theta) for theta in every], axis=0)
    excess = cost(found, penalties) - least
    assert excess.max() < 0.05
    assert np.mean(excess < 1e-3) > 0.9
    np.testing.assert_allclose(
        penalties, np.einsum('na,ab,nb->n', found, inverse, found), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize('tolerance', [0, 1e-7], ids=['exact', 'compressed'])
@pytest.mark.parametrize('phases', [
    {'phase_std_rad': 0.7}, {'phase_std_rad': 0.3, 'band_phase_std_rad': 0.5}])
def test_unknown_phases_minimise_the_distance(
        scenario, codebook, pairs, plain, assert_gradients, phases, tolerance):
    """Compared with the definition, evaluated on a grid of phases."""
    unknown, p = dataclasses.replace(scenario, **phases), plain(
        scenario, codebook.analog, codebook.digital)
    scales, precision = nuisance_of(unknown).scaled_phases
    z = np.stack(np.meshgrid(*[np.linspace(-2.5, 2.5, 41)] * scales.shape[1]), -1).reshape(
        -1, scales.shape[1])
    turns, distances = np.exp(1j * z @ scales.T), np.tile(z**2 @ precision, (N_PAIRS, 1))
    for i, spatial in enumerate(multipath_covariance(scenario)):
        inverse = np.linalg.inv(p.covariance(i, spatial))
        for n, (first, second) in enumerate(zip(p.mean(pairs[0], i), p.mean(pairs[1], i),
                                                strict=True)):
            delta = turns[:, i, None] * first - second
            distances[n] += 2 * np.einsum('za,ab,zb->z', delta.conj(), inverse, delta).real
    expected = np.mean(np.sum((pairs[0] - pairs[1])**2, axis=1) * [
        math.erfc(math.sqrt(least / 8)) / 2 for least in distances.min(axis=1)])
    cost = PairwiseErrorCost(unknown, *pairs, tolerance=tolerance)
    assert cost.value(codebook) == pytest.approx(expected, rel=3e-3)
    assert expected > 1.05 * PairwiseErrorCost(scenario, *pairs).value(codebook)
    value, *gradients = cost(codebook)
    assert value == pytest.approx(cost.value(codebook), rel=1e-8)
    assert_gradients(gradients, lambda **beams: cost.value(Codebook(**beams)), codebook,
                     np.random.default_rng(0))


def test_small_phases_equal_the_linear_model():
    """Minimise |a (1 + i theta) - b|^2 with a prior: theta = 2 Im a^H b / (2 |a|^2 + 1 / s^2)."""
    products, scale = np.array([[4.0 * np.exp(1e-3j)]]), np.array([[0.7]])
    (found,), _ = best_phases(products, scale, np.ones(1))
    assert found[0] == pytest.approx(4e-3 / (4 + 1 / 0.7**2), rel=1e-3)
