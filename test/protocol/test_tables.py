"""The tables of the three state machines, as data."""

import copy
import enum
import types

import numpy as np
import pytest

from rhs_isac_ros.model import mobility
from rhs_isac_ros.protocol import base_station as bs
from rhs_isac_ros.protocol import base_station_table as bs_table
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol import rhs_controller, user
from rhs_isac_ros.protocol.events import (
    CodebookOffered,
    LogMessage,
    PeersChanged,
    Send,
    SettingsOffered,
    Tick,
)
from rhs_isac_ros.protocol.settings import BaseStationSettings
from rhs_isac_ros.protocol.state_machine import ANY, SAME
from rhs_isac_ros.protocol.user_scheduler import POLICIES, UserScheduler

ROLES = {
    'bs': types.SimpleNamespace(
        machine=bs.BaseStation, states=bs_table.State, inputs=bs_table.Input,
        initial=bs_table.State.WAITING, home=bs_table.State.BEACONING,
        endless={bs_table.State.WAITING}),
    'user': types.SimpleNamespace(
        machine=user.User, states=user.State, inputs=user.Input, initial=user.State.DISCONNECTED,
        home=user.State.NO_BEACON, endless={user.State.DISCONNECTED, user.State.NO_BEACON}),
    'rhs_controller': types.SimpleNamespace(
        machine=rhs_controller.RhsController, states=rhs_controller.State,
        inputs=rhs_controller.Input, initial=rhs_controller.State.IDLE,
        home=rhs_controller.State.POSITIONING, endless=set(rhs_controller.State)),
}
PAIRS = [(name, state, event) for name, role in ROLES.items() for state in role.states
         for event in role.inputs]
UNEXPECTED = [(name, state, event) for name, state, event in PAIRS
              if not {(state, event), (ANY, event)} & ROLES[name].machine.TABLE.keys()]
TIMED = [(name, state) for name, role in ROLES.items()
         for state in role.states if state not in role.endless]


@pytest.fixture(params=ROLES)
def role(request):
    return ROLES[request.param]


@pytest.fixture
def machine(scenario):
    """Function of a role's name: its machine, with a time-out of 1 s where it needs one."""
    def make(name):
        role = ROLES[name]
        timeouts_s = {state: 1.0 for state in role.states if state not in role.endless}
        if name == 'bs':
            def receive(codebook, feeds, user, cycle_id, noise):
                return np.zeros((2, 3, 2), complex)
            return bs.BaseStation(scenario, settings(), np.random.default_rng(0), receive)
        if name == 'user':
            return user.User(1, mobility.Static((10, 0, 0)), timeouts_s)
        return rhs_controller.RhsController()
    return make


def settings(**values):
    """Settings of a base station that has a time-out of 1 s everywhere."""
    return BaseStationSettings(
        ack_timeout_s=1.0, step_timeout_s=1.0, rest_s=1.0, retries=0, **values)


def effective(role, state, event):
    return role.machine.TABLE.get((state, event)) or role.machine.TABLE.get((ANY, event))


def reachable(role, start):
    """States that some sequence of events leads to."""
    found, fresh = {start}, [start]
    while fresh:
        state = fresh.pop()
        for event in role.inputs:
            step = effective(role, state, event)
            target = state if step is None or step.to is SAME else step.to
            if target not in found:
                found.add(target)
                fresh.append(target)
    return found


def test_rows_are_made_of_the_states_and_inputs_of_the_role(role):
    for (state, event), step in role.machine.TABLE.items():
        assert state is ANY or isinstance(state, role.states)
        assert isinstance(event, role.inputs)
        assert step.to is SAME or isinstance(step.to, role.states)


def test_rows_name_methods_that_exist(role):
    for step in role.machine.TABLE.values():
        for method in step.do:
            assert callable(getattr(role.machine, f'_{method}'))


def test_every_step_method_is_in_a_row(role):
    """A method that takes event and time belongs to some row."""
    named = {f'_{method}' for step in role.machine.TABLE.values() for method in step.do}
    steps = {name for name, value in vars(role.machine).items()
             if callable(value) and not name.startswith('__') and name.startswith('_')
             and value.__code__.co_varnames[:3] == ('self', 'event', 'now_s')}
    assert steps == named


def test_every_state_is_reachable(role):
    assert reachable(role, role.initial) == set(role.states)


def test_no_state_is_a_dead_end(role):
    for state in role.states:
        assert role.home in reachable(role, state)


def test_no_state_drops_everything(role):
    for state in role.states:
        targets = {step.to for (source, _), step in role.machine.TABLE.items()
                   if source in (state, ANY)}
        assert targets - {SAME, state}


@pytest.mark.parametrize(('name', 'state'), TIMED)
def test_a_state_with_a_time_out_ends_at_home_without_any_message(name, state):
    role = ROLES[name]
    timeout = role.inputs.TIMEOUT
    path = [state]
    while path[-1] is not role.home:
        step = role.machine.TABLE[path[-1], timeout]
        assert step.to not in path
        path.append(path[-1] if step.to is SAME else step.to)
    at_home = role.machine.TABLE.get((role.home, timeout))
    if role.home in role.endless:
        assert at_home is None
    else:
        assert at_home.to is SAME
        assert at_home.rearm


def test_only_states_with_a_time_out_have_a_row_for_it():
    rows = [(name, state) for name, role in ROLES.items() for state, event in role.machine.TABLE
            if event.value == 'timeout']
    assert sorted(map(str, rows)) == sorted(map(str, TIMED))


@pytest.mark.parametrize(('name', 'state'), TIMED)
def test_a_time_out_is_counted_unless_it_is_the_pause(name, state):
    role = ROLES[name]
    counts = role.machine.TABLE[state, role.inputs.TIMEOUT].counts
    assert bool(counts) == (state is not bs_table.State.RESTING)


def test_reasons_of_time_outs_tell_them_apart(role):
    reasons = [step.counts for (_, event), step in role.machine.TABLE.items()
               if event.value == 'timeout' and step.counts]
    assert len(set(reasons)) == len(reasons)


def test_every_input_is_used(role):
    assert {event for _, event in role.machine.TABLE} == set(role.inputs)


def test_what_is_wrong_is_counted_in_every_state(role):
    faults = [event for event in role.inputs
              if event.value.startswith(('wrong', 'duplicate', 'late', 'stale'))]
    assert faults
    for event in faults:
        step = role.machine.TABLE[ANY, event]
        assert step.counts == event.value
        assert step.to is SAME
        assert not any((state, event) in role.machine.TABLE for state in role.states)


def test_a_row_for_any_state_is_not_hidden_by_rows_for_all(role):
    for (state, event) in role.machine.TABLE:
        if state is ANY:
            assert any((other, event) not in role.machine.TABLE for other in role.states)


def snapshot(thing):
    """All that a machine remembers, besides its counters."""
    return {name: snapshot(value) if isinstance(value, UserScheduler) else
            copy.copy(value) if isinstance(value, dict | list) else value
            for name, value in vars(thing).items() if name not in ('counters', '_classify')}


@pytest.mark.parametrize(('name', 'state', 'event'), UNEXPECTED)
def test_a_pair_outside_the_table_changes_nothing_and_is_counted(machine, name, state, event):
    subject = machine(name)
    subject.state = state
    subject._classify = lambda _: event
    before = snapshot(subject)
    assert subject.handle(Tick(), 1.0) == []
    assert snapshot(subject) == before
    assert subject.counters == {f'unexpected_{event.value}': 1}


def test_there_are_pairs_outside_the_tables_and_inside():
    assert {name for name, _, _ in UNEXPECTED} == set(ROLES)
    assert 0 < len(UNEXPECTED) < len(PAIRS)


@pytest.mark.parametrize('name', ['bs', 'rhs_controller'])
@pytest.mark.parametrize('kind', [m.ProtocolState, m.Capacity, m.GroundTruth],
                         ids=lambda kind: kind.__name__)
def test_a_message_that_no_node_hands_over_is_an_error(machine, name, kind, example):
    with pytest.raises(TypeError, match=f'{kind.__name__} is no event of'):
        machine(name).handle(example(kind, user=0), 0.0)


def random_event(rng, kinds, example, codebooks):
    draw = rng.integers(len(kinds) + 4)
    if draw == 0:
        return Tick()
    if draw == 1:
        return CodebookOffered(codebooks[rng.integers(3)])
    if draw == 2:
        return PeersChanged(('channel',) if rng.random() < 0.3 else ())
    if draw == 3:
        return SettingsOffered(settings(policy=rng.choice(POLICIES)))
    given = {'cycle_id': int(rng.integers(0, 5))}
    kind = kinds[draw - 4]
    fields = kind.__dataclass_fields__
    if 'codebook_id' in fields:
        given['codebook_id'] = codebooks[rng.integers(2)].id
    if 'user' in fields:
        given['user'] = int(rng.integers(1, 3))
    return example(kind, rng, **given)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('name', ROLES)
def test_no_sequence_of_events_breaks_a_role(
        machine, name, seed, subscriptions, example, codebooks, scenario):
    role, subject = ROLES[name], machine(name)
    rng = np.random.default_rng(seed)
    now_s, visited, sent = 0.0, {subject.state}, set()
    for _ in range(1500):
        event = random_event(rng, subscriptions[name], example, codebooks)
        takes = {Tick: name != 'rhs_controller', CodebookOffered: name != 'user',
                 PeersChanged: name != 'rhs_controller', SettingsOffered: name == 'bs'}
        if not takes.get(type(event), True):
            continue
        now_s += rng.exponential(0.05)
        before = subject.state
        for action in subject.handle(event, now_s):
            assert isinstance(action, Send | LogMessage)
            if isinstance(action, Send):
                m.check(action.message, scenario.sizes)
                sent.add(type(action.message))
        visited.add(subject.state)
        deadline_s = subject.next_deadline()
        # The first deadline comes with the first change of state.
        assert (deadline_s is None) == (subject.state in role.endless)
        if subject.state is not before and deadline_s is not None:
            assert deadline_s == now_s + 1.0
        assert isinstance(subject.state, enum.Enum)
    assert len(visited) >= 3
    assert sent
    assert all(n > 0 for n in subject.counters.values())
