"""What all roles have in common, their bounded memory, and the engine that takes rows."""

import dataclasses
import enum
import math

import numpy as np
import pytest
from in_memory_network import ROLES, Fixed, emulated_front_end

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import apply_patterns
from rhs_isac_ros.protocol.events import (
    ApplyPatterns,
    BuildEstimator,
    CodebookOffered,
    EstimatorBuilt,
    FrontEndFailed,
    Immediately,
    LogMessage,
    Outcome,
    Reply,
    Send,
    Timeout,
)
from rhs_isac_ros.protocol.role import (
    ANY,
    CodebookCache,
    NewestDict,
    Row,
    StateMachine,
    on,
    rows_for,
)

each_role = pytest.mark.parametrize('name', ROLES)


@pytest.fixture
def role(network, name):
    """A role that has just begun in a network of all roles."""
    return network()[{'user': 'user1'}.get(name, name)]


@each_role
def test_roles_without_states_have_no_deadline_at_first(role):
    assert role.next_deadline() is None or role.state is not None


@each_role
def test_a_time_that_is_not_finite_is_an_error(role):
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match=f'now_s: {bad}, expected finite'):
            role.handle(Timeout(), bad)


@each_role
@pytest.mark.parametrize('seed', range(2))
def test_no_sequence_of_messages_raises_an_error(role, name, scenario, codebooks, example, seed):
    rng = np.random.default_rng(seed)
    sent = 0
    for n in range(500):
        kind = role.RECEIVES[rng.integers(len(role.RECEIVES))]
        fields = kind.__dataclass_fields__
        given = {'cycle_id': int(rng.integers(0, 3))}
        if 'codebook_id' in fields:
            given['codebook_id'] = codebooks[rng.integers(3)].id
        if 'user' in fields:
            given['user'] = int(rng.integers(1, 3))
        if 'position' in fields:
            given['position'] = scenario.sample_positions(1, rng)[0]
        events = [example(kind, rng, **given)]
        if name not in ('channel', 'user') and rng.random() < 0.05:
            events.insert(0, CodebookOffered(codebooks[rng.integers(3)]))
        for event in events:
            for action in role.handle(event, float(n)):
                if isinstance(action, BuildEstimator):
                    built = EstimatorBuilt(action.codebook, Fixed(action.codebook), 0.0)
                    events.append(built)
                    continue
                if isinstance(action, ApplyPatterns):
                    events.append(
                        apply_patterns(emulated_front_end(scenario), action)
                        if rng.random() < 0.9 else
                        FrontEndFailed(action.key, 'surface_silence', 'no answer'))
                    continue
                assert isinstance(action, Send | LogMessage | Reply)
                if isinstance(action, Send):
                    assert type(action.message) in role.SENDS
                    m.check(action.message, scenario)
                    sent += 1
    assert sent or role.state is not None and role.counters
    assert all(n > 0 for n in role.counters.values())


# Bounded memory


def test_the_oldest_entries_are_discarded_and_counted():
    newest = NewestDict(2)
    assert [newest.put(key, key * 10) for key in (1, 2, 3, 4)] == [0, 0, 1, 1]
    assert newest == {3: 30, 4: 40}


def test_an_entry_stored_again_is_the_newest():
    newest = NewestDict(2)
    for key in (1, 2, 1, 3):
        newest.put(key, None)
    assert list(newest) == [1, 3]


def test_an_empty_cache_has_nothing_in_use():
    assert CodebookCache().in_use == ''


def test_the_codebook_taken_last_is_kept_until_another_is_taken():
    cache = CodebookCache()
    for name in 'abc':
        cache.put(name, name.upper())
    assert cache.take('a') == 'A'
    assert cache.in_use == 'a'
    for name in 'defg':
        cache.put(name, name.upper())
    assert sorted(cache) == ['a', 'e', 'f', 'g']
    assert cache.take('g') == 'G'
    cache.put('h', 'H')
    assert sorted(cache) == ['a', 'f', 'g', 'h']
    with pytest.raises(KeyError):
        cache.take('e')
    assert cache.in_use == 'g'


# The engine


class State(enum.Enum):
    RED = 'red'
    GREEN = 'green'
    DARK = 'dark'
    STARTING = 'starting'


@dataclasses.dataclass(frozen=True)
class Go:
    fast: bool = False


Blink, Wait, Fail, Renew, Start = (
    type(name, (), {}) for name in ('Blink', 'Wait', 'Fail', 'Renew', 'Start'))


class LightSteps(StateMachine):
    """A traffic light that records its actions."""

    def __init__(self):
        super().__init__(State.RED)
        self.timeouts_s = {State.RED: 10.0, State.GREEN: 2.0}
        self.seen = []

    def timeout_s(self, state):
        return self.timeouts_s.get(state)

    def fast(self, event):
        return event.fast

    def past(self, event):
        return self.now_s > 100.0

    def note(self, event):
        self.seen.append((event, self.now_s, self.state))
        self.log(f'{type(event).__name__} {len(self.seen)}')

    def record(self, event):
        self.seen.append('recorded')

    def shorten(self, event):
        self.timeouts_s = {State.RED: 1.0}


class Light(LightSteps):
    STATES = State
    TABLE = (
        *on(Go, 'go', {LightSteps.past: Outcome.STALE})(
            Row((State.RED,), target=State.GREEN, guard=LightSteps.fast,
                outcome=Outcome.OVERFLOW),
            Row((State.RED,), (LightSteps.note, LightSteps.record, LightSteps.note),
                State.GREEN),
            Row((State.GREEN,))),
        *on(Fail, 'fail')(
            Row((State.GREEN,), (LightSteps.shorten,), State.RED),
            Row(ANY, (LightSteps.note,), State.DARK, outcome=Outcome.OVERFLOW)),
        *on(Wait, 'wait')(Row((State.RED,))),
        *on(Blink, 'blink')(
            Row((State.RED, State.GREEN), restart_timeout=True),
            Row(ANY, (LightSteps.note,), outcome=Outcome.DUPLICATE)),
        *on(Renew, 'renew')(Row((State.RED,), target=State.RED)),
        *on(Start, 'start')(Row(ANY, target=State.STARTING)),
        # A light that starts late goes on to red; otherwise, it goes on to green and is counted.
        *on(Immediately, 'immediately')(
            Row((State.STARTING,), target=State.RED, guard=LightSteps.past),
            Row((State.STARTING,), (LightSteps.note,), State.GREEN, outcome=Outcome.LATE_ACK)),
    )


@pytest.mark.parametrize(('events', 'state', 'deadline_s', 'repeats', 'counters'), [
    # A machine begins without a deadline; a new state sets one.
    ([], State.RED, None, 0, {}),
    ([(Go(), 5.0)], State.GREEN, 7.0, 0, {}),
    # The first row whose guard holds is taken.
    ([(Go(fast=True), 101.0)], State.RED, None, 0, {'stale': 1}),
    ([(Go(fast=True), 5.0)], State.GREEN, 7.0, 0, {'overflow': 1}),
    # The deadline uses timeouts that an action has changed.
    ([(Go(), 5.0), (Fail(), 6.0)], State.RED, 7.0, 0, {}),
    # A state without a timeout has no deadline.
    ([(Blink(), 5.0), (Fail(), 6.0)], State.DARK, None, 0, {'overflow': 1}),
    # A row that keeps the state keeps the deadline; so does an event without a matching row.
    ([(Go(), 5.0), (Go(), 6.0)], State.GREEN, 7.0, 0, {}),
    ([(Go(), 5.0), (Wait(), 6.0), (Wait(), 6.0)], State.GREEN, 7.0, 0, {'unexpected_wait': 2}),
    # A restarted timeout is counted until the state changes, or is entered again.
    ([(Blink(), 3.0), (Blink(), 6.0)], State.RED, 16.0, 2, {}),
    ([(Blink(), 3.0), (Go(), 7.0)], State.GREEN, 9.0, 0, {}),
    ([(Blink(), 3.0), (Renew(), 4.0)], State.RED, 14.0, 0, {}),
    # A row without a source applies in any state.
    ([(Fail(), 0.0), (Blink(), 0.0)], State.DARK, None, 0, {'overflow': 1, 'duplicate': 1}),
    # Rows for Immediately follow by themselves, at the same time.
    ([(Start(), 5.0)], State.GREEN, 7.0, 0, {'late_ack': 1}),
    ([(Start(), 101.0)], State.RED, 111.0, 0, {})])
def test_events_lead_to_a_state_a_deadline_and_counters(
        events, state, deadline_s, repeats, counters):
    light = Light()
    for event, now_s in events:
        light.handle(event, now_s)
    assert (light.state, light.next_deadline(), light.repeats, light.counters) == (
        state, deadline_s, repeats, counters)


def test_actions_run_in_order_in_the_old_state():
    light, go = Light(), Go()
    assert light.handle(go, 5.0) == [LogMessage('Go 1'), LogMessage('Go 3')]
    assert light.seen == [(go, 5.0, State.RED), 'recorded', (go, 5.0, State.RED)]
    assert light.handle(Wait(), 6.0) == []
    assert light.handle(Start(), 7.0) == [LogMessage('Immediately 4')]
    assert light.seen[3:] == [(Immediately(), 7.0, State.STARTING)]


def test_rows_for_a_state_include_those_for_any_in_order():
    assert rows_for(Light.TABLE, State.RED, Go) == list(Light.TABLE[:3])
    assert rows_for(Light.TABLE, State.DARK, Go) == [Light.TABLE[0]]
    assert Light.TABLE[0].source is ANY


@pytest.mark.parametrize(('event', 'name'), [(3, 'int'), (Immediately(), 'Immediately')])
def test_an_event_that_no_row_awaits_is_an_error(event, name):
    with pytest.raises(TypeError, match=f'{name} is not an event of Light'):
        Light().handle(event, 0.0)


def test_counting_nothing_adds_no_counter():
    light = Light()
    light.count(Outcome.USER_LOST, 0)
    assert 'user_lost' not in light.counters
    light.count(Outcome.USER_LOST, 2)
    assert light.counters == {'user_lost': 2}
