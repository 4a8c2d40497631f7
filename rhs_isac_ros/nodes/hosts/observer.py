"""The node that watches the network from a host of its own."""

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import cycle_log, promises
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics


class HostsObserver(Node):
    """Collects cycles, broken promises and warnings.

    Parameters
    ----------
    scenario
        The scenario of the network.

    Attributes
    ----------
    log
        The cycles.
    promises
        Whether any was broken.
    warnings
        By node: the newest warnings of its diagnostics, each once.
    """

    def __init__(self, scenario: Scenario, **node_options: Any) -> None:
        super().__init__('hosts_observer', **node_options)
        self.log = cycle_log.CycleLog()
        self.promises = promises.Promises(scenario)
        self.warnings: dict[str, list[str]] = {}
        for kind in topics.NAMES:
            self._listen(
                convert.ros_type(kind), topics.NAMES[kind],
                lambda message, kind=kind: self._on_message(kind, message))
        self._listen(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics)
        self._listen(ros.Codebook, topics.CODEBOOK, lambda message: self.promises.know(
            convert.codebook_from_ros(message)), qos.LATCHED)

    def _listen(
            self, kind: type, topic: str, callback: Any, profile: QoSProfile = qos.EXCHANGE
    ) -> None:
        self.create_subscription(
            kind, topic, callback, profile,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))

    def _on_message(self, kind: type[m.Message], message: Any) -> None:
        plain, now_s = convert.from_ros(kind, message), time.monotonic()
        if isinstance(plain, cycle_log.RECEIVES):
            self.log.add(plain, now_s)
        if isinstance(plain, promises.RECEIVES):
            self.promises.add(plain, now_s)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.level == DiagnosticStatus.WARN:
                known = self.warnings.setdefault(status.name, [])
                if status.message not in known:
                    known.append(status.message)
