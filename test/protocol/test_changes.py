"""New settings and codebooks take effect with the next cycle, and no cycle mixes two."""


import pytest
from in_memory_network import on_time

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import STEPS, BsState
from rhs_isac_ros.protocol.events import PeersChanged, StoodBy
from rhs_isac_ros.protocol.settings import PositionerSettings

WITH_ID = (m.RhsCommand, m.RhsConfiguration, m.ReceivedSignals, m.PositionEstimate, m.Beam,
           m.Capacity)
UNFIT = {'estimator': 'neural', 'model_file': 'unfit'}


def status_of(net, role, prefix):
    """Return the status values of a role whose names have a prefix."""
    return {name: value for name, value in net[role].status().items()
            if name.startswith(prefix)}


def ids(network, cycle_id):
    """Return the codebook ids in the messages of a cycle."""
    found = [message for kind in WITH_ID for message in network.sent(kind, cycle_id=cycle_id)]
    assert {type(message) for message in found} == set(WITH_ID)
    return {message.codebook_id for message in found}


def estimators(net):
    """Return the estimator of each cycle, after checking that it is the only one."""
    found = {}
    for estimate in net.sent(m.PositionEstimate):
        assert found.setdefault(estimate.cycle_id, estimate.estimator) == estimate.estimator
    return found


each_state = pytest.mark.parametrize(
    'state', [BsState.RESTING, BsState.BEACONING, *STEPS], ids=lambda state: state.value)


@each_state
def test_codebook_and_settings_take_effect_with_the_next_cycle(network, codebooks, state):
    net = network(2)
    net.run_cycles(2)
    net.run_to(state)
    net.offer(codebooks[1])
    net.change('bs', receiver_noise=False)
    waits = state is not BsState.RESTING
    assert status_of(net, 'bs', 'pending') == (
        {'pending.receiver_noise': 'false'} if waits else {})
    assert status_of(net, 'bs', 'parameter.receiver') == {
        'parameter.receiver_noise': str(waits).lower()}
    net.run_cycles(3)
    assert net.ends() == ['served'] * 5
    assert status_of(net, 'bs', 'pending') == {}
    assert net.logged('bs') == ["settings applied: receiver_noise 'false'"]
    assert not any('wrong' in reason for c in net.counters().values() for reason in c)
    # The reference signals use the noise setting at the time of the grant.
    net.verify()
    first = 4 if waits else 3
    for cycle_id in range(1, 6):
        assert ids(net, cycle_id) == {codebooks[cycle_id >= first].id}
        assert net._noise[cycle_id] == (cycle_id < first)


def test_a_list_of_users_without_any_present_user_can_be_corrected(network):
    net = network(2, allowed_users='99')
    net.run(limit_s=2.0)
    assert net.outcomes() == []
    net.change('bs', allowed_users='2')
    net.run_cycles(2)
    assert net.served() == [2, 2]


@pytest.mark.parametrize(('options', 'state', 'event'), [
    # An unanswered cycle is given up; another base station serves; there is no cycle yet.
    ({'allowed_users': '99'}, BsState.BEACONING, PeersChanged(('positioner',))),
    ({}, BsState.SOUNDING, StoodBy()), ({'codebook': None}, BsState.WAITING, None)])
def test_settings_take_effect_when_no_cycle_follows(network, options, state, event):
    net = network(**options)
    net.run_to(state)
    net.change('bs', policy='random')
    if event:
        net.dispatch('bs', event)
    net.run(limit_s=2.0 if state is BsState.BEACONING else 0.0)
    assert net['bs'].state is BsState.WAITING
    assert status_of(net, 'bs', 'pending') == {}
    assert status_of(net, 'bs', 'parameter.policy') == {'parameter.policy': 'random'}


def test_a_rest_set_in_a_cycle_applies_after_it_and_can_be_shortened(network):
    net = network(rest_s=0.1)
    net.run_to(BsState.STEERING)
    net.change('bs', rest_s=3000.0)
    net.run_cycles(1)
    end_s = net.now_s
    net.run(limit_s=1.0)
    assert net['bs'].state is BsState.RESTING
    net.change('bs', rest_s=29.0)
    net.run_to(BsState.BEACONING)
    assert net.now_s == pytest.approx(end_s + 30.0, abs=0.01)


def test_retries_change_after_the_cycle(network):
    net = network(retries=0, step_timeout_s=1.0)
    net.run_to(BsState.SOUNDING)
    net.transport = lambda message, recipient: []
    net.change('bs', retries=3)
    net.run_cycles(1)
    assert net.outcomes() == [(1, 1, 'user_gone')]
    assert not net.sent(m.PilotRequest)[1:]
    net.transport = on_time
    net.run_to(BsState.SOUNDING)
    net.transport = lambda message, recipient: []
    before = len(net.sent(m.PilotRequest))
    net.run_cycles(1)
    assert len(net.sent(m.PilotRequest)) == before + 3


@each_state
@pytest.mark.parametrize('make_s', [0.0, 0.8])
def test_an_estimator_changes_between_cycles_and_none_is_lost(network, state, make_s):
    net = network(make_s=make_s, step_timeout_s=2.0, begin_s=0.0)
    net.run_cycles(2)
    net.run_to(state)
    net.change('positioner', estimator='ml')
    waiting = {'pending.estimator': 'ml'} if make_s else {}
    assert status_of(net, 'positioner', 'pending') == waiting
    net.run(lambda: not status_of(net, 'positioner', 'pending'))
    net.run_cycles(2)
    assert set(net.ends()) == {'served'}
    names = list(estimators(net).values())
    assert names[:2] == ['centre'] * 2
    assert names == sorted(names) and names[-1] == 'ml'
    found = status_of(net, 'positioner', 'parameter.estimator')
    assert found['parameter.estimator'] == 'ml'
    assert not net['positioner'].counters
    net.verify()


@pytest.mark.parametrize('make_s', [0.0, 0.5])
def test_the_old_estimator_is_kept_if_the_new_one_cannot_be_built(network, make_s):
    net = network(make_s=make_s, step_timeout_s=2.0)
    net.run_cycles(2)
    net.change('positioner', **UNFIT)
    net.run_cycles(10)
    assert set(net.ends()) == {'served'}
    assert set(estimators(net).values()) == {'centre'}
    assert net.kept == [PositionerSettings()]
    assert net.logged('positioner')[1:] == [
        'cannot build estimator neural, keeping bayes: model_file: unfit']
    assert status_of(net, 'positioner', 'pending') == {}
    assert status_of(net, 'positioner', 'failed') == {
        'failed.estimator': 'neural: model_file: unfit'}
    net.change('positioner', estimator='ml')
    assert status_of(net, 'positioner', 'failed') == {}
    net.run(lambda: not status_of(net, 'positioner', 'pending'))
    net.run_cycles(2)
    assert list(estimators(net).values())[-1] == 'ml'


@pytest.mark.slow
def test_the_last_of_several_estimators_is_used(network):
    net = network(make_s=0.5, step_timeout_s=2.0, rest_s=0.5)
    net.run_cycles(1)
    net.change('positioner', estimator='neural')
    net.change('positioner', **UNFIT)
    net.change('positioner', estimator='ml', model_file='')
    net.run(limit_s=10.0)
    assert set(estimators(net).values()) == {'centre', 'ml'}
    # The failure of an estimator that was replaced is not logged.
    assert net.kept == []
    assert not [text for text in net.logged('positioner') if 'cannot build' in text]
    assert status_of(net, 'positioner', 'failed') == {}
    # Reverted while it is built: nothing changes.
    net.change('positioner', estimator='bayes')
    net.change('positioner', estimator='ml')
    assert status_of(net, 'positioner', 'pending') == {}
    net.run(limit_s=5.0)
    assert list(estimators(net).values())[-1] == 'ml'
    net.verify()


@pytest.mark.parametrize('codebook_first', [True, False])
@pytest.mark.parametrize('changed', [{'estimator': 'ml'}, UNFIT])
def test_estimator_and_codebook_change_together(network, codebooks, codebook_first, changed):
    net = network(make_s=0.4, step_timeout_s=2.0)
    net.run_cycles(2)
    net.run_to(BsState.SOUNDING)
    acts = [lambda: net.offer(codebooks[1]), lambda: net.change('positioner', **changed)]
    for act in acts if codebook_first else acts[::-1]:
        act()
    net.run_cycles(15)
    assert set(net.ends()) == {'served'}
    last = net.sent(m.PositionEstimate)[-1]
    assert last.codebook_id == codebooks[1].id
    assert last.estimator == ('ml' if changed is not UNFIT else 'centre')
    estimators(net)
    net.verify()


def test_without_a_codebook_no_estimator_is_requested(network, codebooks):
    net = network(codebook=None)
    net.change('positioner', estimator='ml')
    net.offer(codebooks[0])
    net.run_cycles(1)
    assert list(estimators(net).values()) == ['ml']


def test_impairments_change_when_a_cycle_begins(network):
    net = network()
    net.run_cycles(1)
    net.run_to(BsState.SOUNDING)
    net.change('channel', delay_s=0.2)
    begin_s = net.now_s
    assert status_of(net, 'channel', 'pending') == {'pending.delay_s': '0.2'}
    net.run_cycles(1)
    assert net.now_s - begin_s < 0.2
    net.run_to(BsState.CONFIGURING)
    begin_s = net.now_s
    net.run_cycles(1)
    # Two bands and the data.
    assert net.now_s - begin_s > 0.6
    assert status_of(net, 'channel', 'parameter.delay_s') == {'parameter.delay_s': '0.2'}
    assert status_of(net, 'channel', 'pending') == {}
    net.change('channel', loss_probability=1.0)
    net.run_cycles(1)
    assert net.ends() == ['served'] * 3 + ['channel_silent']


# Codebooks


@pytest.mark.parametrize(('before', 'state', 'offered', 'used'), [
    # Of two codebooks in one cycle, the last takes effect, even if it is the one in use.
    *(((), state, (1, 2), (0, 0, 2)) for state in (BsState.BEACONING, *STEPS)),
    ((), BsState.SOUNDING, (1, 0), (0, 0, 0)), ((1,), BsState.BEACONING, (2,), (0, 1, 2))])
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
    attempts = [beacon.attempt for beacon in net.sent(m.Beacon, cycle_id=1)]
    assert attempts == [*range(net['bs'].counters['unanswered'] + 1)]
    assert [beacon.attempt for beacon in net.sent(m.Beacon, cycle_id=2)] == [0]
    net.verify()


def test_a_base_station_without_users_sends_fewer_beacons(network, places):
    net = network(0)
    net.run(limit_s=4.95)
    assert len(net.sent(m.Beacon)) == 50
    net.run(limit_s=10.0)
    assert len(net.sent(m.Beacon)) == 60
    net.add_user(1, places[0])
    net.run_cycles(2)
    assert net.outcomes() == [(1, 1, 'served'), (2, 1, 'served')]
