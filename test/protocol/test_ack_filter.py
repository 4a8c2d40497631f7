"""Acks that the base station accepts."""

import math

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station_memory import AckFilter, parse_users


@pytest.mark.parametrize(('text', 'users'), [
    ('', []), ('  ', []), ('3', [3]), ('1, 4,10 - 12', [1, 4, 10, 11, 12]),
    ('7-7,4294967295', [7, 4294967295])])
def test_lists_of_users_are_parsed(text, users):
    assert [user for numbers in parse_users(text) for user in numbers] == users


@pytest.mark.parametrize(('text', 'part'), [
    ('0', "'0'"), ('1,', "''"), ('1,x', "'x'"), ('5-3', "'5-3'"), ('-2', "'-2'"),
    ('1;2', "'1;2'"), ('4294967296', "'4294967296'"), ('1.5', "'1.5'")])
def test_a_malformed_part_is_an_error_that_names_it(text, part):
    with pytest.raises(ValueError, match=r'expected numbers from 1 to 4294967295') as raised:
        parse_users(text)
    assert str(raised.value).startswith(part)


def test_all_users_are_allowed_unless_some_are_listed():
    assert all(AckFilter().allows(user) for user in (1, 2, 99))
    listed = AckFilter(parse_users('1, 5-9'))
    assert [user for user in range(1, 12) if listed.allows(user)] == [1, 5, 6, 7, 8, 9]


def test_acks_of_each_user_are_limited_in_each_second():
    acks = AckFilter(rate_hz=3.0)
    for second in (5.0, 6.0, 900.0):
        for n in range(3):
            assert acks.within_rate(1, second + n / 10)
            acks.count(1, second + n / 10)
        assert not acks.within_rate(1, second + 0.9)
        assert acks.within_rate(2, second + 0.9)


def test_checking_the_rate_counts_nothing():
    acks = AckFilter(rate_hz=1.0)
    assert all(acks.within_rate(1, 5.0) for _ in range(3))
    acks.count(1, 5.0)
    assert acks.within_rate(1, 6.0)
    assert not acks.within_rate(1, 5.0)


def test_a_rate_below_one_ack_per_second_allows_none():
    assert not AckFilter(rate_hz=0.5).within_rate(1, 0.0)


def test_unknown_users_do_not_fill_the_memory():
    acks = AckFilter(rate_hz=10.0)
    for user in range(5000):
        acks.count(user, user / 100)
    assert len(acks._acks) <= 100
    for user in range(5000, 9000):
        acks.within_rate(user, 50.0)
    assert len(acks._acks) <= 100


def test_users_that_are_not_allowed_are_neither_served_nor_waited_for(network):
    net = network(2, allowed_users='2')
    net.run_cycles(4)
    assert net.served() == [2] * 4
    assert net['bs'].counters == {'not_allowed': 4}
    net.verify()


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
