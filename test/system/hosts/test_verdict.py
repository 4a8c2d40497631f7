"""The verdict on a pull, from records."""

import json
import math

import pytest

from rhs_isac_ros.monitoring.cycle_log import CycleRecord
from system.hosts.verdict import figures, judge, recovery_s, table

MARKS_S = (0.0, 5.0, 11.0, 14.0)
SAID = {'bs': '[WARN] [bs]: waiting for channel\n', 'user_1': 'listening for beacons\n'}
WARNED = {'bs': ['1 cycles given up', 'waiting for channel']}


def cycles(*spans_s):
    return [CycleRecord(number, began_s=start, ended_s=end)
            for number, (start, end) in enumerate(spans_s)]


def verdict(spans_s=((1.0, 1.1), (2.0, 2.1), (4.95, 5.05), (11.5, 11.6)), said=SAID,
            warnings=WARNED, waiters=('bs',)):
    return judge('channel', MARKS_S, cycles(*spans_s), said, warnings, waiters)


def test_recovery_ends_with_the_first_cycle_that_began_after_the_return():
    assert recovery_s(cycles((10.9, 11.2), (11.3, 11.9), (12, 12.1)), 11.0) == pytest.approx(0.9)
    assert recovery_s(cycles((10.9, 11.2)), 11.0) == math.inf


def test_a_pull_as_promised():
    pull = verdict()
    assert pull.holds
    assert (pull.before, pull.during, pull.after) == (2, 0, 1)
    assert pull.pulled_s == 6.0
    assert (pull.said, pull.diagnosed) == (('bs',), ('bs',))


def test_too_late_is_not_as_promised():
    assert not verdict(spans_s=((13.9, 14.01),)).holds
    assert not verdict(spans_s=()).holds


def test_a_cycle_on_another_way_than_the_link_is_not_as_promised():
    pull = verdict(spans_s=((7.0, 7.1), (11.5, 11.6)))
    assert pull.during == 1
    assert not pull.holds


@pytest.mark.parametrize(('said', 'warnings'), [
    ({**SAID, 'bs': ''}, WARNED), (SAID, {'bs': ['1 cycles given up']})])
def test_who_is_to_say_so_says_so_in_log_and_diagnostics(said, warnings):
    pull = verdict(said=said, warnings=warnings)
    assert pull.untold == ('bs',)
    assert not pull.holds
    assert 'NOT bs' in table([pull])
    assert verdict(said=said, warnings=warnings, waiters=()).holds


def test_once_is_enough():
    pull = verdict(said={**SAID, 'bs': 2 * SAID['bs']})
    assert pull.repeated == ('bs',)
    assert not pull.holds
    assert 'MORE THAN ONCE bs' in table([pull])
    assert verdict(said={**SAID, 'bs': SAID['bs'] + 'waiting for positioner\n'}).holds


def test_figures_are_json_also_without_recovery():
    text = json.dumps(figures([verdict(), verdict(spans_s=())]), allow_nan=False)
    told = json.loads(text)
    assert told['worst_recovery_s'] is None
    assert told['pulls'][0]['recovered_s'] == pytest.approx(0.6)
    assert len(table([verdict(), verdict(spans_s=())]).splitlines()) == 4
