"""The tables of the three state machines: their structure, and that the machines follow them."""

import enum
import inspect
import types

import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, mobility
from rhs_isac_ros.protocol import base_station as bs
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol import receiver, rhs_controller, user
from rhs_isac_ros.protocol.base_station import State
from rhs_isac_ros.protocol.events import (
    CodebookOffered,
    Immediately,
    Kind,
    LocateRequested,
    LogMessage,
    Outcome,
    PauseRequested,
    PeersChanged,
    Reply,
    Resumed,
    ResumeRequested,
    Send,
    SettingsOffered,
    StepRequested,
    StoodBy,
    Timeout,
)
from rhs_isac_ros.protocol.role import ANY, SAME, StateMachine, always, rows_for
from rhs_isac_ros.protocol.settings import BaseStationSettings, ReceiverSettings
from rhs_isac_ros.protocol.user_registry import POLICIES
from rhs_isac_ros.ros.roster import MEMBERS

# The first state, the states without a time-out, and the state that a role reaches if it receives
# no messages.
ROLES = {
    'bs': types.SimpleNamespace(
        machine=bs.BaseStation, initial=State.WAITING, final=State.BEACONING,
        endless={State.WAITING, State.PAUSED},
        events={Timeout, CodebookOffered, PeersChanged, SettingsOffered, StoodBy, Resumed,
                PauseRequested, ResumeRequested, StepRequested, LocateRequested}),
    'user': types.SimpleNamespace(
        machine=user.User, initial=user.State.DISCONNECTED, final=user.State.NO_BEACON,
        endless={user.State.DISCONNECTED, user.State.NO_BEACON}, events={Timeout, PeersChanged}),
    'rhs_controller': types.SimpleNamespace(
        machine=rhs_controller.RhsController, initial=rhs_controller.State.IDLE,
        final=rhs_controller.State.POSITIONING, endless=set(rhs_controller.State),
        events={CodebookOffered}),
    'receiver': types.SimpleNamespace(
        machine=receiver.Receiver, initial=receiver.State.LISTENING,
        final=receiver.State.SOUNDING, endless=set(receiver.State),
        events={CodebookOffered, SettingsOffered}),
}
TIMED = [(name, state) for name, role in ROLES.items()
         for state in role.machine.STATES if state not in role.endless]
WITHOUT_ROWS = [(name, state, event) for name, role in ROLES.items()
                for state in role.machine.STATES for event in role.machine.EVENT_NAMES
                if not rows_for(role.machine.TABLE, state, event)]


def test_all_state_machines_are_tested():
    assert ROLES.keys() == {
        name for name, member in MEMBERS.items() if hasattr(member.role, 'TABLE')}


@pytest.fixture(params=ROLES)
def role(request):
    return ROLES[request.param]


@pytest.fixture
def machine(scenario):
    """Function that returns the machine of a role, with timeouts of 1 s."""
    def make(name):
        if name == 'bs':
            def receive(codebook, feeds, user, cycle_id, noise):
                return np.zeros((2, 3, 2), complex)
            return bs.BaseStation(scenario, settings(), np.random.default_rng(0), receive)
        if name == 'user':
            return user.User({1: mobility.Static((10, 0, 0))}, step_s=1.0, beacon_s=1.0)
        if name == 'receiver':
            return receiver.Receiver(scenario, receiver.combiner(scenario, 0))
        return rhs_controller.RhsController()
    return make


def settings(**values):
    """Return settings of a base station whose timeouts are 1 s."""
    return BaseStationSettings(
        ack_timeout_s=1.0, step_timeout_s=1.0, rest_s=1.0, retries=0, **values)


def targets(role, state):
    """Return the states to which the rows for a state lead, itself included."""
    return {state if row.target is SAME else row.target for row in role.machine.TABLE
            if row.source is ANY or state in row.source}


def reachable(role, start):
    """Return the states to which some sequence of events leads."""
    found, fresh = {start}, [start]
    while fresh:
        new = targets(role, fresh.pop()) - found
        found |= new
        fresh += new
    return found


# The structure of the tables


def test_rows_consist_of_states_and_events_of_the_role(role):
    for row in role.machine.TABLE:
        assert row.source is ANY or row.source
        assert all(isinstance(state, role.machine.STATES) for state in row.source or ())
        assert row.target is SAME or isinstance(row.target, role.machine.STATES)
        assert row.outcome is None or isinstance(row.outcome, Outcome)


def test_every_event_of_the_role_has_rows_and_a_name(role):
    events = {row.event for row in role.machine.TABLE} - {Immediately}
    assert events == {*role.machine.RECEIVES, *role.events}
    assert role.machine.EVENT_NAMES.keys() == events
    names = list(role.machine.EVENT_NAMES.values())
    assert len(set(names)) == len(names)


def test_every_guard_and_action_belongs_to_a_row(role):
    used = {function.__name__ for row in role.machine.TABLE
            for function in (row.guard, *row.actions)}
    steps = {name for name, function in vars(role.machine).items()
             if inspect.isfunction(function)
             and [*inspect.signature(function).parameters] == ['self', 'event']}
    assert steps - {'react'} == used - {'always', 'reply'}


def test_no_row_is_hidden_by_an_earlier_one(role):
    for row in role.machine.TABLE:
        live = []
        for state in role.machine.STATES if row.source is ANY else row.source:
            rows = rows_for(role.machine.TABLE, state, row.event)
            earlier = {other.guard for other in rows[:rows.index(row)]}
            live.append(not earlier & {always, row.guard})
        assert any(live) if row.source is ANY else all(live), row


def test_every_state_is_reachable(role):
    assert reachable(role, role.initial) == set(role.machine.STATES)


def test_the_final_state_is_reachable_from_every_state(role):
    for state in role.machine.STATES:
        assert role.final in reachable(role, state)


def test_every_state_can_be_left(role):
    for state in role.machine.STATES:
        assert targets(role, state) - {state}


def test_exactly_the_states_with_a_timeout_have_rows_for_a_tick():
    rows = [(name, state) for name, role in ROLES.items() for state in role.machine.STATES
            if rows_for(role.machine.TABLE, state, Timeout)]
    assert rows == TIMED


@pytest.mark.parametrize(('name', 'state'), TIMED)
def test_timeouts_alone_lead_to_the_final_state(name, state):
    """The last row for a tick has no guard: it ends the state whatever the memory holds."""
    role, path = ROLES[name], [state]
    while path[-1] is not role.final:
        row = rows_for(role.machine.TABLE, path[-1], Timeout)[-1]
        assert row.guard is always
        assert row.target is not SAME and row.target not in path
        path.append(row.target)
    final_rows = rows_for(role.machine.TABLE, role.final, Timeout)
    if role.final in role.endless:
        assert final_rows == []
    else:
        assert final_rows[-1].target is SAME
        assert final_rows[-1].restart_timeout


@pytest.mark.parametrize(('name', 'state'), TIMED)
def test_a_timeout_is_counted_unless_it_ends_the_pause(name, state):
    row = rows_for(ROLES[name].machine.TABLE, state, Timeout)[-1]
    assert (row.outcome is None) == (state is State.RESTING)
    assert row.outcome is None or row.outcome.kind in (Kind.LOST, Kind.IDLE)


def test_outcomes_of_timeouts_differ(role):
    outcomes = [row.outcome for row in role.machine.TABLE if row.event is Timeout and row.outcome]
    assert len(set(outcomes)) == len(outcomes)


def test_the_base_station_gives_up_exactly_with_the_lost_outcomes():
    rows = bs.BaseStation.TABLE
    lost = [row for row in rows if row.outcome and row.outcome.kind is Kind.LOST]
    assert lost == [row for row in rows if '_abandon' in {a.__name__ for a in row.actions}]
    assert {row.target for row in lost} == {State.RESTING}


def test_repeated_steps_restart_their_timeout_or_the_users_cycle():
    rows = [row for role in ROLES.values() for row in role.machine.TABLE
            if row.outcome and row.outcome.kind is Kind.REPEATED]
    assert len(rows) == 7
    assert all(row.actions and row.target is SAME for row in rows)
    assert [row.source for row in rows if not row.restart_timeout] == [(user.State.LISTENING,)]


@pytest.mark.parametrize('name', ROLES)
def test_rows_that_drop_messages_precede_rows_of_single_states(name):
    """A message that is wrong is counted as such in every state."""
    dropped = {outcome for outcome in Outcome if outcome.value.startswith('wrong')}
    dropped |= {Outcome.NOT_ALLOWED, Outcome.TOO_OFTEN, Outcome.STALE_BEACON,
                 Outcome.STALE_COMMAND, Outcome.LATE_GRANT}
    table = ROLES[name].machine.TABLE
    assert {row.outcome for row in table} & dropped
    for number, row in enumerate(table):
        if row.outcome in dropped:
            assert row.source is ANY
            assert row.target is SAME
            earlier = [other for other in table[:number] if other.event is row.event]
            acting = [other for other in earlier if other.source is not ANY]
            # A grant to another user ends the wait of this one, before any refusal.
            assert {other.guard for other in acting} <= {
                user.User._other_user_granted, user.User._other_instance_granted}


# The machines


def snapshot(thing):
    """Return all that a machine has in its memory, but its counters, as values to compare."""
    match thing:
        case np.ndarray():
            return thing.tobytes(), thing.shape
        case np.random.Generator():
            return str(thing.bit_generator.state)
        case dict():
            return [(snapshot(key), snapshot(value)) for key, value in thing.items()] + [
                getattr(thing, 'in_use', None)]
        case list() | tuple():
            return [snapshot(item) for item in thing]
        case set():
            return sorted(map(repr, thing))
        # Immutable.
        case Scenario() | Codebook() | enum.Enum() | types.FunctionType():
            return id(thing)
    if hasattr(thing, '__dict__'):
        return [(name, snapshot(value)) for name, value in vars(thing).items()
                if name not in ('counters', 'now_s', 'outcome', '_actions')]
    return thing


def test_there_are_events_without_rows():
    assert {name for name, _, _ in WITHOUT_ROWS} == {'bs', 'user'}
    assert ('bs', State.WAITING, Timeout) in WITHOUT_ROWS


@pytest.mark.parametrize(('name', 'state', 'event'), WITHOUT_ROWS)
def test_an_event_without_rows_changes_nothing_and_is_counted(machine, name, state, event):
    subject = machine(name)
    subject.state = state
    before = snapshot(subject)
    assert subject.handle(event(), 1.0) == []
    assert snapshot(subject) == before
    assert subject.counters == {f'unexpected_{subject.EVENT_NAMES[event]}': 1}


def test_a_message_without_a_matching_row_changes_nothing_and_is_counted(machine, example):
    subject = machine('rhs_controller')
    before = snapshot(subject)
    assert subject.handle(example(m.Beam, user=1), 1.0) == []
    assert snapshot(subject) == before
    assert subject.counters == {'unexpected_beam': 1}


@pytest.mark.parametrize('name', ROLES)
@pytest.mark.parametrize('kind', [m.ProtocolState, m.Capacity, m.GroundTruth],
                         ids=lambda kind: kind.__name__)
def test_a_message_that_the_role_does_not_receive_is_an_error(machine, name, kind, example):
    subject = machine(name)
    message = f'{kind.__name__} is not an event of {type(subject).__name__}'
    with pytest.raises(TypeError, match=message):
        subject.handle(example(kind, user=0), 0.0)


def random_event(rng, subject, example, codebooks):
    """Return an event of a machine that fits its current cycle more often than not."""
    events = list(subject.EVENT_NAMES)
    kind = events[rng.integers(len(events))]
    if kind is LocateRequested:
        return LocateRequested(1)
    if kind in (Timeout, ResumeRequested, StepRequested):
        return kind()
    if kind is PauseRequested:
        # Rare, so that most cycles follow each other.
        return PauseRequested() if rng.random() < 0.05 else Timeout()
    if kind is CodebookOffered:
        return CodebookOffered(codebooks[rng.integers(3)])
    if kind is PeersChanged:
        return PeersChanged(('channel',) if rng.random() < 0.3 else ())
    if kind is StoodBy:
        # Otherwise, few cycles would get far.
        return StoodBy() if rng.random() < 0.1 else Timeout()
    if kind is Resumed:
        return Resumed(int(rng.integers(1000)))
    if kind is SettingsOffered and isinstance(subject, receiver.Receiver):
        return SettingsOffered(ReceiverSettings(bool(rng.integers(2))))
    if kind is SettingsOffered:
        return SettingsOffered(settings(policy=rng.choice(POLICIES)))
    memory = (subject._cycle if isinstance(subject, bs.BaseStation | receiver.Receiver)
              else subject)
    cycle_id = getattr(memory, 'cycle_id', None) or getattr(memory, '_cycle_id', 0)
    given = {'cycle_id': max(cycle_id + int(rng.choice([0, 0, 0, 0, 1, -1])), 0)}
    fields = kind.__dataclass_fields__
    if 'codebook_id' in fields:
        given['codebook_id'] = codebooks[rng.integers(2)].id
    if 'user' in fields:
        given['user'] = int(rng.integers(1, 3))
    return example(kind, rng, **given)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('name', ROLES)
def test_machines_take_the_first_row_that_matches(
        machine, name, seed, example, codebooks, scenario, monkeypatch):
    role, subject = ROLES[name], machine(name)
    taken = []
    take = StateMachine._take
    monkeypatch.setattr(StateMachine, '_take', lambda self, row, event: (
        taken.append(row) or take(self, row, event)))
    rng = np.random.default_rng(seed)
    now_s, visited, sent, unexpected = 0.0, {subject.state}, set(), 0
    for _ in range(1500):
        event = random_event(rng, subject, example, codebooks)
        now_s += rng.exponential(0.05)
        state, memory, counters = subject.state, snapshot(subject), subject.counters.copy()
        subject.now_s = now_s
        matching = [row for row in role.machine.TABLE
                    if type(event) is row.event and (row.source is ANY or state in row.source)
                    and row.guard(subject, event)]
        # Guards change nothing.
        assert snapshot(subject) == memory
        assert subject.counters == counters
        taken.clear()
        actions = subject.handle(event, now_s)
        assert taken[:1] == matching[:1]
        assert all(row.event is Immediately for row in taken[1:])
        assert not matching or not any(
            row.guard(subject, Immediately())
            for row in rows_for(role.machine.TABLE, subject.state, Immediately))
        if not matching:
            unexpected += 1
            assert actions == []
            assert snapshot(subject) == memory
            assert subject.counters - counters == {
                f'unexpected_{subject.EVENT_NAMES[type(event)]}': 1}
        for action in actions:
            assert isinstance(action, Send | LogMessage | Reply)
            if isinstance(action, Send):
                m.check(action.message, scenario)
                sent.add(type(action.message))
        visited.add(subject.state)
        deadline_s = subject.next_deadline()
        # The first deadline is set by the first change of state.
        assert (deadline_s is None) == (subject.state in role.endless)
        if subject.state is not state and deadline_s is not None:
            # There is no rest before a pause.
            pauses = subject.state is State.RESTING and subject._pause_requested
            steps = 4.0 if subject.state is user.State.GRANTED else 1.0
            assert deadline_s == now_s + (0.0 if pauses else steps)
    assert len(visited) >= min(3, len(role.machine.STATES))
    assert sent
    # An idle RHS controller rejects all beams but one without a codebook. A receiver that listens
    # has the signals of all bands of its latest cycle.
    assert unexpected or name in ('rhs_controller', 'receiver')
    assert all(n > 0 for n in subject.counters.values())
