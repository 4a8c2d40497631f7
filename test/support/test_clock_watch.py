"""A simulated time that stands still, or comes from two sources."""

import pytest

from rhs_isac_ros.support.clock_watch import STILL_S, WINDOW_S, ClockWatch

STILL = 'waiting for /clock'


@pytest.fixture
def watch():
    return ClockWatch()


def test_without_simulated_time_nothing_is_wrong(watch):
    assert [watch.update(None, float(n)) for n in range(10)] == 10 * ['']


def test_a_time_that_never_begins_is_waited_for(watch):
    assert watch.update(0.0, 100.0) == ''
    assert watch.update(0.0, 100.0 + STILL_S) == STILL
    assert watch.update(5.0, 101.0 + STILL_S) == ''


@pytest.mark.parametrize('pace', [0.01, 1.0, 20.0])
def test_a_time_that_stands_still_is_waited_for_until_it_moves(watch, pace):
    for n in range(100):
        assert watch.update(pace * n / 10, n / 10) == ''
    assert watch.update(pace * 9.9, 9.9 + STILL_S) == STILL
    assert watch.update(pace * 10.0, 10.0 + STILL_S) == ''


def test_one_restart_of_a_simulation_is_no_fault(watch):
    for n in range(50):
        assert watch.update(float(n % 25), n / 10) == ''


def test_two_sources_are_reported_until_one_has_gone(watch):
    texts = [watch.update(n / 10 + 900.0 * (n % 2), n / 10) for n in range(40)]
    assert texts[:3] == ['', '', '']
    assert set(texts[4:]) == {'/clock goes back repeatedly, by 900 s: expected one publisher'}
    later = [watch.update(n / 10, n / 10) for n in range(40, 120)]
    assert later[int(10 * WINDOW_S) + 1:] == (len(later) - int(10 * WINDOW_S) - 1) * ['']


def test_the_end_of_simulated_time_ends_the_fault(watch):
    for n in range(10):
        watch.update(900.0 * (n % 2), n / 10)
    assert watch.update(None, 1.0) == ''
    assert watch.update(5.0, 1.1) == ''
