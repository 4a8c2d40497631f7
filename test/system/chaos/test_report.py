"""Texts and figures of the chaos trials."""

import math

import pytest

from rhs_isac_ros.model import Scenario
from system.chaos import report
from system.chaos.crashes import CrashTrial
from system.chaos.fuzzing import FuzzResult
from system.chaos.intruders import IntrusionTrial
from system.chaos.soaking import SoakResult
from system.invariants import InvariantChecker


def crash_trial(**fields):
    given = {'node': 'rhs_controller', 'phase': 'positioning', 'kill_delay_s': 1e-3,
             'recovery_s': 1.0, 'others_running': True,
             'logged': ('bs: user 1 given up: rhs_silent',), 'diagnosed': ('bs',),
             'violations': ()}
    return CrashTrial(**given | fields)


def figures_of(*trials, violations=()):
    checker = InvariantChecker(Scenario())
    checker.violations = list(violations)
    return report.trial_figures(trials, checker)


def test_trials_with_recovery_and_reports_pass():
    figures = figures_of(crash_trial(), crash_trial(recovery_s=2.5))
    assert figures['passed']
    assert (figures['trials'], figures['trials_recovered'], figures['trials_reported']) == (
        2, 2, 2)
    assert (figures['worst_recovery_s'], figures['wrong_publications']) == (2.5, 0)
    assert report.trial_summary('crashes', [crash_trial(), crash_trial(recovery_s=2.5)]) == (
        'crashes: 2 of 2 reported once; 2 of 2 recovered within the limit, slowest: 2.50 s')
    assert report.publication_summary(figures).startswith('0 wrong publications among 0, 0 of')
    assert report.crash_line(crash_trial()).split() == [
        'rhs_controller', 'positioning', '1.00', 's', 'running', 'bs;', 'bs']


@pytest.mark.parametrize('fields, mark', [
    ({'recovery_s': 3.01}, 'NOT IN TIME'), ({'recovery_s': math.inf}, 'NOT IN TIME'),
    ({'others_running': False}, 'ENDED'), ({'logged': ()}, 'NOT REPORTED ONCE'),
    ({'diagnosed': ()}, 'NOT REPORTED ONCE'),
    ({'logged': ('bs: missing', 'bs: missing')}, 'NOT REPORTED ONCE')])
def test_a_trial_fails_if_recovery_is_late_a_process_ends_or_the_report_is_missing_or_repeated(
        fields, mark):
    failed = crash_trial(**fields)
    assert not figures_of(crash_trial(), failed)['passed']
    assert mark in report.crash_line(failed)


def test_an_intrusion_passes_under_the_same_conditions():
    given = {'intruder': 'bs', 'served': 20, 'recovery_s': 1.5, 'others_running': True,
             'logged': ('bs: two nodes', 'intruder: two nodes'), 'diagnosed': ('bs',),
             'violations': ()}
    passed = IntrusionTrial(**given)
    assert figures_of(crash_trial(), passed)['passed']
    assert report.intrusion_line(passed).split() == [
        'bs', '20', '1.50', 's', 'running', 'bs,', 'intruder;', 'bs']
    for failed in ({'recovery_s': 3.01}, {'logged': ()}, {'logged': ('bs: two nodes',) * 2}):
        assert not figures_of(IntrusionTrial(**given | failed))['passed']


def test_violations_fail_and_are_printed():
    assert not figures_of(crash_trial(), violations=['PositionEstimate of cycle 3'])['passed']
    assert '  VIOLATION: x' in report.crash_line(crash_trial(violations=('x',)))


def soak_result(**fields):
    given = {'minutes': 10.0, 'outcomes': {'served': 995, 'user_gone': 5}, 'estimates': 996,
             'retries': {'retry_band': 40}, 'impaired': {'loss': 80},
             'memory_bytes': {'bs': (100, 104)}, 'ended': ()}
    return SoakResult(**given | fields)


def test_a_soak_test_passes_within_its_limits():
    result = soak_result()
    assert (result.cycles, result.estimate_share) == (1000, 0.996)
    assert result.passed
    assert not soak_result(estimates=989).passed
    assert not soak_result(memory_bytes={'bs': (100, 106)}).passed
    assert not soak_result(ended=('bs',)).passed
    assert report.soak_figures(result, InvariantChecker(Scenario()))['passed']


def test_fuzzing_passes_if_all_malformed_messages_were_counted():
    given = {'sent': {'beacon': 5}, 'malformed': {'bs': 3}, 'counted': {'bs': 3},
             'dropped': {'malformed': 3}, 'ended': (), 'traces': (), 'recovery_s': 0.5}
    assert FuzzResult(**given).passed
    for failed in ({'counted': {'bs': 2}}, {'ended': ('bs',)}, {'traces': ('bs: Traceback',)}):
        assert not FuzzResult(**given | failed).passed
    figures = report.fuzz_figures(FuzzResult(**given))
    assert (figures['mutations'], figures['passed']) == (5, True)
