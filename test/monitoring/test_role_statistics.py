"""The diagnostics of a role."""

import numpy as np
import pytest

from rhs_isac_ros.monitoring.role_statistics import RoleStatistics
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import CodebookOffered, LogMessage, Send, Timeout


def state(outcome, cycle_id=1):
    return Send(m.ProtocolState(
        cycle_id=cycle_id, user=1, phase=m.Phase.BEACONING, outcome=outcome, began_s=np.zeros(4),
        elapsed_s=0.5))


def test_an_idle_role_reports_its_phase_only():
    report = RoleStatistics().report('waiting', {})
    assert (report.fault, report.summary) == (False, 'no fault')
    assert report.details == {'phase': 'waiting'}
    assert RoleStatistics().report('', {}).details == {}


def test_counters_are_sorted_into_sections():
    counters = {'wrong_cycle': 3, 'rhs_silent': 2, 'unanswered': 7, 'not_granted': 1,
                'retry_band': 4, 'asked_again': 5, 'no_beacon': 6}
    details = RoleStatistics().report('', counters).details
    assert details == {'dropped.wrong_cycle': '3', 'cycles.rhs_silent': '2',
                      'beacons.unanswered': '7', 'cycles.not_granted': '1',
                      'retries.retry_band': '4', 'retries.asked_again': '5',
                      'beacons.no_beacon': '6'}


def test_settings_in_use_and_pending_are_reported(codebooks):
    statistics = RoleStatistics()
    settings = {'parameter.policy': 'first', 'pending.policy': 'random'}

    def details_with(in_use):
        report = statistics.report('', {}, status={'codebook_id': in_use, **settings})
        assert not report.fault
        return {name: value for name, value in report.details.items() if 'handling' not in name}
    first, second, _ = (codebook.id for codebook in codebooks)
    assert details_with('') == settings
    statistics.record(CodebookOffered(codebooks[0]), [], 0.0)
    assert details_with('') == details_with(first) == {'codebook_id': first, **settings}
    statistics.record(CodebookOffered(codebooks[1]), [], 0.0)
    assert details_with(first) == {'codebook_id': first, 'pending.codebook_id': second, **settings}
    assert details_with(second) == {'codebook_id': second, **settings}


def test_messages_and_served_cycles_are_counted(codebooks):
    statistics = RoleStatistics()
    statistics.record(CodebookOffered(codebooks[1]), [], 0.0)
    for cycle_id, outcome in enumerate(['served', 'rhs_silent', 'served'], 1):
        beacon = m.Beacon(cycle_id=cycle_id, attempt=0)
        statistics.record(Timeout(), [Send(beacon), LogMessage('x')], 0.0)
        statistics.record(Timeout(), [state('', cycle_id)], 0.0)
        statistics.record(Timeout(), [state(outcome, cycle_id)], 0.0)
    details = statistics.report('', {'rhs_silent': 1}).details
    assert details['codebook_id'] == codebooks[1].id
    assert (details['cycles.served'], details['cycles.rhs_silent']) == ('2', '1')
    assert (details['sent.Beacon'], details['sent.ProtocolState']) == ('3', '6')
    assert {details[f'cycle_ms.p{percent}'] for percent in (50, 95, 99)} == {'500.000'}


def test_latencies_are_percentiles_of_the_latest_durations(example):
    statistics = RoleStatistics()
    times_s = np.random.default_rng(0).exponential(size=2000)
    for time_s in times_s:
        estimate = example(m.PositionEstimate, latency_s=2 * time_s)
        statistics.record(Timeout(), [Send(estimate)], time_s)
    details = statistics.report('', {}).details
    for percent in (50, 95, 99):
        expected = 1e3 * np.percentile(times_s[-512:], percent)
        assert float(details[f'handling_ms.p{percent}']) == pytest.approx(expected, abs=1e-3)
        assert float(details[f'estimate_ms.p{percent}']) == pytest.approx(2 * expected, abs=1e-3)


MISSING = ('channel', 'bs')
DEVIATING = {'warning.residual': 'signals deviate', 'residual.ratio': '1.200'}


@pytest.mark.parametrize('reports', [
    # A fault is reported once, and a missing role until it is present.
    [('', {'wrong_user': 2, 'unanswered': 5}, (), {}, 'new faults: wrong_user 2'),
     ('', {'wrong_user': 2, 'unanswered': 5}, (), {}, ''),
     ('', {'wrong_user': 2, 'unanswered': 5}, MISSING, {}, 'waiting for channel, bs'),
     ('', {'wrong_user': 2, 'unanswered': 5}, MISSING, {}, 'waiting for channel, bs'),
     ('', {'wrong_user': 2, 'unanswered': 9}, (), {}, '')],
    # The summary names the most frequent new faults.
    [('', {'late_ack': 50, 'user_gone': 1}, (), {}, 'new faults: late_ack 50, user_gone 1'),
     ('', {'late_ack': 51, 'user_gone': 4, 'stale': 2, 'wrong_cycle': 2, 'retry_rhs': 1,
           'unanswered': 9}, (), {},
      'new faults: user_gone 3, stale 2, wrong_cycle 2, others 2')],
    # A pause is no fault.
    [('paused', {'late_ack': 1}, (), {}, 'new faults: late_ack 1'),
     ('paused', {'late_ack': 1}, (), {}, '')],
    # A conflict precedes all other faults.
    [('', {'no_fix': 1}, MISSING, {'conflict.role': 'two nodes'} | DEVIATING, 'two nodes')],
    # A lasting fault of the role is in every summary.
    [('', {'no_fix': 1}, (), DEVIATING, 'signals deviate'),
     ('', {'no_fix': 1}, (), DEVIATING, 'signals deviate'), ('', {'no_fix': 1}, (), {}, '')]])
def test_faults_are_summarised(reports):
    statistics = RoleStatistics()
    for phase, counters, missing, status, expected in reports:
        statistics.missing = missing
        report = statistics.report(phase, counters, status=status)
        assert report.fault == bool(expected)
        assert report.summary == (expected or phase or 'no fault')
        assert report.details.items() >= status.items()
