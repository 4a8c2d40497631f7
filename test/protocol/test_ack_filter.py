"""Acks that the base station accepts."""

import math

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.settings import BaseStationSettings


@pytest.fixture
def accepts(scenario):
    """Function that returns one to test whether an ack of a user at a time is accepted."""
    def make(**settings):
        station = BaseStation(
            scenario, BaseStationSettings(**settings), np.random.default_rng(0), None)

        def accepts(user, now_s=5.0):
            before = station.counters.copy()
            station.handle(m.Ack(cycle_id=0, user=user), now_s)
            reasons = station.counters - before
            return not reasons.keys() & {'not_allowed', 'too_often'}
        return accepts
    return make


def test_all_users_are_allowed_unless_some_are_listed(accepts):
    assert all(map(accepts(), (1, 2, 99, 4096)))
    assert not accepts()(4097)
    assert not accepts(max_users=50)(51)
    assert [*filter(accepts(allowed_users='1, 5-9'), range(1, 12))] == [1, 5, 6, 7, 8, 9]


def test_acks_of_each_user_are_limited_in_each_second(accepts):
    accepted = accepts(ack_rate_hz=3.0)
    for second in (5.0, 6.0, 900.0):
        assert [accepted(1, second + n / 10) for n in range(5)] == [True] * 3 + [False] * 2
        assert accepted(2, second + 0.9)


def test_acks_do_not_fill_the_memory(scenario):
    station = BaseStation(scenario, BaseStationSettings(), np.random.default_rng(0), None)
    for user in range(1, 4000):
        station.handle(m.Ack(cycle_id=0, user=user), user / 100)
    assert len(station._admission._acks) <= 100


def test_a_flood_of_acks_is_counted_and_does_not_affect_other_users(network):
    net = network(2, ack_rate_hz=20.0)
    net.run_cycles(2)
    for _ in range(100):
        net.publish(m.Ack(cycle_id=net.sent(m.Beacon)[-1].cycle_id, user=1))
    net.run(limit_s=0.01)
    assert net['bs'].counters['too_often'] >= 80
    net.run(limit_s=2.0 - net.now_s % 1)
    mark = len(net.served())
    net.run_cycles(4)
    assert sorted(net.served()[mark:]) == [1, 1, 2, 2]


def test_an_ack_beyond_the_rate_does_not_end_beaconing(network):
    net = network(ack_rate_hz=0.5)
    net.run(limit_s=0.5)
    assert net.served() == []
    assert net['bs'].counters['too_often'] == net['bs'].counters['unanswered'] > 0
    assert math.isfinite(net['bs'].next_deadline())
