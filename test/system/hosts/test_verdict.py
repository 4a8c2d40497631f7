"""The evaluation of outages."""

import json
import math

import pytest

from rhs_isac_ros.monitoring.cycle_log import CycleTimes
from system.hosts.verdict import evaluate, figures, recovery_s, table

MARKS_S = (0.0, 5.0, 11.0, 14.0)
LOGS = {'bs': '[WARN] [bs]: waiting for channel\n', 'user_1': 'listening for beacons\n'}
WARNINGS = {'bs': ['1 cycles given up', 'waiting for channel']}


def cycles(*spans_s):
    return [CycleTimes(number, began_s=start, ended_s=end)
            for number, (start, end) in enumerate(spans_s)]


def outage(spans_s=((1.0, 1.1), (2.0, 2.1), (4.95, 5.05), (11.5, 11.6)), logs=LOGS,
           warnings=WARNINGS, waiting=('bs',)):
    return evaluate('channel', MARKS_S, cycles(*spans_s), logs, warnings, waiting)


def test_recovery_ends_with_the_first_cycle_that_began_after_the_outage():
    assert recovery_s(cycles((10.9, 11.2), (11.3, 11.9), (12, 12.1)), 11.0) == pytest.approx(0.9)
    assert recovery_s(cycles((10.9, 11.2)), 11.0) == math.inf


def test_an_outage_that_is_reported_passes():
    result = outage()
    assert result.passed
    assert (result.before, result.during, result.after) == (2, 0, 1)
    assert result.outage_s == 6.0
    assert (result.logged, result.diagnosed) == (('bs',), ('bs',))


def test_a_late_recovery_fails():
    assert not outage(spans_s=((13.9, 14.01),)).passed
    assert not outage(spans_s=()).passed


def test_a_cycle_that_bypasses_the_link_fails():
    result = outage(spans_s=((7.0, 7.1), (11.5, 11.6)))
    assert result.during == 1
    assert not result.passed


@pytest.mark.parametrize(('logs', 'warnings'), [
    ({**LOGS, 'bs': ''}, WARNINGS), (LOGS, {'bs': ['1 cycles given up']})])
def test_waiting_nodes_must_report_in_log_and_diagnostics(logs, warnings):
    result = outage(logs=logs, warnings=warnings)
    assert result.unreported == ('bs',)
    assert not result.passed
    assert 'NOT bs' in table([result])
    assert outage(logs=logs, warnings=warnings, waiting=()).passed


def test_a_repeated_warning_fails():
    result = outage(logs={**LOGS, 'bs': 2 * LOGS['bs']})
    assert result.repeated == ('bs',)
    assert not result.passed
    assert 'MORE THAN ONCE bs' in table([result])
    assert outage(logs={**LOGS, 'bs': LOGS['bs'] + 'waiting for positioner\n'}).passed


def test_figures_are_valid_json_without_recovery():
    text = json.dumps(figures([outage(), outage(spans_s=())]), allow_nan=False)
    content = json.loads(text)
    assert content['worst_recovery_s'] is None
    assert content['outages'][0]['recovery_s'] == pytest.approx(0.6)
    assert len(table([outage(), outage(spans_s=())]).splitlines()) == 4
