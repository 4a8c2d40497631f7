"""The nodes of users that receive beacons and grants."""

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_instances import UserInstances
from rhs_isac_ros.protocol.user_recipients import OPEN_PERIOD_S, UserRecipients
from rhs_isac_ros.protocol.user_scheduler import INVITED, UserScheduler

# Users with their own number as the instance of their node, plus this.
INSTANCE = 100


class Station:
    """The parts of a base station that select recipients."""

    def __init__(self, n_users):
        self.users = UserScheduler('round_robin', np.random.default_rng(0))
        self.instances = UserInstances()
        self.recipients = UserRecipients(self.users, self.instances)
        self.cycle_id = 0
        for user in range(1, n_users + 1):
            self.users.register(user)
            self.instances.accept(user, INSTANCE + user)

    def beacon(self, now_s, attempt=0):
        self.cycle_id += not attempt
        self.users.begin_cycle()
        first, last = self.users.invite(attempt)
        return self.recipients.of_beacon(m.Beacon(
            cycle_id=self.cycle_id, attempt=attempt, first_user=first, last_user=last), now_s)

    def serve(self):
        """Let all users answer, and serve one."""
        for user in sorted(self.users.awaited):
            self.users.add_answer(user)
            self.recipients.add_answer(self.cycle_id, self.instances.owner(user))
        return self.users.select()


def test_all_nodes_receive_the_beacons_of_few_users():
    station = Station(INVITED)
    assert [station.beacon(0.001 * n) for n in range(3)] == [()] * 3


def test_the_first_beacon_to_a_range_reaches_all_nodes_and_the_next_only_those_invited():
    station = Station(2 * INVITED)
    recipients = []
    for n in range(2 * INVITED):
        recipients.append(station.beacon(0.001 * n))
        station.serve()
    invited = tuple(range(INSTANCE + 1, INSTANCE + 1 + INVITED))
    others = tuple(number + INVITED for number in invited)
    assert recipients == [(), *[invited] * (INVITED - 1), (), *[others] * (INVITED - 1)]


def test_all_nodes_receive_a_beacon_after_a_while():
    station = Station(2 * INVITED)
    assert station.beacon(0.0) == ()
    assert station.beacon(0.9 * OPEN_PERIOD_S) != ()
    assert station.beacon(OPEN_PERIOD_S) == ()


def test_all_nodes_receive_the_beacon_after_an_unanswered_one():
    station = Station(20 * INVITED)
    station.beacon(0.0)
    assert station.beacon(0.001) != ()
    assert station.beacon(0.002, attempt=1) == ()


@pytest.mark.parametrize('policy', ['round_robin', 'random', 'first'])
def test_each_range_reaches_all_nodes_within_a_round(policy):
    station = Station(4 * INVITED)
    station.users.set_policy(policy)
    open_ranges = set()
    for n in range(40 * INVITED):
        if not station.beacon(0.02 * n):
            open_ranges.add(min(station.users.awaited))
        station.serve()
    assert open_ranges == {1, 1 + INVITED, 1 + 2 * INVITED, 1 + 3 * INVITED}


def test_a_grant_goes_to_the_nodes_that_answered_and_to_those_that_may_have():
    station = Station(2 * INVITED)
    station.beacon(0.0)
    station.users.add_answer(1)
    station.recipients.add_answer(station.cycle_id, INSTANCE + 1)
    # An older node with the number of user 2, and a node in another cycle.
    station.recipients.add_answer(station.cycle_id, 7)
    station.recipients.add_answer(station.cycle_id - 1, 8)
    assert station.recipients.of_grant() == (
        7, *range(INSTANCE + 1, INSTANCE + 1 + INVITED))
    station.serve()
    station.beacon(0.001)
    station.serve()
    assert 7 not in station.recipients.of_grant()
