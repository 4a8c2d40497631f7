"""States that begin and end, and events that repeat, in a log of bounded length."""

import pytest

from rhs_isac_ros.support.state_log import PERIOD_S, Line, StateLog

BEGIN, END = Line('no position', True), Line('a position again', False)


@pytest.fixture
def log():
    return StateLog()


def alternate(log, period_s, end_s, key='robot'):
    """Return the lines about a state that begins and ends periodically, with their times [s]."""
    found, now_s, holds = [], 0.0, False
    while now_s < end_s:
        holds = not holds
        found += [(now_s, line) for line in log.state(
            key, BEGIN if holds else END, now_s, holds=holds)]
        now_s += period_s / 2
    return found


def test_the_begin_and_the_end_of_a_state_are_logged(log):
    assert log.state('robot', BEGIN, 0.0) == [BEGIN]
    assert log.due(10 * PERIOD_S) == []
    assert log.state('robot', END, 20 * PERIOD_S, holds=False) == [END]


@pytest.mark.parametrize('period_s', [0.1, 2.0, 10.0])
def test_a_state_that_alternates_is_logged_once_a_minute_with_the_number_of_changes(
        log, period_s):
    lines = alternate(log, period_s, 5.5 * PERIOD_S)
    assert [line for _, line in lines[:2]] == [BEGIN, END]
    later_s = [now_s for now_s, _ in lines[2:]]
    assert len(later_s) == 5
    assert all(after - before >= PERIOD_S
               for before, after in zip([0.0, *later_s[:-1]], later_s, strict=True))
    n_changes = [int(line.text.partition('(')[2].split()[0]) for _, line in lines[2:]]
    assert sum(n_changes) == pytest.approx(later_s[-1] / (period_s / 2), abs=3)


def test_a_state_that_alternates_slowly_is_always_logged(log):
    assert len(alternate(log, 5 * PERIOD_S, 50 * PERIOD_S)) == 20


def test_after_a_minute_the_log_contains_the_present_state(log):
    log.state('robot', BEGIN, 0.0)
    log.state('robot', END, 1.0, holds=False)
    assert log.state('robot', BEGIN, 2.0) == []
    assert log.due(PERIOD_S - 1.0) == []
    assert log.due(PERIOD_S) == [Line('no position (1 change in 60 s)', True)]
    assert log.due(2 * PERIOD_S) == []


def test_another_text_of_a_state_is_logged_at_once_and_its_repetitions_are_not(log):
    other, older = Line('stamps differ by 7.5 s', True), Line('stamps differ by 12 s', True)
    assert log.state('robot', BEGIN, 0.0) == [BEGIN]
    assert log.state('robot', other, 1.0) == [other]
    assert log.state('robot', BEGIN, 2.0) == log.state('robot', older, 3.0) == []
    # At the end of the minute, the log contains the present text, unless the state has ended.
    assert log.due(PERIOD_S) == [older]


def test_a_state_has_a_limited_number_of_texts_in_a_minute(log):
    lines = [Line('x' * n, True) for n in range(1, 100)]
    logged = [line for line in lines if log.state('robot', line, 0.0)]
    assert logged == lines[:len(logged)] and 4 <= len(logged) <= 10
    assert log.due(PERIOD_S) == lines[-1:]


def test_an_event_is_logged_once_and_then_once_a_minute_with_its_number(log):
    event = Line('dropped', True)
    assert log.event('dropped', event, 0.0) == [event]
    for _ in range(1000):
        assert log.event('dropped', event, 1.0) == []
    assert log.due(PERIOD_S) == [Line('dropped (1000 times in 60 s)', True)]
    # Without a repetition, there is no line; a later event is a new one.
    assert log.due(2 * PERIOD_S) == []
    assert log.event('dropped', event, 3 * PERIOD_S) == [event]


def test_a_group_of_states_is_compared_with_the_previous_one(log):
    assert log.update({'role': 'two nodes'}, 0.0) == [Line('two nodes', True)]
    assert log.update({'role': 'two nodes', 'clock': 'slow'}, 1.0) == [Line('slow', True)]
    assert log.update({'role': 'two other nodes', 'clock': 'slow'}, 1.5) == []
    assert log.update({'clock': 'slow'}, 2.0) == [Line('no longer: two other nodes', False)]
    assert log.update({'clock': 'slow', 'role': 'two nodes'}, 3.0) == []


def test_what_a_new_cause_has_is_logged_again(log):
    for _ in range(3):
        assert log.state('peer', BEGIN, 0.0) == [BEGIN]
        assert log.state('peer', END, 0.0, holds=False) == [END]
        assert log.state('peer', BEGIN, 0.0) == []
        log.renew()


def test_a_state_of_the_group_that_holds_is_older_than_a_new_cause(log):
    before = {'qos': 'no messages'}
    assert log.update(before, 0.0) == [Line('no messages', True)]
    log.renew()
    assert log.update({}, 1.0) == [Line('no longer: no messages', False)]
    assert log.update(before, 2.0) == []


def test_the_memory_is_bounded(log):
    for number in range(1100):
        log.event(str(number), Line('dropped', True), 0.0)
    assert len(log._records) == 1024
