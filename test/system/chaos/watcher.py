"""A node that watches a network from outside, and knows what it promises."""

import collections
import contextlib
import dataclasses
import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.serialization import deserialize_message

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import invariants
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.subscriptions import subscribe

_HEARS = (*invariants.RECEIVES, m.Beacon, m.ProtocolState)


@dataclasses.dataclass(frozen=True)
class End:
    """A cycle that has ended: when it was seen to begin and to end [s], and how."""

    cycle_id: int
    user: int
    began_s: float
    ended_s: float
    outcome: str


class Watcher(Node):
    """Hears everything, and remembers what became of it.

    Parameters
    ----------
    scenario
        The scenario of the network.

    Attributes
    ----------
    promises
        The watch over its results.
    ends
        Cycles that have ended, in their order.
    estimates
        How many cycles have led to an estimate.
    told
        By node: what it has told of itself last.
    on_phase
        Called with phase and cycle when a cycle enters a phase.
    """

    def __init__(self, scenario: Scenario, **node_options: Any) -> None:
        super().__init__('watcher', **node_options)
        self._sizes = scenario.sizes
        self.promises = invariants.InvariantChecker(scenario)
        self.ends: list[End] = []
        self.estimates = 0
        self.told: dict[str, DiagnosticStatus] = {}
        self.codebooks_heard = 0
        self.on_phase: Callable[[m.Phase, int], None] = lambda phase, cycle_id: None
        self._began_s: collections.OrderedDict[int, float] = collections.OrderedDict()
        self._estimated: collections.deque[int] = collections.deque(maxlen=16)
        for kind in _HEARS:
            self._subscribe(convert.ros_type(kind), topics.NAMES[kind], qos.of(kind),
                            lambda content, kind=kind: self._on_message(
                                convert.from_bytes(kind, content), time.monotonic()))
        self._subscribe(ros.Codebook, topics.CODEBOOK, qos.LATCHED,
                        lambda content: self._on_codebook(
                            deserialize_message(content, ros.Codebook)))
        self._subscribe(DiagnosticArray, topics.DIAGNOSTICS, qos.EXCHANGE,
                        lambda content: self._on_diagnostics(
                            deserialize_message(content, DiagnosticArray)))

    def spin_until(self, done: Callable[[], bool], limit_s: float) -> bool:
        """Hear messages until something is so.

        Parameters
        ----------
        done
            Tells whether it is so; asked after every message.
        limit_s
            How long at most [s].

        Returns
        -------
        bool
            Whether it is so.
        """
        end_s = time.monotonic() + limit_s
        while not done():
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return False
            rclpy.spin_once(self, timeout_sec=min(left_s, 0.05))
        return True

    def warnings(self) -> list[str]:
        """Return the nodes whose diagnostics are not well at present.

        Returns
        -------
        list of str
            Their names, sorted.
        """
        return sorted(name for name, status in self.told.items()
                      if status.level != DiagnosticStatus.OK)

    def values(self, node: str) -> dict[str, str]:
        """Return what a node has told of itself last.

        Parameters
        ----------
        node
            Its name.

        Returns
        -------
        dict
            Values by key; empty before the first time.
        """
        status = self.told.get(node)
        return {pair.key: pair.value for pair in status.values} if status else {}

    def _subscribe(
            self, kind: type, name: str, profile: Any, take: Callable[[bytes], None]) -> None:
        def receive(content: bytes) -> None:
            # What is malformed is for the nodes to count. Of what `deserialize_message` raises,
            # the class is RuntimeError at least.
            with contextlib.suppress(m.MessageError, CodebookError, RuntimeError, ValueError):
                take(content)
        subscribe(self, kind, name, receive, profile, raw=True)

    def _on_message(self, message: m.Message, now_s: float) -> None:
        m.check(message, self._sizes)
        match message:
            case m.Beacon():
                self._began_s[message.cycle_id] = now_s
                if len(self._began_s) > 16:
                    self._began_s.popitem(last=False)
                self.on_phase(m.Phase.BEACONING, message.cycle_id)
            case m.ProtocolState(outcome=''):
                self.on_phase(message.phase, message.cycle_id)
            case m.ProtocolState():
                began_s = self._began_s.get(message.cycle_id, float('nan'))
                self.ends.append(End(
                    message.cycle_id, message.user, began_s, now_s, message.outcome))
            case m.PositionEstimate() if message.cycle_id not in self._estimated:
                self._estimated.append(message.cycle_id)
                self.estimates += 1
        if isinstance(message, invariants.RECEIVES):
            self.promises.add(message, now_s)

    def _on_codebook(self, message: ros.Codebook) -> None:
        self.codebooks_heard += 1
        self.promises.know(convert.codebook_from_ros(message))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.told[status.name] = status
