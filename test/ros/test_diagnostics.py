"""The diagnostics of the nodes."""

import re
import socket
from pathlib import Path

import pytest
import yaml
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.diagnostics import from_ros, make_reporter, to_ros
from rhs_isac_ros.ros.endpoints import EXCHANGE, steady_timer


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


def test_a_report_is_published_at_most_once_a_second(bench, probe):
    received, reports, observed = [], [], []
    publish = make_reporter(probe, lambda: Report(False, 'unobserved', {}))
    assert publish() is False
    probe.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, received.append, EXCHANGE)

    def report():
        reports.append(None)
        return Report(False, str(len(reports)), {})
    publish = make_reporter(probe, report)
    steady_timer(probe, 0.05, lambda: observed.append(publish()))
    bench.until(lambda: len(received) >= 2, 'the second report')
    assert [message.status[0].message for message in received[:2]] == ['1', '2']
    assert len(observed) >= 10 and observed[-1]
