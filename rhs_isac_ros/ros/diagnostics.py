"""The diagnostics of the nodes, published as `diagnostic_msgs/DiagnosticArray`."""

import socket
import time
from collections.abc import Callable, Iterator

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from std_msgs.msg import Header

from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.ros import endpoints, topics

_PERIOD_S, _TOLERANCE_S = 1.0, 0.05
# Name of the detail with the computed share of a table.
TABLE_PROGRESS = 'table.progress'


def to_ros(report: Report, name: str, stamp: Time) -> DiagnosticArray:
    """Convert a report to an array of one status, OK or WARN; `name` is the node's full name."""
    level = DiagnosticStatus.WARN if report.fault else DiagnosticStatus.OK
    values = [KeyValue(key=key, value=value) for key, value in report.details.items()]
    status = DiagnosticStatus(
        level=level, name=name.lstrip('/'), message=report.summary,
        hardware_id=f'{socket.gethostname()}:{name}', values=values)
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])


def from_ros(message: DiagnosticArray, namespace: str) -> Iterator[tuple[str, Report]]:
    """Yield the name, without the leading slash, and the report of each node in a namespace."""
    for status in message.status:
        if status.name.rpartition('/')[0] == namespace.strip('/'):
            yield status.name, Report(
                status.level != DiagnosticStatus.OK, status.message,
                {pair.key: pair.value for pair in status.values})


def subscribe_reports(node: Node, on_report: Callable[[str, Report], None]) -> None:
    """Call `on_report` with name and report when a node in the namespace of `node` reports."""
    namespace = node.get_namespace()

    def receive(message: DiagnosticArray) -> None:
        for name, report in from_ros(message, namespace):
            on_report(name, report)
    endpoints.subscribe(node, DiagnosticArray, topics.DIAGNOSTICS, receive, endpoints.EXCHANGE)


def make_reporter(node: Node, report: Callable[[], Report]) -> Callable[[], bool]:
    """Return a function that publishes the result of `report`, at most once a second.

    The function returns whether the topic has subscribers.
    """
    publisher = endpoints.create_publisher(
        node, DiagnosticArray, topics.DIAGNOSTICS, endpoints.EXCHANGE)

    due_s = 0.0

    def publish() -> bool:
        nonlocal due_s
        # A timer may expire early.
        if time.monotonic() > due_s - _TOLERANCE_S:
            due_s = time.monotonic() + _PERIOD_S
            # Called even without subscribers: a report contains the faults since the previous one.
            found = report()
            endpoints.publish_if_subscribed((publisher,), lambda: to_ros(
                found, node.get_fully_qualified_name(), node.get_clock().now().to_msg()))
        return publisher.get_subscription_count() > 0
    return publish
