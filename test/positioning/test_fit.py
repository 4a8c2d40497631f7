"""Signals that the model cannot explain at any position give no fix."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator, simulate_pairs
from rhs_isac_ros.positioning.alternatives import rejection
from rhs_isac_ros.positioning.fit import (
    FALSE_ALARM,
    FitTest,
)
from rhs_isac_ros.positioning.outside import OUTSIDE_LIMIT, Outside


@pytest.fixture(scope='module', params=['bayes', 'ml'])
def setting(request, random_beams):
    """A scenario with strong signals, a codebook and an estimator."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook = random_beams(scenario, np.random.default_rng(1))
    return scenario, codebook, make_estimator(request.param, scenario, codebook)


def assert_no_fix(estimate, message):
    assert not estimate.fix.any()
    assert np.isnan(estimate.mean).all()
    assert np.isnan(estimate.covariance).all()
    reasons = [estimate.reason] if isinstance(estimate.reason, str) else estimate.reason
    assert len(reasons) == np.size(estimate.fix)
    for reason in reasons:
        assert message in reason
        assert 'expected at ' in reason


def test_limits_are_quantiles_of_the_chi_square_distribution():
    test = FitTest(64)
    assert 2 * test.min_energy == pytest.approx(chi2.ppf(FALSE_ALARM, 128))
    assert 2 * test.max_residual == pytest.approx(chi2.isf(FALSE_ALARM, 128))
    for check, limit, sign in ((test.min_energy_test, test.min_energy, -1),
                               (test.residual_test, test.max_residual, 1)):
        assert check(limit * (1 - 1e-6 * sign)) == ''
        assert check(limit * (1 + 1e-6 * sign)) != ''


def test_weak_signals_are_a_direct_path_or_nothing():
    """Multipath may be weaker than in the model, as in an empty hall."""
    test = FitTest(64)
    assert test.weak_test(1.0, 0.1) == ''
    assert test.weak_test(test.min_energy, 1e3) == ''
    assert 'expected at most 0.723 of signals weaker' in test.weak_test(1.0, 0.8)


def test_users_without_multipath_keep_their_fix(setting):
    scenario, codebook, estimator = setting
    empty = dataclasses.replace(scenario, multipath_to_los_db=-60.0)
    positions = scenario.sample_positions(60, np.random.default_rng(5))
    received = simulate_received(empty, codebook, positions, np.random.default_rng(6))
    estimate = estimator.estimate(received)
    assert estimate.fix.all()
    errors = estimate.mean - positions
    distances = np.einsum(
        'na,na->n', errors, np.linalg.solve(estimate.covariance, errors[..., None])[..., 0])
    assert np.mean(distances <= chi2.ppf(0.95, 3)) > 0.95


def test_the_largest_energy_is_that_of_the_strongest_position_with_noise():
    test = FitTest(64)
    limit = (np.sqrt(500.0) + np.sqrt(test.max_residual))**2
    assert test.max_energy_test(limit * 0.999, 500.0) == ''
    assert f'expected at most {limit:.3g}' in test.max_energy_test(limit * 1.001, 500.0)


@pytest.mark.parametrize('factor', [0.0, 1e-30, 1e-3], ids=str)
def test_signals_weaker_than_noise_give_no_fix(setting, factor):
    scenario, codebook, estimator = setting
    received = factor * simulate_pairs(scenario, codebook, 1, 0)[1][0]
    assert_no_fix(estimator.estimate(received), 'energy')


@pytest.mark.parametrize('position', [(4.0, 0.0, 1.5), (4.0, -3.0, 0.0), (2.0, 0.0, 0.0)], ids=str)
def test_a_user_far_outside_the_region_gives_no_fix(setting, position):
    scenario, codebook, estimator = setting
    received = simulate_received(
        scenario, codebook, np.tile(position, (4, 1)), np.random.default_rng(0))
    assert_no_fix(estimator.estimate(received), 'residual')


def test_signals_of_another_codebook_give_no_fix(setting, random_beams):
    scenario, _, estimator = setting
    other = random_beams(scenario, np.random.default_rng(2))
    assert_no_fix(estimator.estimate(simulate_pairs(scenario, other, 20, 0)[1]), 'residual')


@pytest.mark.parametrize('change', [
    lambda received: 3 * received,
    lambda received: received.conj(),
    lambda received: received[:, ::-1],
    lambda received: received * np.exp(2j * np.pi * np.arange(received.shape[2]) / 7),
], ids=['amplified', 'conjugate', 'bands swapped', 'rotating phase'])
def test_distorted_signals_give_no_fix(setting, change):
    scenario, codebook, estimator = setting
    received = simulate_pairs(scenario, codebook, 20, 0)[1]
    assert_no_fix(estimator.estimate(change(received)), 'residual')


def test_a_user_who_is_almost_certainly_outside_is_rejected():
    assert rejection(Outside, OUTSIDE_LIMIT) == ''
    assert rejection(Outside, 0.995) == (
        'position outside of the region: probability 0.995, expected at most 0.99')


def test_valid_signals_are_located_beside_invalid_ones(setting):
    scenario, codebook, estimator = setting
    positions, received = simulate_pairs(scenario, codebook, 6, 0)
    expected = estimator.estimate(received)
    received[[1, 4]] = 0
    estimate = estimator.estimate(received)
    assert estimate.fix.tolist() == [True, False, True, True, False, True]
    # Sums over a batch depend on its size in the last digits.
    np.testing.assert_allclose(
        estimate.mean[estimate.fix], expected.mean[estimate.fix], rtol=0, atol=1e-9)
    assert [bool(reason) for reason in estimate.reason] == (~estimate.fix).tolist()
    assert np.linalg.norm(estimate.mean - positions, axis=1)[estimate.fix].max() < 0.1


def test_all_valid_signals_are_located(table1_estimator, shipped):
    """Signals of Table I are weak or strong; each test rejects one in 10^9."""
    received = simulate_pairs(Scenario(), shipped, 300, 5)[1]
    assert table1_estimator.estimate(received).fix.all()
