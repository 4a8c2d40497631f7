"""Multipath of users over their cycles."""

import numpy as np
import pytest

from rhs_isac_ros.model.multipath import multipath_covariance, time_correlation
from rhs_isac_ros.protocol.channel import Fading


def test_the_first_cycle_is_the_draw_of_its_seed_and_without_memory_each_is(scenario):
    fading, other = Fading(scenario, 1), Fading(scenario, 1)
    first = fading.gains(7, 1, 0.0, memory=True)
    np.testing.assert_array_equal(first, other.gains(7, 1, 5.0, memory=False))
    fading.gains(7, 2, 0.01, memory=False)
    np.testing.assert_array_equal(
        fading.gains(7, 1, 0.02, memory=False), first)


def test_gains_do_not_change_without_time_and_forget_over_a_long_time(scenario):
    fading, fresh = Fading(scenario, 3), Fading(scenario, 3)
    first = fading.gains(1, 1, 0.0, memory=True)
    np.testing.assert_array_equal(fading.gains(1, 2, 0.0, memory=True), first)
    much_later = fading.gains(1, 3, 1e9, memory=True)
    np.testing.assert_allclose(
        much_later, fresh.gains(1, 3, 0.0, memory=True),
        atol=1e-3 * np.abs(much_later).max())


def test_users_are_independent(scenario):
    fading, alone = Fading(scenario, 4), Fading(scenario, 4)
    fading.gains(1, 1, 0.0, memory=True)
    np.testing.assert_array_equal(
        fading.gains(2, 2, 0.0, memory=True), alone.gains(2, 2, 0.0, memory=True))


@pytest.mark.parametrize('lag_s', [1e-3, 4e-3, 12e-3])
def test_consecutive_cycles_have_the_correlation_of_equation_4(scenario, lag_s):
    """Over many users: the power stays that of Eq. (2), and the correlation is J0."""
    fading, n = Fading(scenario, 5), 600
    pairs = np.array([
        [fading.gains(user, cycle_id, cycle_id * lag_s, memory=True)[1][0, 0]
         for cycle_id in (1, 2, 3)] for user in range(n)])
    power = np.diagonal(multipath_covariance(scenario)[1]).real
    # Elements are correlated: 600 users give about as many independent samples.
    limit = 5 / np.sqrt(n)
    found = np.mean(np.abs(pairs[:, 2])**2 / power)
    assert found == pytest.approx(1, abs=limit)
    expected = time_correlation(scenario, lag_s)[1]
    assert abs(np.mean(pairs[:, 2] * np.conj(pairs[:, 1]) / power) - expected) < limit
