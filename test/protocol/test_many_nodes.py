"""Many users as nodes of their own, of which a message wakes only those addressed."""

import collections

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_recipients import OPEN_PERIOD_S
from rhs_isac_ros.protocol.user_scheduler import INVITED

N_USERS = 2 * INVITED


@pytest.fixture
def crowd(network, scenario):
    """A network in which every user has been served, and the messages that users receive."""
    received = collections.defaultdict(list)

    def transport(message, recipient):
        received[recipient].append(message)
        return [(1e-3, message)]
    places = scenario.sample_positions(N_USERS + 1, np.random.default_rng(3))
    net = network({user: places[user - 1] for user in range(1, N_USERS + 1)}, rest_s=0.0,
                  transport=transport)
    net.run(lambda: set(net.served()) == {*range(1, N_USERS + 1)})
    received.clear()
    return net, received, places[-1]


def test_users_receive_few_messages_of_cycles_that_serve_others(crowd):
    net, received, _ = crowd
    first = len(net.served())
    net.run_cycles(2 * N_USERS)
    assert sorted(net.served()[first:]) == sorted(2 * [*range(1, N_USERS + 1)])
    # Without recipients, each user would receive a beacon, a grant, two pilot requests and one
    # downlink message of each cycle.
    n_all = 5 * 2 * N_USERS
    for user in range(1, N_USERS + 1):
        assert len(received[f'user{user}']) < 0.4 * n_all
        assert not net.counters().get(f'user{user}')
    requests = [one for user in range(1, N_USERS + 1) for one in received[f'user{user}']
                if isinstance(one, m.PilotRequest)]
    assert len(requests) == 2 * 2 * N_USERS
    net.verify()


def test_a_new_user_is_served_within_two_rounds(crowd):
    net, _, place = crowd
    begin_s, first = net.now_s, len(net.served())
    net.run_cycles(N_USERS)
    round_s = net.now_s - begin_s
    begin_s, first = net.now_s, len(net.served())
    net.add_user(N_USERS + 1, place)
    net.run(lambda: N_USERS + 1 in net.served()[first:])
    assert net.now_s - begin_s < 2 * round_s + OPEN_PERIOD_S


def test_a_restarted_user_is_invited_as_its_new_instance(crowd):
    net, received, _ = crowd
    net.restart('user5')
    received.clear()
    first = len(net.served())
    net.run(lambda: 5 in net.served()[first:], limit_s=10.0)
    instance = net.instances['user5']
    assert instance in {grant.user_instance for grant in net.sent(m.Grant, user=5)}
    net.verify()


def test_users_outside_of_all_invitations_notice_the_beacons(crowd):
    net, received, _ = crowd
    times_s = []
    for _ in range(2 * N_USERS):
        net.run_cycles(1)
        if any(isinstance(one, m.Beacon) for one in received.pop('user1', ())):
            times_s.append(net.now_s)
    # A cycle takes less than a tenth of a second.
    assert np.diff(times_s).max() < OPEN_PERIOD_S + 0.1
