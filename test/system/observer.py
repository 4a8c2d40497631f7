"""The observer of both kinds of trials: cycles, invariants and diagnostics of a network."""

import contextlib
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile
from ros_messages import codebook_from_ros

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import cycle_log
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import diagnostics, topics
from rhs_isac_ros.ros.convert import deserialize
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED, subscribe
from rhs_isac_ros.ros.observer import CycleObserver
from system import invariants

# Maximum time to recover, for all trials [s].
RECOVERY_LIMIT_S = 3.0


class NetworkObserver(CycleObserver):
    """Collects the cycles of a network, checks its results and keeps its diagnostics.

    Malformed messages are ignored here; the nodes count them.
    """

    def __init__(self, scenario: Scenario, **node_options: Any) -> None:
        super().__init__(
            receives=dict.fromkeys((*cycle_log.RECEIVES, *invariants.RECEIVES)),
            scenario=scenario, on_malformed=lambda error: None, **node_options)
        # This executor takes messages in the order of their arrival. The standard executor takes
        # one message of each topic in turn, so under load the queue of feed signals overflows.
        self._executor = EventsExecutor()
        self._executor.add_node(self)
        self.invariants = invariants.InvariantChecker(scenario)
        # Newest report of each node by name, and the distinct summaries of those with a fault.
        self.reports: dict[str, Report] = {}
        self.warnings: dict[str, list[str]] = {}
        self.n_codebooks = 0
        # Called when a cycle enters a phase.
        self.on_phase: Callable[[m.Phase], None] = lambda phase: None
        self._subscribe(ros.Codebook, topics.CODEBOOK, LATCHED, self._on_codebook)
        self._subscribe(
            DiagnosticArray, topics.DIAGNOSTICS, EXCHANGE, self._on_diagnostics)

    def observe(self, message: m.Message, now_s: float) -> None:
        """Process a message that arrived at `now_s` [s]."""
        super().observe(message, now_s)
        if isinstance(message, invariants.RECEIVES):
            self.invariants.add(message, now_s)
        match message:
            case m.Beacon():
                self.on_phase(m.Phase.BEACONING)
            case m.ProtocolState(outcome=''):
                self.on_phase(message.phase)

    def spin_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Receive messages until a condition holds, or for a time [s]; return whether it does."""
        end_s = time.monotonic() + timeout_s
        while not condition():
            remaining_s = end_s - time.monotonic()
            if remaining_s <= 0:
                return False
            self._executor.spin_once(timeout_sec=min(remaining_s, 0.05))
        return True

    def destroy_node(self) -> None:
        """End the executor, then destroy the node."""
        self._executor.shutdown()
        super().destroy_node()

    def spin_for(self, duration_s: float) -> None:
        """Receive messages for a time [s]."""
        self.spin_until(lambda: False, duration_s)

    def _subscribe(
            self, kind: type, name: str, profile: QoSProfile,
            callback: Callable[[Any], None]) -> None:
        def receive(serialized: bytes, _: object) -> None:
            with contextlib.suppress(CodebookError, ValueError):
                callback(deserialize(serialized, kind))
        subscribe(self, kind, name, receive, profile, raw=True)

    def _on_codebook(self, message: ros.Codebook) -> None:
        self.n_codebooks += 1
        self.invariants.add_codebook(codebook_from_ros(message))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for name, report in diagnostics.from_ros(message, self.get_namespace()):
            self.reports[name] = report
            if report.fault:
                warnings = self.warnings.setdefault(name, [])
                if report.summary not in warnings:
                    warnings.append(report.summary)
