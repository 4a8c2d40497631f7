"""The tables of the state machines: their structure, and that the machines follow them."""

import enum
import inspect
import types

import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, mobility
from rhs_isac_ros.protocol import base_station as bs
from rhs_isac_ros.protocol import events, receiver, rhs_controller, user
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState
from rhs_isac_ros.protocol.role import ANY, SAME, StateMachine, always, rows_for
from rhs_isac_ros.protocol.settings import BaseStationSettings, ReceiverSettings
from rhs_isac_ros.protocol.user_registry import POLICIES
from rhs_isac_ros.ros.roster import MEMBERS

MACHINES = {name: member.role for name, member in MEMBERS.items() if hasattr(member.role, 'TABLE')}
# A state that leads to all others, or that a role reaches if it receives no messages.
FINAL = {'bs': BsState.BEACONING, 'user': user.UserState.NO_BEACON,
         'rhs_controller': rhs_controller.RhsControllerState.POSITIONING,
         'receiver': receiver.ReceiverState.SOUNDING}
each_role = pytest.mark.parametrize('name', MACHINES)


def settings(**values):
    """Return settings of a base station whose timeouts are 1 s."""
    return BaseStationSettings(
        ack_timeout_s=1.0, step_timeout_s=1.0, rest_s=1.0, retries=0, **values)


def constructed(scenario, name):
    """Return the arguments of a machine with timeouts of 1 s."""
    return {
        'bs': {'scenario': scenario, 'settings': settings(), 'rng': np.random.default_rng(0),
               'seed': 0},
        'user': {'mobilities': {1: mobility.Static((10, 0, 0))}, 'scenario': scenario,
                 'step_s': 1.0, 'beacon_s': 1.0},
        'receiver': {'scenario': scenario, 'seed': 0}
    }.get(name, {})


@pytest.fixture
def machine(scenario, name):
    """The machine of a role, with timeouts of 1 s."""
    return MACHINES[name](**constructed(scenario, name))


def reachable(table, start):
    """Return the states to which some sequence of events leads."""
    found, fresh = {start}, [start]
    while fresh:
        state = fresh.pop()
        new = {row.target for row in table if row.target is not SAME and (
            row.source is ANY or state in row.source)} - found
        found |= new
        fresh += new
    return found


# The structure of the tables


@each_role
def test_every_guard_and_action_belongs_to_a_row(name):
    used = {function.__name__ for row in MACHINES[name].TABLE
            for function in (row.guard, *row.actions)}
    steps = {step for step, function in inspect.getmembers(MACHINES[name], inspect.isfunction)
             if [*inspect.signature(function).parameters] == ['self', 'event']}
    assert steps - {*dir(StateMachine)} == used - {'always', 'reply'}


@each_role
def test_no_row_is_hidden_by_an_earlier_one(name):
    table = MACHINES[name].TABLE
    for row in table:
        live = []
        for state in MACHINES[name].STATES if row.source is ANY else row.source:
            rows = rows_for(table, state, row.event)
            live.append(not {other.guard for other in rows[:rows.index(row)]} & {
                always, row.guard})
        assert any(live) if row.source is ANY else all(live), row


@each_role
def test_every_state_is_reached_and_leads_to_the_final_state(name, machine):
    assert reachable(machine.TABLE, machine.state) == {*machine.STATES}
    for state in machine.STATES:
        assert FINAL[name] in reachable(machine.TABLE, state)


@each_role
def test_timeouts_alone_lead_to_the_final_state(name, machine):
    """The last row for a timeout has no guard: it ends the state whatever the memory holds."""
    last = {state: rows[-1] for state in machine.STATES
            if (rows := rows_for(machine.TABLE, state, events.Timeout))}
    assert last.keys() == {
        state for state in machine.STATES if machine.timeout_s(state) is not None}
    for start, row in last.items():
        assert row.guard is always
        # All timeouts but the end of the pause between cycles are counted.
        assert (row.outcome is None) == (start is BsState.RESTING)
        path = [start]
        while path[-1] is not FINAL[name]:
            path.append(last[path[-1]].target)
            assert path[-1] not in (SAME, *path[:-1])
    if FINAL[name] in last:
        assert last[FINAL[name]].restart_timeout


def test_what_waits_for_signals_has_the_time_of_all_frames():
    scenario = Scenario(frame_duration_s=0.1)
    machines = [MACHINES[name](**constructed(scenario, name)) for name in ('bs', 'user')]
    waiting = {BsState.SOUNDING: 1.0, user.UserState.GRANTED: 4.0}
    for machine in machines:
        for state in (*bs.STEPS, user.UserState.ACKNOWLEDGED, *waiting):
            if state in machine.STATES:
                frames_s = 0.1 * (scenario.n_bands * scenario.n_frames - 1)
                assert machine.timeout_s(state) == pytest.approx(
                    waiting[state] + frames_s if state in waiting else 1.0)


def test_the_base_station_gives_up_exactly_with_the_lost_outcomes():
    lost = [row for row in bs.BaseStation.TABLE
            if row.outcome and row.outcome.kind is events.Kind.LOST]
    assert lost == [row for row in bs.BaseStation.TABLE
                    if '_abandon' in {action.__name__ for action in row.actions}]
    assert {row.target for row in lost} == {BsState.RESTING}


# The machines


@each_role
def test_an_event_that_no_row_awaits_is_an_error(machine, example):
    for event in (example(m.ProtocolState), events.Immediately()):
        message = f'{type(event).__name__} is not an event of {type(machine).__name__}'
        with pytest.raises(TypeError, match=message):
            machine.handle(event, 0.0)


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


def random_event(rng, subject, example, codebooks):
    """Return an event of a machine that fits its current cycle more often than not."""
    kind = list(subject.EVENT_NAMES)[rng.integers(len(subject.EVENT_NAMES))]
    # If these were frequent, few cycles would get far.
    if rng.random() > {events.StoodBy: 0.1, events.PauseRequested: 0.05}.get(kind, 1.0):
        kind = events.Timeout
    if not issubclass(kind, m.Message):
        offered = (ReceiverSettings(bool(rng.integers(2)))
                   if isinstance(subject, receiver.Receiver)
                   else settings(policy=rng.choice(POLICIES)))
        values = {events.LocateRequested: 1, events.CodebookOffered: codebooks[rng.integers(3)],
                  events.PeersChanged: ('channel',) if rng.random() < 0.3 else (),
                  events.Resumed: int(rng.integers(1000)), events.SettingsOffered: offered}
        return kind(values[kind]) if kind in values else kind()
    memory = getattr(subject, '_cycle', subject)
    cycle_id = getattr(memory, 'cycle_id', None) or getattr(memory, '_cycle_id', 0)
    given = {'cycle_id': max(cycle_id + int(rng.choice([0, 0, 0, 0, 1, -1])), 0),
             'codebook_id': codebooks[rng.integers(2)].id, 'user': int(rng.integers(1, 3))}
    return example(kind, rng, **{
        name: value for name, value in given.items() if name in kind.__dataclass_fields__})


@each_role
def test_machines_take_the_first_row_that_matches(
        machine, name, example, codebooks, scenario, monkeypatch):
    """Its target, timeout and outcome apply, and then rows without an event."""
    taken = []
    take = StateMachine._take
    monkeypatch.setattr(StateMachine, '_take', lambda self, row, event: (
        taken.append(row) or take(self, row, event)))
    rng = np.random.default_rng(0)
    now_s, visited, sent, unexpected = 0.0, {machine.state}, set(), 0
    for _ in range(1500):
        event = random_event(rng, machine, example, codebooks)
        now_s += rng.exponential(0.05)
        state, memory, counters = machine.state, snapshot(machine), machine.counters.copy()
        deadline_s, repeats = machine.next_deadline(), machine.repeats
        machine.now_s = now_s
        matching = [row for row in rows_for(machine.TABLE, state, type(event))
                    if row.guard(machine, event)]
        # Guards change nothing.
        assert (snapshot(machine), machine.counters) == (memory, counters)
        taken.clear()
        actions = machine.handle(event, now_s)
        assert taken[:1] == matching[:1]
        assert all(row.event is events.Immediately for row in taken[1:])
        assert not matching or not any(
            row.guard(machine, events.Immediately())
            for row in rows_for(machine.TABLE, machine.state, events.Immediately))
        if not matching:
            unexpected += 1
            assert (actions, snapshot(machine)) == ([], memory)
            assert machine.counters - counters == {
                f'unexpected_{machine.EVENT_NAMES[type(event)]}': 1}
        for action in actions:
            assert isinstance(action, events.Send | events.LogMessage | events.Reply)
            if isinstance(action, events.Send):
                m.check(action.message, scenario)
                sent.add(type(action.message))
        for row in taken:
            if row.outcome:
                counters[row.outcome.value] += 1
            if row.target or row.restart_timeout:
                state, repeats = (row.target, 0) if row.target else (state, repeats + 1)
                timeout_s = machine.timeout_s(state)
                deadline_s = None if timeout_s is None else now_s + timeout_s
        # Actions may count more.
        assert machine.counters >= counters
        assert (machine.state, machine.repeats, machine.next_deadline()) == (
            state, repeats, deadline_s)
        visited.add(machine.state)
    assert len(visited) >= min(3, len(machine.STATES))
    assert sent and sent <= {*machine.SENDS}
    # An idle RHS controller rejects all beams but one without a codebook. A receiver that listens
    # has the signals of all bands of its latest cycle.
    assert unexpected or name in ('rhs_controller', 'receiver')
    assert all(n > 0 for n in machine.counters.values())
