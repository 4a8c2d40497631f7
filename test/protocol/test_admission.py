"""Acks that the base station accepts."""

import math

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.admission import Admission, parse_users


def test_all_users_are_allowed_up_to_a_number_unless_some_are_listed():
    admission = Admission('', 50, 3.0)
    assert [user for user in (1, 2, 50, 51, 4097) if admission.allows(user)] == [1, 2, 50]
    admission = Admission('1, 5-9', 50, 3.0)
    assert [*filter(admission.allows, range(1, 12))] == [1, 5, 6, 7, 8, 9]


def test_acks_of_each_user_are_limited_in_each_second_in_bounded_memory():
    admission = Admission('', 4096, 3.0)
    for second in (5.0, 6.0, 900.0):
        for n in range(5):
            assert admission.exceeds_rate(1, second + n / 10) == (n >= 3)
            admission.count(1, second + n / 10)
        assert not admission.exceeds_rate(2, second + 0.9)
    for user in range(1, 4000):
        admission.count(user, 1000 + user / 100)
    assert len(admission._acks) <= 100


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


def test_an_ack_that_is_rejected_does_not_end_beaconing(network):
    net = network(ack_rate_hz=0.5)
    net.run(limit_s=0.5)
    assert net.served() == []
    assert net['bs'].counters['too_often'] == net['bs'].counters['unanswered'] > 0
    assert math.isfinite(net['bs'].next_deadline())
    net.publish(m.Ack(cycle_id=1, user=4097))
    net.run(limit_s=0.01)
    assert net['bs'].counters['not_allowed'] == 1


# Lists of users in texts


@pytest.mark.parametrize(('text', 'users'), [
    ('  ', []), ('1, 4,10 - 12', [1, 4, 10, 11, 12]), ('7-7,4294967295', [7, 4294967295])])
def test_lists_of_users_are_parsed(text, users):
    assert [user for numbers in parse_users(text) for user in numbers] == users


@pytest.mark.parametrize(('text', 'part'), [
    ('0', "'0'"), ('1,', "''"), ('1,x', "'x'"), ('5-3', "'5-3'"), ('4294967296', "'4294967296'")])
def test_a_malformed_part_is_an_error_that_names_it(text, part):
    with pytest.raises(ValueError, match=r'expected numbers from 1 to 4294967295') as raised:
        parse_users(text)
    assert str(raised.value).startswith(part)
