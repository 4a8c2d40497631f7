"""A node that passively observes the cycles of a network."""

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.node import Node

from rhs_isac_ros.monitoring import cycle_log
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.endpoints import subscribe_messages
from rhs_isac_ros.ros.recording import Recorder


class CycleObserver(Node):
    """Collects the cycles of the network in its namespace.

    Parameters
    ----------
    recorder
        Records all topics of the namespace; the caller closes it. If given, the observer
        receives exactly the recorded messages of the types `cycle_log.RECEIVES`, and ignores
        the following parameters.
    receives
        Types of the messages to receive.
    sizes
        Required sizes by symbol, as in `Scenario.sizes`; None: any.
    on_malformed
        Called with the error of each malformed message; by default it is logged.
    log
        Collects the cycles; by default a new log.

    Attributes
    ----------
    log
        The cycles, with times of `time.monotonic`.
    """

    def __init__(
            self, recorder: Recorder | None = None,
            receives: Iterable[type[m.Message]] = cycle_log.RECEIVES,
            sizes: Mapping[str, int] | None = None,
            on_malformed: Callable[[m.MessageError], None] | None = None,
            log: cycle_log.CycleLog | None = None, **node_options: Any) -> None:
        super().__init__('cycle_observer', **node_options)
        self.log = log or cycle_log.CycleLog()
        if recorder is not None:
            # One subscription for both, so that a replay yields the same cycles in the same order.
            kinds = {topics.NAMES[kind]: kind for kind in cycle_log.RECEIVES}
            recorder.record_topics(self, lambda name, message: self._on_recorded(
                kinds.get(name), message))
            return
        subscribe_messages(self, receives, sizes, self._on_message, on_malformed,
                           exchange=qos.OBSERVATION)

    def observe(self, message: m.Message, now_s: float) -> None:
        """Process a message that arrived at `now_s` [s]; subclasses may extend this."""
        if isinstance(message, cycle_log.RECEIVES):
            self.log.add(message, now_s)

    def _on_recorded(self, kind: type[m.Message] | None, message: bytes) -> None:
        if kind is not None:
            self._on_message(convert.from_bytes(kind, message))

    def _on_message(self, message: m.Message) -> None:
        self.observe(message, time.monotonic())
