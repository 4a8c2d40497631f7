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


@pytest.mark.parametrize(('before', 'state', 'offered', 'used'), [
    # Of two codebooks in one cycle, the last takes effect, even if it is the one in use.
    *(((), state, (1, 2), (0, 0, 2)) for state in IN_A_CYCLE),
    ((), State.SOUNDING, (1, 0), (0, 0, 0)), ((1,), State.BEACONING, (2,), (0, 1, 2))])
def test_the_last_codebook_that_was_offered_takes_effect(
        network, codebooks, before, state, offered, used):
    net = network()
    net.run_cycles(1)
    for number in before:
        net.offer(codebooks[number])
    net.run_to(state)
    for number in offered:
        net.offer(codebooks[number])
    net.run_cycles(2)
    assert net.served() == [1, 1, 1]
    assert [ids(net, cycle_id) for cycle_id in (1, 2, 3)] == [
        {codebooks[number].id} for number in used]
    net.verify()


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
