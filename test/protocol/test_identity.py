"""Two nodes with one role or one number never lead to a wrong result or to a lasting outage."""


import pytest
from in_memory_network import Noisy

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState
from rhs_isac_ros.protocol.events import PauseRequested, PeersChanged, Resumed, StoodBy


def grants(net, since=0):
    return [grant.user_instance for grant in net.sent(m.Grant, since=since)]


# Two users with one number


def test_the_first_of_two_users_with_one_number_is_served(network, places):
    net = network()
    net.run_cycles(2)
    net.add_user(1, places[3], '_twin')
    since = len(net.log)
    net.run_cycles(20)
    first, second = (net.instances[name] for name in ('user1', 'user1_twin'))
    assert grants(net, since) == [first] * len(grants(net, since))
    assert net.served() == [1] * 22
    net.verify()
    assert net['bs'].counters['number_taken'] >= 19
    assert {pilot.sender for pilot in net.sent(m.Pilot)} == {first}
    for name in ('bs', 'user1_twin'):
        (text,) = [text for text in net.logged(name) if 'two nodes have this number' in text]
        assert text.startswith('user 1: ') and text.endswith('is served')
        assert 'conflict.user_1' in net[name].status()
    assert not [text for text in net.logged('user1') if 'two nodes' in text]
    assert second not in grants(net)


def test_the_second_user_is_served_when_the_first_has_gone(network, places):
    net = network(2)
    net.add_user(1, places[3], '_twin')
    net.run_cycles(4)
    net.remove('user1')
    net.run(lambda: grants(net)[-1] == net.instances['user1_twin'], limit_s=3.0)
    since = len(net.outcomes())
    net.run_cycles(8)
    assert net.served()[-8:].count(1) == 4
    assert set(net.ends()[since:]) == {'served'}
    net.verify()
    assert net['user1_twin'].status() == {}
    net.run(limit_s=6.0)
    assert 'conflict.user_1' not in net['bs'].status()


@pytest.mark.parametrize(('n_users', 'state', 'limit_s'), [
    *((n, state, 3.0) for n in (1, 2)
      for state in (BsState.BEACONING, BsState.SOUNDING, BsState.ESTIMATING)),
    # A beacon invites eight users.
    (16, BsState.SOUNDING, 10.0)])
def test_a_restarted_user_is_served_soon(network, places, n_users, state, limit_s):
    net = network({user: places[0] for user in range(1, n_users + 1)})
    net.run(lambda: len({*net.served()}) == n_users)
    net.run_to(state)
    net.restart('user1')
    restarted = net.instances['user1']
    net.run(lambda: net.outcomes()[-1][1:] == (1, 'served') and grants(net)[-1] == restarted,
            limit_s)
    assert not [text for name in ('bs', 'user1') for text in net.logged(name)
                if 'two nodes' in text]
    net.verify()


@pytest.mark.parametrize('seed', range(3))
def test_results_of_two_users_with_one_number_are_never_mixed(network, places, seed):
    net = network(2, transport=Noisy(seed, loss=0.05, doubles=0.1, jitter_s=0.02), ordered=False,
                  retries=2)
    net.add_user(1, places[3], '_twin')
    net.run_cycles(15)
    net.restart('user1')
    net.run_cycles(15)
    assert 1 in net.served()
    net.verify()


# Two nodes of the infrastructure


def test_the_signals_of_a_cycle_come_from_one_channel(network):
    net = network(2)
    net.add('channel_twin')
    net.run_cycles(10)
    assert net.served()
    assert net['bs'].counters['wrong_instance'] > 0
    assert net.check_invariants().violations == []
    net.remove('channel')
    net.run_cycles(4)
    assert net.served()[-1:]
    assert net.check_invariants().violations == []


@pytest.mark.parametrize('twin', ['positioner', 'transmission', 'rhs_controller'])
def test_two_nodes_of_another_role_do_no_harm_until_one_stands_by(network, twin):
    net = network(2)
    net.add(f'{twin}_twin')
    net.run_cycles(10)
    net.remove(twin)
    net.run_cycles(4)
    assert set(net.ends()[-3:]) == {'served'}
    net.verify()


def test_the_older_of_two_base_stations_stands_by_and_resumes(network):
    net = network(2)
    net.run_cycles(3)
    net.run_to(BsState.SOUNDING)
    older = net['bs']
    net.add('bs_twin')
    net.dispatch('bs_twin', PeersChanged(()))
    net.run(limit_s=0.05)
    net.dispatch('bs', StoodBy())
    assert (older.state, older.next_deadline()) == (BsState.WAITING, None)
    since = len(net.log)
    net.run_cycles(6)
    assert net.instances['bs'] not in {beacon.sender for beacon in net.sent(m.Beacon, since)}
    assert set(net.ends()[-3:]) == {'served'}
    net.remove('bs_twin')
    last = max(beacon.cycle_id for beacon in net.sent(m.Beacon))
    since = len(net.log)
    net.dispatch('bs', Resumed(last + 1000))
    net.dispatch('bs', PeersChanged(()))
    net.run_cycles(6)
    assert set(net.ends()[-5:]) == {'served'}
    own = [beacon.cycle_id for beacon in net.sent(m.Beacon, since)
           if beacon.sender == net.instances['bs']]
    assert own[0] == min(own) == last + 1000
    # It never uses its own ids again.
    for event in (StoodBy(), Resumed(1), PeersChanged(())):
        net.dispatch('bs', event)
    net.run_cycles(1)
    assert net.sent(m.Beacon)[-1].cycle_id == own[-1] + 1
    net.verify()


def test_a_pause_outlasts_a_time_as_the_older_station(network):
    net = network()
    net.run_cycles(1)
    since = len(net.log)
    for event in (PauseRequested(), StoodBy(), Resumed(1), PeersChanged(())):
        net.dispatch('bs', event)
    net.run(limit_s=10.0)
    assert net['bs'].state is BsState.PAUSED
    assert net.sent(m.Beacon, since) == []
