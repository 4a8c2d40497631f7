"""The engine that follows a table."""

import dataclasses
import enum

import pytest

from rhs_isac_ros.protocol.events import LogMessage, Tick
from rhs_isac_ros.protocol.state_machine import ANY, SAME, StateMachine, Transition


class State(enum.Enum):
    RED = 'red'
    GREEN = 'green'
    DARK = 'dark'


class Input(enum.Enum):
    GO = 'go'
    STOP = 'stop'
    BLINK = 'blink'
    STAY = 'stay'
    FAIL = 'fail'


class Light(StateMachine):
    """Takes inputs as they are and writes down what it is asked to do."""

    TABLE = {
        (State.RED, Input.GO): Transition(State.GREEN, ('say', 'be_silent', 'say')),
        (State.GREEN, Input.STOP): Transition(State.RED),
        (State.GREEN, Input.GO): Transition(State.GREEN),
        (State.RED, Input.STAY): Transition(SAME),
        (State.RED, Input.BLINK): Transition(SAME, rearm=True),
        (State.GREEN, Input.BLINK): Transition(SAME, counts='green_blink'),
        (ANY, Input.BLINK): Transition(SAME, ('say',), counts='blink'),
        (ANY, Input.FAIL): Transition(State.DARK, ('say',), counts='fail'),
    }

    def __init__(self):
        super().__init__(State.RED, {State.RED: 10.0, State.GREEN: 2.0})
        self.seen = []

    def _classify(self, event):
        return event

    def _say(self, event, now_s):
        self.seen.append((event, now_s, self.state))
        return [LogMessage(f'{event.value} {len(self.seen)}')]

    def _be_silent(self, event, now_s):
        self.seen.append('silent')


def test_a_machine_begins_without_a_deadline():
    light = Light()
    assert light.state is State.RED
    assert light.next_deadline() is None
    assert light.counters == {}


def test_a_step_acts_in_order_with_event_and_time_and_then_moves():
    light = Light()
    actions = light.handle(Input.GO, 5.0)
    assert light.seen == [(Input.GO, 5.0, State.RED), 'silent', (Input.GO, 5.0, State.RED)]
    assert actions == [LogMessage('go 1'), LogMessage('go 3')]
    assert light.state is State.GREEN
    assert light.counters == {}


def test_a_new_state_sets_its_deadline():
    light = Light()
    light.handle(Input.GO, 5.0)
    assert light.next_deadline() == 7.0
    light.handle(Input.STOP, 6.0)
    assert light.next_deadline() == 16.0


def test_a_state_without_time_out_has_no_deadline():
    light = Light()
    light.handle(Input.GO, 5.0)
    light.handle(Input.FAIL, 6.0)
    assert light.state is State.DARK
    assert light.next_deadline() is None


def test_staying_keeps_the_deadline():
    light = Light()
    light.handle(Input.GO, 5.0)
    for event in (Input.GO, Input.BLINK, Input.STAY):
        light.handle(event, 6.0)
        assert light.state is State.GREEN
        assert light.next_deadline() == 7.0


def test_rearming_starts_the_time_out_afresh():
    light = Light()
    light.handle(Input.BLINK, 3.0)
    assert light.state is State.RED
    assert light.next_deadline() == 13.0


def test_a_row_of_the_state_goes_before_one_of_any():
    light = Light()
    assert light.handle(Input.BLINK, 0.0) == []
    light.handle(Input.GO, 0.0)
    light.handle(Input.BLINK, 0.0)
    assert light.counters == {'green_blink': 1}
    light.handle(Input.FAIL, 0.0)
    assert light.handle(Input.BLINK, 0.0) == [LogMessage('blink 5')]
    assert light.counters == {'green_blink': 1, 'fail': 1, 'blink': 1}


@pytest.mark.parametrize(('before', 'name'), [
    ([], Input.STOP), ([Input.GO], Input.STAY), ([Input.FAIL], Input.GO)])
def test_a_pair_that_is_not_in_the_table_is_counted_only(before, name):
    light = Light()
    for event in before:
        light.handle(event, 1.0)
    state, deadline_s, seen = light.state, light.next_deadline(), list(light.seen)
    counters = dict(light.counters)
    for n in (1, 2):
        assert light.handle(name, 1.5) == []
        assert (light.state, light.next_deadline(), light.seen) == (state, deadline_s, seen)
        assert light.counters == counters | {f'unexpected_{name.value}': n}


def test_a_machine_keeps_its_own_time_outs():
    timeouts_s = {State.RED: 1.0}

    class Patient(Light):
        def __init__(self):
            StateMachine.__init__(self, State.GREEN, timeouts_s)

    light = Patient()
    timeouts_s[State.RED] = 99.0
    light.handle(Input.STOP, 0.0)
    assert light.next_deadline() == 1.0


def test_a_step_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Transition().to = State.RED


def test_a_machine_must_name_its_events():
    with pytest.raises(NotImplementedError):
        StateMachine(State.RED, {}).handle(Tick(), 0.0)
