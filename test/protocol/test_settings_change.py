"""New settings take effect with the next cycle, and no cycle mixes two."""

import dataclasses

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import State
from rhs_isac_ros.protocol.events import PeersChanged, StoodBy
from rhs_isac_ros.protocol.settings import Impairments, PositionerSettings

pytestmark = pytest.mark.usefixtures('plain_beams')

IN_A_CYCLE = [State.CONFIGURING, State.SOUNDING, State.ESTIMATING, State.STEERING,
              State.TRANSMITTING]
UNFIT = {'estimator': 'neural', 'model_file': 'unfit'}


def status_of(net, role, prefix):
    """Return the status values of a role whose names have a prefix."""
    return {name: value for name, value in net[role].status().items()
            if name.startswith(prefix)}


def estimators(net):
    """Return the estimator of each cycle, after checking that it is the only one."""
    found = {}
    for estimate in net.sent(m.PositionEstimate):
        assert found.setdefault(estimate.cycle_id, estimate.estimator) == estimate.estimator
    return found


@pytest.mark.parametrize('state', [*IN_A_CYCLE, State.RESTING, State.BEACONING],
                         ids=lambda state: state.value)
def test_noise_does_not_change_within_a_cycle(network, state):
    net = network()
    net.run_cycles(2)
    net.run_to(state)
    net.change('bs', receiver_noise=False)
    waits = state is not State.RESTING
    assert status_of(net, 'bs', 'pending') == (
        {'pending.receiver_noise': 'false'} if waits else {})
    assert status_of(net, 'bs', 'parameter.receiver') == {
        'parameter.receiver_noise': str(waits).lower()}
    net.run_cycles(3)
    assert [outcome for _, _, outcome in net.outcomes()] == ['served'] * 5
    assert status_of(net, 'bs', 'pending') == {}
    assert net.logged('bs') == ["settings applied: receiver_noise 'false'"]
    # The reference signals use the noise setting at the time of the grant.
    net.verify()
    first = 4 if waits else 3
    assert [net._noise[cycle_id] for cycle_id in range(1, 6)] == [
        cycle_id < first for cycle_id in range(1, 6)]


def test_a_policy_takes_effect_with_the_next_cycle_and_keeps_the_turns(network):
    net = network(3)
    net.run_cycles(2)
    net.run_to(State.SOUNDING)
    net.change('bs', policy='first')
    net.run_cycles(3)
    # The rest of the current cycle, then the first user to answer; all answer at once.
    first = net.sent(m.Ack, cycle_id=4)[0].user
    assert net.served() == [1, 2, 3, first, first]
    net.change('bs', policy='round_robin')
    net.run_cycles(2)
    assert set(net.served()[-2:]) == {1, 2, 3} - {first}


def test_a_list_of_users_without_any_present_user_can_be_corrected(network):
    net = network(2, allowed_users='99')
    net.run(limit_s=2.0)
    assert net.outcomes() == []
    net.change('bs', allowed_users='2')
    net.run_cycles(2)
    assert net.served() == [2, 2]


@pytest.mark.parametrize(('options', 'state', 'event'), [
    # An unanswered cycle is given up; another base station serves; there is no cycle yet.
    ({'allowed_users': '99'}, State.BEACONING, PeersChanged(('positioner',))),
    ({}, State.SOUNDING, StoodBy()), ({'codebook': None}, State.WAITING, None)])
def test_settings_take_effect_when_no_cycle_follows(network, options, state, event):
    net = network(**options)
    net.run_to(state)
    net.change('bs', policy='random')
    if event:
        net.dispatch('bs', event)
    net.run(limit_s=2.0 if state is State.BEACONING else 0.0)
    assert net['bs'].state is State.WAITING
    assert status_of(net, 'bs', 'pending') == {}
    assert status_of(net, 'bs', 'parameter.policy') == {'parameter.policy': 'random'}


def test_a_long_pause_ends_when_it_is_shortened(network):
    net = network(rest_s=3000.0)
    net.run_cycles(1)
    net.run(limit_s=1.0)
    net.change('bs', rest_s=0.1)
    net.run_cycles(2, limit_s=3.0)


def test_a_pause_set_in_a_cycle_applies_after_it(network):
    net = network(rest_s=0.1)
    net.run_to(State.STEERING)
    net.change('bs', rest_s=30.0)
    net.run_cycles(1)
    end_s = net.now_s
    net.run_to(State.BEACONING)
    assert net.now_s == pytest.approx(end_s + 30.0, abs=0.01)


def test_retries_change_after_the_cycle(network):
    net = network(retries=0, step_timeout_s=1.0)
    net.run_to(State.SOUNDING)
    net.transport = lambda message, recipient: []
    net.change('bs', retries=3)
    net.run_cycles(1)
    assert net.outcomes() == [(1, 1, 'user_gone')]
    assert not net.sent(m.PilotRequest)[1:]
    net.transport = lambda message, recipient: [(1e-3, message)]
    net.run_to(State.SOUNDING)
    net.transport = lambda message, recipient: []
    before = len(net.sent(m.PilotRequest))
    net.run_cycles(1)
    assert len(net.sent(m.PilotRequest)) == before + 3


@pytest.mark.parametrize('state', [*IN_A_CYCLE, State.RESTING, State.BEACONING],
                         ids=lambda state: state.value)
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
    assert {outcome for _, _, outcome in net.outcomes()} == {'served'}
    names = list(estimators(net).values())
    assert names[:2] == ['centre'] * 2
    assert names == sorted(names) and names[-1] == 'ml'
    assert status_of(net, 'positioner', 'parameter.estimator') == {'parameter.estimator': 'ml'}
    assert not net['positioner'].counters
    net.verify()


@pytest.mark.parametrize('make_s', [0.0, 0.5])
def test_the_old_estimator_is_kept_if_the_new_one_cannot_be_built(network, make_s):
    net = network(make_s=make_s, step_timeout_s=2.0)
    net.run_cycles(2)
    net.change('positioner', **UNFIT)
    net.run_cycles(10)
    assert {outcome for _, _, outcome in net.outcomes()} == {'served'}
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


def test_the_last_of_several_estimators_is_used(network):
    net = network(make_s=0.5, step_timeout_s=2.0)
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
    net.run_to(State.SOUNDING)
    acts = [lambda: net.offer(codebooks[1]), lambda: net.change('positioner', **changed)]
    for act in acts if codebook_first else acts[::-1]:
        act()
    net.run_cycles(15)
    assert {outcome for _, _, outcome in net.outcomes()} == {'served'}
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
    net.run_to(State.SOUNDING)
    net.change('channel', delay_s=0.2)
    begin_s = net.now_s
    assert status_of(net, 'channel', 'pending') == {'pending.delay_s': '0.2'}
    net.run_cycles(1)
    assert net.now_s - begin_s < 0.2
    net.run_to(State.CONFIGURING)
    begin_s = net.now_s
    net.run_cycles(1)
    # Two bands and the data.
    assert net.now_s - begin_s > 0.6
    shown = {f'parameter.{name}': str(value).lower()
             for name, value in dataclasses.asdict(
                 Impairments(multipath_memory=False, delay_s=0.2)).items()}
    assert status_of(net, 'channel', 'p') == shown
    assert net.served() == [1, 1, 1]
    net.change('channel', loss_probability=1.0, delay_s=0.0)
    net.run_cycles(2)
    assert net.outcomes()[3:] == [(4, 1, 'channel_silent'), (5, 1, 'channel_silent')]
    net.change('channel', loss_probability=0.0)
    net.run_cycles(2)
    assert net.served()[3:] == [1, 1]
