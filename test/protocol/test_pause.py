"""Pause, resumption and single cycles of the base station."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import STEPS, State
from rhs_isac_ros.protocol.events import PauseRequested, Reply, ResumeRequested, StepRequested


def request(net, event):
    """Dispatch a request to the base station and return its reply."""
    begin = len(net.replies)
    net.dispatch('bs', event)
    (reply,) = net.replies[begin:]
    return reply


def test_a_pause_between_cycles_begins_at_once(network):
    net = network()
    net.run_cycles(2)
    assert request(net, PauseRequested()) == Reply(True, 'paused')
    assert net['bs'].state is State.PAUSED
    assert request(net, PauseRequested()) == Reply(True, 'already paused')
    sent = len(net.log)
    net.run(limit_s=30.0)
    assert [entry.message for entry in net.log[sent:] if entry.sender == 'bs'] == []
    assert net.served() == [1, 1]


@pytest.mark.parametrize('state', STEPS, ids=lambda state: state.value)
def test_a_pause_begins_after_the_cycle(network, state):
    net = network(rest_s=50.0)
    net.run_to(state)
    for _ in range(2):
        assert request(net, PauseRequested()) == Reply(True, 'the pause begins after cycle 1')
    net.run_to(State.PAUSED, limit_s=2.0)
    assert net.served() == [1]
    net.verify()


def test_a_pause_ends_the_wait_for_users(network):
    net = network(0)
    net.run_to(State.BEACONING)
    assert request(net, PauseRequested()) == Reply(True, 'the pause begins after cycle 1')
    net.run_to(State.PAUSED)
    assert net.logged('bs')[-1] == 'paused: no user answered the beacon of cycle 1'


def test_resuming_begins_the_next_cycle(network):
    net = network()
    net.run_cycles(1)
    request(net, PauseRequested())
    net.run(limit_s=20.0)
    assert request(net, ResumeRequested()) == Reply(True, 'resumed')
    assert net['bs'].state is State.BEACONING
    net.run_cycles(3)
    assert net.served() == [1] * 4
    assert request(net, ResumeRequested()) == Reply(True, 'not paused')
    assert 'bs' not in net.counters()
    net.verify()


def test_a_pause_that_has_not_begun_can_be_withdrawn(network):
    net = network(rest_s=0.5)
    net.run_to(State.ESTIMATING)
    request(net, PauseRequested())
    assert request(net, ResumeRequested()) == Reply(True, 'resumed')
    net.run_cycles(1)
    end_s = net.now_s
    net.run_to(State.BEACONING)
    assert net.now_s == pytest.approx(end_s + 0.5, abs=0.01)


def test_a_step_runs_exactly_one_cycle(network):
    net = network(2)
    net.run_cycles(1)
    request(net, PauseRequested())
    for cycle_id in (2, 3, 4):
        assert request(net, StepRequested()) == Reply(True, f'cycle {cycle_id} begins')
        assert request(net, StepRequested()) == Reply(False, f'cycle {cycle_id} has not ended')
        net.run_to(State.PAUSED)
        net.run(limit_s=5.0)
        assert [cycle for cycle, _, _ in net.outcomes()][-1] == cycle_id
        assert len(net.outcomes()) == cycle_id
    assert net.served() == [1, 2, 1, 2]
    net.verify()


def test_a_step_without_users_sends_one_beacon(network):
    net = network(0)
    net.run_to(State.BEACONING)
    request(net, PauseRequested())
    net.run_to(State.PAUSED)
    begin = len(net.log)
    request(net, StepRequested())
    net.run(limit_s=10.0)
    assert net['bs'].state is State.PAUSED
    assert len(net.sent(m.Beacon, begin)) == 1


def test_a_step_requires_a_pause(network):
    net = network()
    net.run_to(State.SOUNDING)
    assert request(net, StepRequested()) == Reply(False, 'not paused; a step requires a pause')
    net.run_cycles(2)
    assert net.served() == [1, 1]


def test_a_paused_base_station_that_lacks_a_role_waits_for_it(network):
    net = network()
    net.run_cycles(1)
    request(net, PauseRequested())
    net.remove('channel')
    assert request(net, StepRequested()) == Reply(False, 'waiting for channel')
    assert net['bs'].state is State.PAUSED
    assert request(net, ResumeRequested()) == Reply(True, 'resumed; waiting for channel')
    assert net['bs'].state is State.WAITING
    net.add('channel')
    net.run_cycles(1)
    assert net.served() == [1, 1]


def test_a_base_station_can_be_paused_before_its_first_cycle(network, codebooks):
    net = network(codebook=None)
    assert request(net, PauseRequested()) == Reply(True, 'paused')
    assert net.logged('bs')[-1] == 'paused'
    assert request(net, StepRequested()) == Reply(False, 'waiting for codebook')
    net.offer(codebooks[0])
    net.run(limit_s=5.0)
    assert net.outcomes() == []
    request(net, StepRequested())
    net.run_to(State.PAUSED)
    assert net.served() == [1]


def test_settings_and_codebook_change_during_a_pause(network, codebooks):
    net = network()
    net.run_cycles(1)
    request(net, PauseRequested())
    net.change('bs', policy='first')
    assert net['bs'].status()['parameter.policy'] == 'first'
    net.offer(codebooks[1])
    request(net, StepRequested())
    net.run_to(State.PAUSED)
    assert net.sent(m.ReceivedSignals)[-1].codebook_id == codebooks[1].id
