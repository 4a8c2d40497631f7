"""The node that watches the network from a host of its own."""

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import cycle_log, invariants
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.subscriptions import listen, subscribe


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
        self.promises = invariants.InvariantChecker(scenario)
        self.warnings: dict[str, list[str]] = {}
        kinds = dict.fromkeys((*cycle_log.RECEIVES, *invariants.RECEIVES))
        listen(self, kinds, scenario.sizes, self._on_message)
        subscribe(self, DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, qos.EXCHANGE)
        subscribe(self, ros.Codebook, topics.CODEBOOK, lambda message: self.promises.know(
            convert.codebook_from_ros(message)), qos.LATCHED)

    def _on_message(self, message: m.Message) -> None:
        now_s = time.monotonic()
        if isinstance(message, cycle_log.RECEIVES):
            self.log.add(message, now_s)
        if isinstance(message, invariants.RECEIVES):
            self.promises.add(message, now_s)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.level == DiagnosticStatus.WARN:
                known = self.warnings.setdefault(status.name, [])
                if status.message not in known:
                    known.append(status.message)
