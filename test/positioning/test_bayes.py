"""The posterior mean and covariance."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import qmc

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import MeasurementModel, Scenario, simulate_received
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.positioning import ESTIMATORS, SignalError, make_estimator


@pytest.fixture(scope='module')
def trial(table1_estimator, shipped):
    """Signals from 200 positions of Table I, and what the estimator makes of them."""
    scenario, rng = Scenario(), np.random.default_rng(0)
    positions = scenario.sample_positions(200, rng)
    received = simulate_received(scenario, shipped, positions, rng)
    return positions, received, table1_estimator.estimate(received)


def normalised(errors, covariances):
    return np.einsum('nu,nu->n', errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def test_error_on_table_1_is_small_and_known(trial):
    """The estimate's own covariance describes its errors: three coordinates, so 3 on average."""
    positions, _, estimate = trial
    errors = estimate.mean - positions
    assert np.mean(np.sum(errors**2, axis=1)) < 1.35
    assert 2 < normalised(errors, estimate.covariance).mean() < 4.5
    # No bias: the mean error is within what 200 such errors allow.
    assert (np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(200)).all()


def test_likely_places_beyond_the_region_do_not_hide_those_inside(table1):
    """In this phase the likelihood is highest 1.7 m below the region, by e^10 over the truth.

    Where that hides the modes inside, what remains is a place 5 m away, sure to millimetres.
    """
    rng = np.random.default_rng(17)
    positions = table1.scenario.sample_positions(200, rng)
    received = simulate_received(table1.scenario, table1.codebook, positions, rng)[83]
    estimate = make_estimator('bayes', table1.scenario, table1.codebook).estimate(received)
    error = estimate.mean - positions[83]
    assert normalised(error[None], estimate.covariance[None])[0] < 100


def test_covariances_are_symmetric_and_positive_definite(trial):
    _, _, estimate = trial
    assert estimate.mean.shape == (200, 3)
    assert estimate.covariance.shape == (200, 3, 3)
    np.testing.assert_allclose(
        estimate.covariance, np.swapaxes(estimate.covariance, 1, 2), rtol=1e-12, atol=1e-15)
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0


def test_means_lie_in_the_region(trial):
    low, high = Scenario().roi_bounds_m
    assert (trial[2].mean >= low - 1e-9).all()
    assert (trial[2].mean <= high + 1e-9).all()


def test_one_phase_gives_the_same_as_in_a_batch(trial, table1_estimator):
    _, received, estimate = trial
    for n in (0, 77):
        alone = table1_estimator.estimate(received[n])
        assert alone.mean.shape == (3,)
        assert alone.covariance.shape == (3, 3)
        np.testing.assert_allclose(alone.mean, estimate.mean[n], rtol=1e-9)
        np.testing.assert_allclose(alone.covariance, estimate.covariance[n], rtol=1e-6)


def test_an_empty_batch_gives_empty_estimates(trial, table1_estimator):
    estimate = table1_estimator.estimate(trial[1][:0])
    assert estimate.mean.shape == (0, 3)
    assert estimate.covariance.shape == (0, 3, 3)


@pytest.fixture(scope='module')
def clear(random_beams):
    """Little scattering and three bands, which leave one mode alone."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook = random_beams(scenario, np.random.default_rng(1))
    return scenario, codebook, make_estimator('bayes', scenario, codebook)


def test_strong_signals_give_the_position(clear):
    scenario, codebook, estimator = clear
    rng = np.random.default_rng(2)
    positions = scenario.sample_positions(40, rng)
    received = simulate_received(scenario, codebook, positions, rng)
    estimate = estimator.estimate(received)
    errors = estimate.mean - positions
    assert np.linalg.norm(errors, axis=1).max() < 0.1
    assert 1.5 < normalised(errors, estimate.covariance).mean() < 5
    quiet = estimator.estimate(MeasurementModel(scenario, codebook).mean(positions))
    assert np.linalg.norm(quiet.mean - positions, axis=1).max() < 0.02


def test_a_position_just_outside_the_region_gives_one_inside(clear):
    scenario, codebook, estimator = clear
    low, high = scenario.roi_bounds_m
    outside = np.array([[4.0, 0.0, high[2] + 0.01], [4.0, low[1] - 0.01, 0.0]] * 5)
    received = simulate_received(scenario, codebook, outside, np.random.default_rng(3))
    estimate = estimator.estimate(received)
    assert estimate.fix.all()
    assert np.linalg.norm(estimate.mean - outside, axis=1).max() < 0.1
    assert (estimate.mean >= low - 1e-9).all()
    assert (estimate.mean <= high + 1e-9).all()
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0


def test_moments_are_those_of_a_brute_force_posterior(plain, random_beams):
    """Weighs 65 536 even points of a small region with the plain likelihood.

    The estimator takes every mode for a Gaussian, so that single phases differ; over 40 phases
    its mean must be nearly the best one, and its variance the posterior's.
    """
    scenario = Scenario(n_subbands=2, elements_per_side=4, roi_center_m=(4, 0, 0),
                        roi_size_m=(1, 1, 0.5))
    rng = np.random.default_rng(1)
    codebook = random_beams(scenario, rng)
    received = simulate_received(scenario, codebook, scenario.sample_positions(40, rng), rng)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)

    p = plain(scenario, codebook.analog, codebook.digital)
    points = qmc.Sobol(3, seed=5).random(2**16) * [1, 1, 0.5] + [3.5, -0.5, -0.25]
    spatial = multipath_covariance(scenario)
    logarithm = np.zeros((40, 2**16))
    for band in range(2):
        means = p.mean(points, band)
        weighed = np.linalg.solve(p.covariance(band, spatial[band]), means.T).T
        energy = np.sum(means.conj() * weighed, axis=1).real
        logarithm += 2 * (received[:, band] @ weighed.conj().T).real - energy
    weights = np.exp(logarithm - logarithm.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    means = weights @ points
    covariances = np.array([np.cov(points.T, aweights=w, ddof=0) for w in weights])

    variance = np.trace(covariances, axis1=1, axis2=2)
    own_variance = np.trace(estimate.covariance, axis1=1, axis2=2)
    excess = np.sum((estimate.mean - means)**2, axis=1)
    assert excess.mean() < 0.12 * variance.mean()
    assert 0.85 < own_variance.mean() / variance.mean() < 1.15
    assert (own_variance < 2 * variance).all()
    assert (own_variance > variance / 2).all()
    # Every entry of the mean covariance, in units of the standard deviations.
    expected = covariances.mean(axis=0)
    deviation = np.sqrt(np.diag(expected))
    difference = (estimate.covariance.mean(axis=0) - expected) / np.outer(deviation, deviation)
    assert np.abs(difference).max() < 0.2


@pytest.mark.parametrize(('signals', 'words'), [
    (np.zeros((2, 31)), r'^received: shape \(2, 31\), expected \[N_B, N_SB F\] = \(2, 32\)'),
    (np.zeros(64), r'^received: shape \(64,\), expected '),
    (np.full((2, 32), np.nan), '^received: not finite, expected ')])
def test_signals_that_cannot_be_used_are_errors(table1_estimator, signals, words):
    with pytest.raises(SignalError, match=words):
        table1_estimator.estimate(signals)


def test_all_estimators_are_named_in_the_error_for_an_unknown_one(small):
    with pytest.raises(ValueError, match="estimator: 'oracle', expected one of") as caught:
        make_estimator('oracle', small.scenario, small.codebook)
    for name in ESTIMATORS:
        assert repr(name) in str(caught.value)


def test_a_codebook_that_does_not_fit_is_an_error(small):
    scenario = dataclasses.replace(small.scenario, n_feeds=3)
    with pytest.raises(CodebookError, match='digital: shape'):
        make_estimator('bayes', scenario, small.codebook)


def test_names_are_those_of_the_estimators():
    assert {name: kind.name for name, kind in ESTIMATORS.items()} == {
        name: name for name in ESTIMATORS}
    assert 'bayes' in ESTIMATORS
