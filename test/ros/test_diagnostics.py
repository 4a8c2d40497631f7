"""The diagnostics of the nodes."""

import re
import socket
import types
from pathlib import Path

import pytest
import yaml
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.ros import diagnostics, topics
from rhs_isac_ros.ros.diagnostics import from_ros, make_reporter, to_ros
from rhs_isac_ros.ros.endpoints import EXCHANGE


@pytest.mark.parametrize(('fault', 'level'), [
    (False, DiagnosticStatus.OK), (True, DiagnosticStatus.WARN)])
def test_a_report_becomes_one_status(fault, level):
    values = {'phase': 'resting', 'cycles.served': '3'}
    report = Report(fault, 'a summary', values)
    message = to_ros(report, '/a/bs', Time(sec=4))
    (status,) = message.status
    assert message.header.stamp.sec == 4
    assert (status.level, status.name, status.message) == (level, 'a/bs', 'a summary')
    assert status.hardware_id == f'{socket.gethostname()}:/a/bs'
    assert {pair.key: pair.value for pair in status.values} == values
    assert list(from_ros(message, '/a')) == [('a/bs', report)]


def test_the_analyzer_of_the_pages_selects_the_nodes_of_its_namespace():
    """A status belongs to a GenericAnalyzer if its name starts with one of these texts."""
    page = (Path(__file__).parents[2] / 'docs' / 'robots.rst').read_text(encoding='utf-8')
    (block,) = re.findall(r'code-block:: yaml\n\n((?: {3}.*\n)+)', page)
    (settings,) = yaml.safe_load(block).values()
    prefixes = tuple(settings['ros__parameters']['positioning']['startswith'])
    names = [to_ros(Report(False, '', {}), name, Time()).status[0].name
             for name in ('/lab/bs', '/lab/user_1', '/bs', '/hall/bs')]
    assert [name.startswith(prefixes) for name in names] == [True, True, False, False]


def test_a_report_is_published_at_most_once_a_second(bench, probe, monkeypatch):
    received, reports, now_s = [], [], 100.0
    monkeypatch.setattr(diagnostics, 'time', types.SimpleNamespace(monotonic=lambda: now_s))
    publish = make_reporter(probe, lambda: Report(False, 'unobserved', {}))
    assert publish() is False
    probe.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, received.append, EXCHANGE)

    def report():
        reports.append(None)
        return Report(False, str(len(reports)), {})
    publish = make_reporter(probe, report)
    bench.until(lambda: probe.count_subscribers(topics.DIAGNOSTICS), 'the subscription')
    # A timer of a second may expire early.
    for step_s in (0.0, 0.5, 0.4, 0.06, 0.9, 0.1):
        now_s += step_s
        assert publish()
    bench.until(lambda: len(received) == 3, 'the reports')
    assert [message.status[0].message for message in received] == ['1', '2', '3']
