"""Messages under way, and the multipath of users over their cycles."""

import numpy as np
import pytest

from rhs_isac_ros.model.multipath import multipath_covariance, time_correlation
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Delivery, Fading
from rhs_isac_ros.protocol.settings import Impairments


def through(n, **impairments):
    """Return the cycle ids of n messages sent at time 0, as they arrive, and what was counted."""
    delivery = Delivery(np.random.default_rng(0))
    counted = [delivery.send(m.Beacon(cycle_id=cycle, attempt=0), Impairments(**impairments), 0.0)
               for cycle in range(n)]
    return [message.cycle_id for message in delivery.arrived(np.inf)], counted


def test_without_impairments_messages_arrive_at_once_in_order():
    assert through(50) == ([*range(50)], [''] * 50)
    assert through(50, delay_s=0.5)[0] == [*range(50)]


def test_losses_and_duplicates_have_their_probabilities_and_are_counted():
    arrived, counted = through(5000, loss_probability=0.2, double_probability=0.1)
    lost = 5000 - len(set(arrived))
    doubled = len(arrived) - len(set(arrived))
    assert counted.count('emulated_loss') == lost
    assert counted.count('emulated_double') == doubled
    # Four standard deviations of the binomial.
    assert abs(lost - 1000) < 4 * np.sqrt(5000 * 0.2 * 0.8)
    assert abs(doubled - 400) < 4 * np.sqrt(4000 * 0.1 * 0.9)
    assert len(arrived) <= 2 * len(set(arrived))


def test_messages_are_delayed_at_random_and_reordered():
    delivery = Delivery(np.random.default_rng(0))
    delivery.send(m.Beacon(cycle_id=1, attempt=0), Impairments(delay_s=0.5, jitter_s=0.2), 10.0)
    due_s = delivery.in_flight[0][0]
    assert 10.5 <= due_s <= 10.7
    assert delivery.arrived(due_s - 1e-6) == []
    (message,) = delivery.arrived(due_s)
    assert message.cycle_id == 1
    assert delivery.arrived(np.inf) == []
    arrived, _ = through(100, delay_s=0.5, jitter_s=0.2)
    assert sorted(arrived) == [*range(100)]
    assert arrived != sorted(arrived)


def test_impairments_of_messages_are_independent():
    some, more = (set(through(1000, loss_probability=p)[0]) for p in (0.3, 0.1))
    assert some < more


# Multipath


def test_the_first_cycle_is_the_draw_of_its_seed_and_without_memory_each_is(scenario):
    fading, other = Fading(scenario, 1), Fading(scenario, 1)
    first = fading.gains(7, 1, 0.0, memory=True)
    np.testing.assert_array_equal(first, other.gains(7, 1, 5.0, memory=False))
    fading.gains(7, 2, 0.01, memory=False)
    np.testing.assert_array_equal(fading.gains(7, 1, 0.02, memory=False), first)
    # Users are independent.
    np.testing.assert_array_equal(
        fading.gains(2, 2, 0.0, memory=True), Fading(scenario, 1).gains(2, 2, 0.0, memory=True))


def test_gains_do_not_change_without_time_and_forget_over_a_long_time(scenario):
    fading, fresh = Fading(scenario, 3), Fading(scenario, 3)
    first = fading.gains(1, 1, 0.0, memory=True)
    np.testing.assert_array_equal(fading.gains(1, 2, 0.0, memory=True), first)
    much_later = fading.gains(1, 3, 1e9, memory=True)
    np.testing.assert_allclose(
        much_later, fresh.gains(1, 3, 0.0, memory=True),
        atol=1e-3 * np.abs(much_later).max())


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
