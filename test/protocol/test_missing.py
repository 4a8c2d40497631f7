"""Roles and users that crash, restart, or are missing at first."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState

ROLE_FAULTS = [
    ('rhs_controller', BsState.CONFIGURING, 'rhs_silent'),
    ('rhs_controller', BsState.ESTIMATING, 'transmission_silent'),
    ('channel', BsState.CONFIGURING, 'channel_silent'),
    ('channel', BsState.SOUNDING, 'channel_silent'),
    ('channel', BsState.ESTIMATING, 'data_lost'),
    ('positioner', BsState.SOUNDING, 'positioner_silent'),
    ('transmission', BsState.SOUNDING, 'transmission_silent'),
]


@pytest.mark.parametrize(('role', 'state', 'reason'), ROLE_FAULTS)
@pytest.mark.parametrize('noticed', [True, False])
def test_a_lost_role_causes_a_timeout_and_may_return(network, role, state, reason, noticed):
    net = network()
    net.run_cycles(1)
    net.run_to(state)
    gone_s = net.now_s
    net.remove(role, noticed)
    net.run_cycles(1)
    assert net.outcomes()[-1] == (2, 1, reason)
    assert net.now_s - gone_s < 1.1
    assert net['bs'].counters == {reason: 1}
    assert net['bs'].state is BsState.RESTING
    net.run(limit_s=10.0)
    if noticed:
        assert net['bs'].state is BsState.WAITING
        assert net['bs'].counters == {reason: 1}
    else:
        assert net['bs'].state is not BsState.WAITING
        assert net['bs'].counters.total() > 5
        assert net.served() == [1]
    net.add(role)
    net.run_cycles(3)
    assert net.served()[-2:] == [1, 1]
    net.verify()


@pytest.mark.parametrize('role', ['rhs_controller', 'positioner', 'transmission', 'channel'])
@pytest.mark.parametrize('state', [
    BsState.BEACONING, BsState.CONFIGURING, BsState.SOUNDING, BsState.ESTIMATING, BsState.STEERING,
    BsState.TRANSMITTING, BsState.RESTING])
def test_a_role_that_restarts_costs_one_cycle_at_most(network, role, state):
    net = network(2)
    net.run_cycles(4)
    net.run_to(state)
    net.restart(role)
    net.run_cycles(4)
    outcomes = [outcome for _, _, outcome in net.outcomes()[4:]]
    assert outcomes[1:] == ['served'] * 3
    net.verify()


@pytest.mark.parametrize('role', ['rhs_controller', 'channel', 'positioner', 'transmission'])
def test_the_base_station_waits_for_a_role_and_logs_it_once(network, role):
    net = network(absent=[role])
    net.run(limit_s=30.0)
    assert net.sent(m.Beacon) == []
    assert net['bs'].state is BsState.WAITING
    assert net.logged('bs') == [f'waiting for {role}']
    net.add(role)
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert net.logged('bs') == [f'waiting for {role}']
    if role == 'channel':
        assert net.counters() == {}
    else:
        assert net.counters() == {'user1': {'no_beacon': 1}}
        assert net.logged('user1')[1:] == ['no beacon for 3 s', 'beacons resumed']


def beacon_to_grant_s(network, cycle_id):
    times = {type(s.message): s.time_s for s in network.log
             if s.message.cycle_id == cycle_id and isinstance(s.message, m.Beacon | m.Grant)}
    return times[m.Grant] - times[m.Beacon]


def test_a_user_lost_while_positioning_is_not_waited_for(network):
    net = network(2)
    net.run_cycles(2)
    net.run_to(BsState.SOUNDING)
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


def test_a_missing_user_is_waited_for_three_times_without_ending_a_cycle_of_another(network):
    """The time to wait for acks may exceed the time that a user waits for its grant."""
    net = network(2, ack_timeout_s=3.0)
    net.run_cycles(4)
    net.remove('user2')
    net.run_cycles(5)
    assert set(net.ends()) == {'served'}
    assert net['user1'].counters == {'not_granted': 3}


@pytest.mark.parametrize('state', [BsState.ESTIMATING, BsState.STEERING, BsState.TRANSMITTING])
def test_a_user_lost_after_positioning_loses_only_its_data(network, state):
    net = network(2)
    net.run_cycles(2)
    net.run_to(state)
    net.remove('user1')
    net.run_cycles(2)
    assert net.outcomes()[2:] == [(3, 1, 'data_lost'), (4, 2, 'served')]
