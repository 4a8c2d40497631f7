"""Pause, resumption and single cycles of the base station."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import STEPS, BsState
from rhs_isac_ros.protocol.events import PauseRequested, Reply, ResumeRequested, StepRequested

PAUSE, RESUME, STEP = PauseRequested(), ResumeRequested(), StepRequested()


def request(net, event):
    """Dispatch a request to the base station and return its reply."""
    net.dispatch('bs', event)
    return net.replies.pop()


@pytest.fixture
def paused(network):
    """A network of two users that is paused after the first cycle."""
    net = network(2)
    net.run_cycles(1)
    assert request(net, PAUSE) == Reply(True, 'paused')
    return net


def test_a_pause_between_cycles_begins_at_once(paused):
    assert paused['bs'].state is BsState.PAUSED
    assert request(paused, PAUSE) == Reply(True, 'already paused')
    sent = len(paused.log)
    paused.run(limit_s=30.0)
    assert [entry.message for entry in paused.log[sent:] if entry.sender == 'bs'] == []


@pytest.mark.parametrize('state', STEPS, ids=lambda state: state.value)
def test_a_pause_begins_after_the_cycle(network, state):
    net = network(rest_s=50.0)
    net.run_to(state)
    assert request(net, STEP) == Reply(False, 'not paused; a step requires a pause')
    for _ in range(2):
        assert request(net, PAUSE) == Reply(True, 'the pause begins after cycle 1')
    net.run_to(BsState.PAUSED, limit_s=2.0)
    assert net.served() == [1]
    assert net.logged('bs') == ['paused after cycle 1']
    net.verify()


def test_a_pause_ends_the_wait_for_users_and_a_step_sends_one_beacon(network):
    net = network(0)
    net.run_to(BsState.BEACONING)
    assert request(net, PAUSE) == Reply(True, 'the pause begins after cycle 1')
    net.run_to(BsState.PAUSED)
    assert net.logged('bs')[-1] == 'paused: no user answered the beacon of cycle 1'
    begin = len(net.log)
    request(net, STEP)
    net.run(limit_s=10.0)
    assert net['bs'].state is BsState.PAUSED
    assert len(net.sent(m.Beacon, begin)) == 1


def test_resuming_begins_the_next_cycle(paused):
    paused.run(limit_s=20.0)
    assert request(paused, RESUME) == Reply(True, 'resumed')
    assert paused['bs'].state is BsState.BEACONING
    paused.run_cycles(3)
    assert paused.ends() == ['served'] * 4
    assert request(paused, RESUME) == Reply(True, 'not paused')
    paused.verify()


def test_a_pause_that_has_not_begun_can_be_withdrawn(network):
    net = network(rest_s=0.5)
    net.run_to(BsState.ESTIMATING)
    request(net, PAUSE)
    assert request(net, RESUME) == Reply(True, 'resumed')
    net.run_cycles(1)
    end_s = net.now_s
    net.run_to(BsState.BEACONING)
    assert net.now_s == pytest.approx(end_s + 0.5, abs=0.01)


def test_a_step_runs_exactly_one_cycle_with_the_latest_settings_and_codebook(paused, codebooks):
    paused.change('bs', policy='first')
    assert paused['bs'].status()['parameter.policy'] == 'first'
    paused.change('bs', policy='round_robin')
    paused.offer(codebooks[1])
    for cycle_id in (2, 3, 4):
        assert request(paused, STEP) == Reply(True, f'cycle {cycle_id} begins')
        assert request(paused, STEP) == Reply(False, f'cycle {cycle_id} has not ended')
        paused.run_to(BsState.PAUSED)
        paused.run(limit_s=5.0)
        assert [cycle for cycle, _, _ in paused.outcomes()] == [*range(1, cycle_id + 1)]
        assert paused.sent(m.ReceivedSignals)[-1].codebook_id == codebooks[1].id
    assert paused.served() == [1, 2, 1, 2]
    paused.verify()


def test_a_paused_base_station_that_lacks_a_role_waits_for_it(paused):
    paused.remove('channel')
    assert request(paused, STEP) == Reply(False, 'waiting for channel')
    assert paused['bs'].state is BsState.PAUSED
    assert request(paused, RESUME) == Reply(True, 'resumed; waiting for channel')
    assert paused['bs'].state is BsState.WAITING
    paused.add('channel')
    paused.run_cycles(1)
    assert paused.ends() == ['served'] * 2


def test_a_base_station_can_be_paused_before_its_first_cycle(network, codebooks):
    net = network(codebook=None)
    assert request(net, PAUSE) == Reply(True, 'paused')
    assert net.logged('bs')[-1] == 'paused'
    assert request(net, STEP) == Reply(False, 'waiting for codebook')
    net.offer(codebooks[0])
    net.run(limit_s=5.0)
    assert net.outcomes() == []
    request(net, STEP)
    net.run_to(BsState.PAUSED)
    assert net.served() == [1]
