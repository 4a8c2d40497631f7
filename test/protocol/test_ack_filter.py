"""Whose acks the base station takes."""

import math

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.ack_filter import AckFilter, parse_users


@pytest.mark.parametrize(('text', 'users'), [
    ('', []), ('  ', []), ('3', [3]), ('1, 4,10 - 12', [1, 4, 10, 11, 12]),
    ('7-7,4294967295', [7, 4294967295])])
def test_lists_of_users_are_read(text, users):
    assert [user for numbers in parse_users(text) for user in numbers] == users


@pytest.mark.parametrize(('text', 'part'), [
    ('0', "'0'"), ('1,', "''"), ('1,x', "'x'"), ('5-3', "'5-3'"), ('-2', "'-2'"),
    ('1;2', "'1;2'"), ('4294967296', "'4294967296'"), ('1.5', "'1.5'")])
def test_what_is_no_list_is_an_error_that_names_the_part(text, part):
    with pytest.raises(ValueError, match=r'expected numbers from 1 to 4294967295') as raised:
        parse_users(text)
    assert str(raised.value).startswith(part)


def test_all_are_allowed_unless_some_are_listed():
    assert {AckFilter().refusal(user, 0.0) for user in (1, 2, 99)} == {''}
    gate = AckFilter(parse_users('1, 5-9'))
    refused = [user for user in range(1, 12) if gate.refusal(user, 0.0)]
    assert refused == [2, 3, 4, 10, 11]
    assert gate.refusal(2, 0.0) == 'not_allowed'


def test_so_many_acks_of_each_user_are_taken_in_a_second():
    gate = AckFilter(rate_hz=3.0)
    for second in (5.0, 6.0, 900.0):
        taken = [gate.refusal(1, second + n / 10) for n in range(5)]
        assert taken == ['', '', '', 'too_often', 'too_often']
        assert gate.refusal(2, second + 0.5) == ''


def test_strangers_fill_no_memory():
    gate = AckFilter(rate_hz=10.0)
    for user in range(5000):
        gate.refusal(user, user / 100)
    assert len(gate._acks) <= 100
    listed = AckFilter(parse_users('1'))
    for user in range(2, 5000):
        listed.refusal(user, 0.5)
    assert not listed._acks


def test_the_base_station_neither_serves_nor_awaits_who_is_not_allowed(network):
    net = network(2, allowed_users='2')
    net.run_cycles(4)
    assert net.served() == [2] * 4
    assert net['bs'].counters == {'not_allowed': 4}
    net.verify()


def test_a_user_that_floods_is_counted_and_costs_the_others_nothing(network):
    net = network(2, ack_rate_hz=20.0)
    net.run_cycles(2)
    for _ in range(100):
        net.publish(m.Ack(net.sent(m.Beacon)[-1].cycle_id, 1))
    net.run(limit_s=0.01)
    assert net['bs'].counters['too_often'] >= 80
    net.run(limit_s=2.0 - net.now_s % 1)
    mark = len(net.served())
    net.run_cycles(4)
    assert sorted(net.served()[mark:]) == [1, 1, 2, 2]


def test_an_ack_beyond_the_rate_does_not_end_the_beaconing(network):
    net = network(ack_rate_hz=0.5)
    net.run(limit_s=0.5)
    assert net.served() == []
    assert net['bs'].counters['too_often'] == net['bs'].counters['unanswered'] > 0
    assert math.isfinite(net['bs'].next_deadline())
