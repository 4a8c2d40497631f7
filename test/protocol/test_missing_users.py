"""Users that leave, and users that join late."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import State

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('plain_beams')]


def test_a_late_user_is_waited_for_in_the_next_cycle(network):
    """The first ack ends the beaconing of the first cycle; later acks register their users."""
    net = network(2)
    net.run_cycles(1)
    assert net.served() == [1]
    assert net['bs'].counters == {'late_ack': 1}
    net.run_cycles(4)
    assert net.served() == [1, 2, 1, 2, 1]
    assert net['bs'].counters == {'late_ack': 1}


def beacon_to_grant_s(network, cycle_id):
    times = {type(s.message): s.time_s for s in network.log
             if s.message.cycle_id == cycle_id and isinstance(s.message, m.Beacon | m.Grant)}
    return times[m.Grant] - times[m.Beacon]


def test_a_user_lost_while_positioning_is_not_waited_for(network):
    net = network(2)
    net.run_cycles(2)
    net.run_to(State.SOUNDING)
    assert net.sent(m.Grant)[-1].user == 1
    net.remove('user1')
    net.run_cycles(3)
    assert net.outcomes()[2:] == [(3, 1, 'user_gone'), (4, 2, 'served'), (5, 2, 'served')]
    assert net['bs'].counters['user_gone'] == 1
    assert beacon_to_grant_s(net, 4) < 0.01
    net.add('user1')
    net.run_cycles(3)
    assert net.served()[-3:].count(1) >= 1
    net.verify()


def test_a_user_lost_between_cycles_is_waited_for_three_times(network):
    net = network(2)
    net.run_cycles(4)
    net.remove('user2')
    net.run_cycles(6)
    assert net.served()[4:] == [1] * 6
    waits = [beacon_to_grant_s(net, cycle_id) > 0.09 for cycle_id in range(5, 11)]
    assert waits == [True] * 3 + [False] * 3


def test_waiting_for_a_missing_user_ends_no_cycle_of_another_user(network):
    """The time to wait for acks may exceed the time that a user waits for its grant."""
    net = network(2, ack_timeout_s=3.0)
    net.run_cycles(4)
    net.remove('user2')
    net.run_cycles(5)
    assert {outcome for _, _, outcome in net.outcomes()} == {'served'}
    assert net['user1'].counters == {'not_granted': 3}


@pytest.mark.parametrize('state', [State.ESTIMATING, State.STEERING, State.TRANSMITTING])
def test_a_user_lost_after_positioning_loses_only_its_data(network, state):
    net = network(2)
    net.run_cycles(2)
    net.run_to(state)
    net.remove('user1')
    net.run_cycles(2)
    assert net.outcomes()[2:] == [(3, 1, 'data_lost'), (4, 2, 'served')]
