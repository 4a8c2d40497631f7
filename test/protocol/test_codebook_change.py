"""A new codebook takes effect with the next cycle, and no cycle mixes two."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import State

pytestmark = pytest.mark.usefixtures('plain_beams')

IN_A_CYCLE = [State.BEACONING, State.CONFIGURING, State.SOUNDING, State.ESTIMATING,
              State.STEERING, State.TRANSMITTING]
WITH_ID = (m.RhsCommand, m.RhsConfiguration, m.ReceivedSignals, m.PositionEstimate, m.Beam,
           m.Capacity)


def ids(network, cycle_id):
    """Return the codebook ids in the messages of a cycle."""
    found = [message for kind in WITH_ID for message in network.sent(kind, cycle_id=cycle_id)]
    assert {type(message) for message in found} == set(WITH_ID)
    return {message.codebook_id for message in found}


@pytest.mark.parametrize('state', [*IN_A_CYCLE, State.RESTING], ids=lambda state: state.value)
def test_a_codebook_takes_effect_with_the_next_cycle(network, codebooks, state):
    net = network(2)
    net.run_cycles(2)
    net.run_to(state)
    net.offer(codebooks[1])
    net.run_cycles(3)
    assert [outcome for _, _, outcome in net.outcomes()] == ['served'] * 5
    first = 3 if state is State.RESTING else 4
    for cycle_id in range(1, 6):
        assert ids(net, cycle_id) == {codebooks[cycle_id >= first].id}
    assert not any('wrong' in reason for c in net.counters().values() for reason in c)
    net.verify()


@pytest.mark.parametrize('state', IN_A_CYCLE, ids=lambda state: state.value)
def test_of_two_codebooks_in_one_cycle_the_last_takes_effect(network, codebooks, state):
    net = network()
    net.run_cycles(1)
    net.run_to(state)
    net.offer(codebooks[1])
    net.offer(codebooks[2])
    net.run_cycles(2)
    assert net.served() == [1, 1, 1]
    assert [ids(net, cycle_id) for cycle_id in (1, 2, 3)] == [
        {codebooks[0].id}, {codebooks[0].id}, {codebooks[2].id}]
    net.verify()


def test_codebooks_may_change_repeatedly(network, codebooks):
    net = network(2)
    for turn in range(12):
        net.run_to(State.SOUNDING)
        net.offer(codebooks[turn % 3])
        net.run_cycles(1)
    assert [outcome for _, _, outcome in net.outcomes()] == ['served'] * 12
    expected = [{codebooks[max(turn - 1, 0) % 3].id} for turn in range(12)]
    assert [ids(net, cycle_id) for cycle_id in range(1, 13)] == expected
    net.verify()


def test_the_codebook_in_use_may_be_offered_again(network, codebooks):
    net = network()
    net.run_cycles(1)
    net.run_to(State.SOUNDING)
    net.offer(codebooks[1])
    net.offer(codebooks[0])
    net.run_cycles(2)
    assert net.served() == [1, 1, 1]
    assert {i for cycle_id in (1, 2, 3) for i in ids(net, cycle_id)} == {codebooks[0].id}


@pytest.mark.parametrize('role', ['rhs_controller', 'positioner', 'transmission'])
def test_a_role_that_receives_the_codebook_late_costs_one_cycle(network, codebooks, role):
    reasons = {'rhs_controller': 'rhs_silent', 'positioner': 'positioner_silent',
               'transmission': 'transmission_silent'}
    net = network()
    net.run_cycles(1)
    handle = net[role].handle
    net[role].handle = lambda event, now_s: []
    net.offer(codebooks[1])
    net[role].handle = handle
    net.run_cycles(1)
    assert net.outcomes()[1:] == [(2, 1, reasons[role])]
    # The controller receives a command for each band.
    assert net[role].counters == {'wrong_codebook': 2 if role == 'rhs_controller' else 1}
    net.offer(codebooks[1])
    net.run_cycles(1)
    assert net.outcomes()[2:] == [(3, 1, 'served')]
    net.verify()


def test_the_base_station_waits_for_a_codebook(network, codebooks, scenario):
    net = network(codebook=None)
    net.run(limit_s=10.0)
    assert net.logged('bs') == ['waiting for codebook']
    assert net.sent(m.Beacon) == []
    net.offer(codebooks[1])
    net.run_cycles(1)
    assert net.served() == [1]
    assert ids(net, 1) == {codebooks[1].id}


def test_a_missing_role_and_a_missing_codebook_are_both_logged(network):
    net = network(codebook=None, absent=['channel'])
    assert net.logged('bs') == ['waiting for channel, codebook']
    net.add('channel')
    assert net.logged('bs')[1:] == ['waiting for codebook']


def test_the_positioner_logs_when_it_is_ready(network, codebooks):
    net = network()
    net.offer(codebooks[1])
    net.offer(codebooks[1])
    assert net.logged('positioner') == [
        f'centre is ready for codebook {c.id} after 0.0 s' for c in codebooks[:2]]


def test_a_codebook_offered_while_nobody_answers_costs_no_cycle(network, codebooks, places):
    """Beaconing without users may last for hours, with a new codebook meanwhile."""
    net = network(0)
    net.run(limit_s=1.0)
    net.offer(codebooks[1])
    net.run(limit_s=1.0)
    net.add_user(1, places[0])
    net.run_cycles(2)
    assert net.outcomes() == [(1, 1, 'served'), (2, 1, 'served')]
    assert ids(net, 1) == ids(net, 2) == {codebooks[1].id}
    net.verify()


def test_a_codebook_offered_twice_while_beaconing_costs_no_cycle(network, codebooks):
    net = network()
    net.run_cycles(1)
    net.offer(codebooks[1])
    net.run_to(State.BEACONING)
    net.offer(codebooks[2])
    net.run_cycles(2)
    assert net.outcomes()[1:] == [(2, 1, 'served'), (3, 1, 'served')]
    net.verify()



def test_no_cycle_is_lost_while_an_estimator_is_built(network, codebooks):
    """The signals of the new codebook wait for it, within the timeout of the base station."""
    net = network(make_s=0.8, step_timeout_s=1.0)
    net.run_cycles(2)
    net.run_to(State.SOUNDING)
    net.offer(codebooks[1])
    net.run_cycles(3)
    assert [outcome for _, _, outcome in net.outcomes()] == ['served'] * 5
    assert [ids(net, cycle_id) for cycle_id in (3, 4, 5)] == [
        {codebooks[0].id}, {codebooks[1].id}, {codebooks[1].id}]
    assert not net['positioner'].counters
    net.verify()


def test_a_slow_estimator_costs_only_cycles_of_its_codebook(network, codebooks):
    net = network(make_s=2.5, step_timeout_s=1.0)
    net.run(limit_s=5.0)
    before = len(net.outcomes())
    net.run_to(State.SOUNDING)
    net.offer(codebooks[1])
    net.run(limit_s=6.0)
    outcomes = [outcome for _, _, outcome in net.outcomes()[before:]]
    lost = outcomes.count('positioner_silent')
    assert 1 <= lost <= 3
    assert outcomes == ['served'] + ['positioner_silent'] * lost + ['served'] * (
        len(outcomes) - lost - 1)
    net.verify()
