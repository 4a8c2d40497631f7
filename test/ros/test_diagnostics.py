"""What nodes tell of themselves."""

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.ros import qos, topics
from rhs_isac_ros.ros.diagnostics import Diagnostics, from_ros, to_ros


@pytest.mark.parametrize(('fault', 'level'), [
    (False, DiagnosticStatus.OK), (True, DiagnosticStatus.WARN)])
def test_a_report_becomes_one_status(fault, level):
    values = {'phase': 'resting', 'cycles.served': '3'}
    told = to_ros(Report(fault, 'in words', values), '/a/bs', Time(sec=4))
    (status,) = told.status
    assert told.header.stamp.sec == 4
    assert (status.level, status.name, status.message) == (level, 'a/bs', 'in words')
    assert {pair.key: pair.value for pair in status.values} == values


@pytest.mark.parametrize('fault', [False, True])
def test_a_report_comes_back_from_ros(fault):
    report = Report(fault, 'in words', {'phase': 'resting', 'cycles.served': '3'})
    assert list(from_ros(to_ros(report, '/a/bs', Time()))) == [('a/bs', report)]


def test_a_node_tells_once_a_second(bench, probe):
    heard, asked = [], []
    probe.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, heard.append, qos.EXCHANGE)

    def report():
        asked.append(None)
        return Report(False, str(len(asked)), {})
    Diagnostics(probe, report)
    bench.until(lambda: len(heard) == 2, 'the second report')
    assert [told.status[0].message for told in heard] == ['1', '2']
    stamps_s = [told.header.stamp.sec + 1e-9 * told.header.stamp.nanosec for told in heard]
    assert 0.5 < stamps_s[1] - stamps_s[0] < 10
