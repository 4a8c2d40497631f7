"""The engine that takes the rows of a table."""

import dataclasses
import enum

import pytest

from rhs_isac_ros.protocol.events import LogMessage, Outcome
from rhs_isac_ros.protocol.role import ANY, Row, StateMachine, on, rows_for


class State(enum.Enum):
    RED = 'red'
    GREEN = 'green'
    DARK = 'dark'


@dataclasses.dataclass
class Go:
    fast: bool = False


class Stop:
    pass


class Blink:
    pass


class Wait:
    pass


class Fail:
    pass


class Renew:
    pass


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
        *on(Stop, 'stop')(Row((State.GREEN,), target=State.RED)),
        *on(Fail, 'fail')(
            Row((State.GREEN,), (LightSteps.shorten,), State.RED),
            Row(ANY, (LightSteps.note,), State.DARK, outcome=Outcome.OVERFLOW)),
        *on(Wait, 'wait')(Row((State.RED,))),
        *on(Blink, 'blink')(
            Row((State.RED, State.GREEN), restart_timeout=True),
            Row(ANY, (LightSteps.note,), outcome=Outcome.DUPLICATE)),
        *on(Renew, 'renew')(Row((State.RED,), target=State.RED)),
    )


def test_a_machine_begins_without_a_deadline():
    light = Light()
    assert light.state is State.RED
    assert light.next_deadline() is None
    assert light.counters == {}


def test_actions_run_in_order_in_the_old_state():
    light, go = Light(), Go()
    actions = light.handle(go, 5.0)
    assert light.seen == [(go, 5.0, State.RED), 'recorded', (go, 5.0, State.RED)]
    assert actions == [LogMessage('Go 1'), LogMessage('Go 3')]
    assert light.state is State.GREEN
    assert light.counters == {}


def test_the_first_row_whose_guard_holds_is_taken():
    light = Light()
    assert light.handle(Go(fast=True), 101.0) == []
    assert (light.state, light.counters) == (State.RED, {'stale': 1})
    assert light.handle(Go(fast=True), 5.0) == []
    assert (light.state, light.counters) == (State.GREEN, {'stale': 1, 'overflow': 1})


def test_rows_for_a_state_include_those_for_any_in_order():
    assert rows_for(Light.TABLE, State.RED, Go) == list(Light.TABLE[:3])
    assert rows_for(Light.TABLE, State.DARK, Go) == [Light.TABLE[0]]
    assert Light.TABLE[0].source is ANY


def test_a_new_state_sets_its_deadline():
    light = Light()
    light.handle(Go(), 5.0)
    assert light.next_deadline() == 7.0
    light.handle(Stop(), 6.0)
    assert light.next_deadline() == 16.0


def test_the_deadline_uses_timeouts_that_an_action_changed():
    light = Light()
    light.handle(Go(), 5.0)
    light.handle(Fail(), 6.0)
    assert light.next_deadline() == 7.0


def test_a_state_without_timeout_has_no_deadline():
    light = Light()
    light.handle(Blink(), 5.0)
    light.handle(Fail(), 6.0)
    assert light.state is State.DARK
    assert light.next_deadline() is None


@pytest.mark.parametrize('event', [Go(), Wait()])
def test_a_row_that_keeps_the_state_keeps_the_deadline(event):
    light = Light()
    light.handle(Go(), 5.0)
    light.handle(event, 6.0)
    assert (light.state, light.next_deadline(), light.repeats) == (State.GREEN, 7.0, 0)


def test_a_restarted_timeout_is_counted_until_the_state_changes():
    light = Light()
    for n in (1, 2):
        light.handle(Blink(), 3.0 * n)
        assert (light.state, light.next_deadline(), light.repeats) == (
            State.RED, 3.0 * n + 10.0, n)
    light.handle(Go(), 7.0)
    assert light.repeats == 0


def test_a_state_that_is_entered_again_has_a_new_deadline_and_no_repeats():
    light = Light()
    light.handle(Blink(), 3.0)
    light.handle(Renew(), 4.0)
    assert (light.state, light.next_deadline(), light.repeats) == (State.RED, 14.0, 0)


def test_a_row_without_source_applies_in_any_state():
    light = Light()
    light.handle(Blink(), 0.0)
    assert (light.counters, light.seen) == ({}, [])
    light.handle(Fail(), 0.0)
    assert light.handle(Blink(), 0.0) == [LogMessage('Blink 2')]
    assert light.counters == {'overflow': 1, 'duplicate': 1}


@pytest.mark.parametrize(('before', 'event', 'name'), [
    ([], Stop(), 'stop'), ([Go()], Wait(), 'wait'), ([Fail()], Go(), 'go')])
def test_an_event_without_a_matching_row_is_only_counted(before, event, name):
    light = Light()
    for earlier in before:
        light.handle(earlier, 1.0)
    state, deadline_s, seen = light.state, light.next_deadline(), list(light.seen)
    counters = dict(light.counters)
    for n in (1, 2):
        assert light.handle(event, 1.5) == []
        assert (light.state, light.next_deadline(), light.seen) == (state, deadline_s, seen)
        assert light.counters == counters | {f'unexpected_{name}': n}


def test_an_event_that_no_row_names_is_an_error():
    with pytest.raises(TypeError, match='int is not an event of Light'):
        Light().handle(3, 0.0)


def test_a_subclass_inherits_the_rows_of_its_table():
    class Lamp(Light):
        pass

    lamp = Lamp()
    lamp.handle(Go(), 0.0)
    assert lamp.state is State.GREEN


def test_a_row_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Light.TABLE[0].target = State.RED


def test_counting_nothing_adds_no_counter():
    light = Light()
    light.count(Outcome.USER_LOST, 0)
    assert 'user_lost' not in light.counters
    light.count(Outcome.USER_LOST, 2)
    assert light.counters == {'user_lost': 2}
