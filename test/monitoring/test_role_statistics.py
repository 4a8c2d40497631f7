"""What a role tells of how it fares."""

import numpy as np
import pytest

from rhs_isac_ros.monitoring.role_statistics import RoleStatistics
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import CodebookOffered, LogMessage, PeersChanged, Send, Tick


def state(outcome, cycle_id=1):
    return Send(m.ProtocolState(
        cycle_id=cycle_id, user=1, phase=m.Phase.BEACONING, outcome=outcome, began_s=np.zeros(4),
        elapsed_s=0.5))


def test_a_role_that_has_done_nothing_tells_its_phase_only():
    report = RoleStatistics().report('waiting', {})
    assert (report.fault, report.summary) == (False, 'no fault')
    assert report.values == {'phase': 'waiting'}
    assert RoleStatistics().report('', {}).values == {}


def test_counters_are_told_by_what_they_are_about():
    counters = {'wrong_cycle': 3, 'rhs_silent': 2, 'unanswered': 7, 'not_granted': 1,
                'retry_band': 4, 'asked_again': 5, 'no_beacon': 6}
    values = RoleStatistics().report('', counters).values
    assert values == {'dropped.wrong_cycle': '3', 'cycles.rhs_silent': '2',
                      'beacons.unanswered': '7', 'cycles.not_granted': '1',
                      'retries.retry_band': '4', 'retries.asked_again': '5',
                      'beacons.no_beacon': '6'}


def test_what_is_in_use_and_what_waits_is_told(codebooks):
    books = RoleStatistics()
    told = {'parameter.policy': 'first', 'pending.policy': 'random'}

    def report(in_use):
        new = books.report('', {}, standing={'codebook_id': in_use, **told})
        assert not new.fault
        return {name: value for name, value in new.values.items() if 'handling' not in name}
    first, second, _ = (codebook.id for codebook in codebooks)
    assert report('') == told
    books.note(CodebookOffered(codebooks[0]), [], 0.0, 0.0)
    assert report('') == report(first) == {'codebook_id': first, **told}
    books.note(CodebookOffered(codebooks[1]), [], 0.0, 0.0)
    assert report(first) == {'codebook_id': first, 'pending.codebook_id': second, **told}
    assert report(second) == {'codebook_id': second, **told}


def test_messages_and_served_cycles_are_counted(codebooks):
    books = RoleStatistics()
    books.note(CodebookOffered(codebooks[1]), [], 0.0, 0.0)
    for cycle_id, outcome in enumerate(['served', 'rhs_silent', 'served'], 1):
        books.note(Tick(), [Send(m.Beacon(
            cycle_id=cycle_id, attempt=0)), LogMessage('x')], 10.0 * cycle_id, 0.0)
        books.note(Tick(), [state('', cycle_id)], 10.0 * cycle_id, 0.0)
        books.note(Tick(), [state(outcome, cycle_id)], 10.0 * cycle_id + 0.25, 0.0)
    values = books.report('', {'rhs_silent': 1}).values
    assert values['codebook_id'] == codebooks[1].id
    assert (values['cycles.served'], values['cycles.rhs_silent']) == ('2', '1')
    assert (values['sent.Beacon'], values['sent.ProtocolState']) == ('3', '6')
    assert {values[f'cycle_ms.p{percent}'] for percent in (50, 95, 99)} == {'250.000'}


def test_latencies_are_percentiles_of_the_newest(example):
    books = RoleStatistics()
    times_s = np.random.default_rng(0).exponential(size=2000)
    for time_s in times_s:
        estimate = example(m.PositionEstimate, latency_s=2 * time_s)
        books.note(Tick(), [Send(estimate)], 0.0, time_s)
    values = books.report('', {}).values
    for percent in (50, 95, 99):
        expected = 1e3 * np.percentile(times_s[-512:], percent)
        assert float(values[f'handling_ms.p{percent}']) == pytest.approx(expected, abs=1e-3)
        assert float(values[f'estimate_ms.p{percent}']) == pytest.approx(2 * expected, abs=1e-3)


def test_a_fault_is_told_once_and_a_missing_role_as_long_as_it_is_missing():
    books = RoleStatistics()
    counters = {'wrong_user': 2, 'unanswered': 5}
    first, second = (books.report('', counters) for _ in range(2))
    assert (first.fault, second.fault) == (True, False)
    assert first.summary == '2 faults just now'
    books.note(PeersChanged(('channel', 'bs')), [], 0.0, 0.0)
    for _ in range(2):
        report = books.report('', counters)
        assert (report.fault, report.summary) == (True, 'waiting for channel, bs')
    books.note(PeersChanged(()), [], 0.0, 0.0)
    assert not books.report('', counters | {'unanswered': 9}).fault


def test_a_network_tells_what_it_went_through(network):
    """The books of a base station, kept from outside, agree with what was on the bus."""
    net = network(transport=lambda message, recipient: [] if isinstance(
        message, m.ReceivedSignals) and message.cycle_id == 2 else [(1e-3, message)])
    books, role = RoleStatistics(), net['bs']
    handle = role.handle

    def noted(event, now_s):
        actions = handle(event, now_s)
        books.note(event, actions, now_s, 0.0)
        return actions
    role.handle = noted
    net.run_cycles(4)
    values = books.report(role.state.value, role.counters).values
    assert values['phase'] == 'resting'
    assert (values['cycles.served'], values['cycles.positioner_silent']) == ('3', '1')
    assert int(values['sent.Beacon']) == len(net.sent(m.Beacon)) - 1
    assert 10 < float(values['cycle_ms.p50']) < 50
