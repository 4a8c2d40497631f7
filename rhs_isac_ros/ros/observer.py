"""A node that observes the cycles of a network."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rclpy.node import Node

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import cycle_log
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.recording import Recorder


class CycleObserver(Node):
    """Collects the cycles of the network in its namespace, with times of `time.monotonic`.

    `receives`, `scenario` and `on_malformed` are those of `subscribe_messages`. With a `recorder`,
    which the caller closes, the observer also records the topics of the namespace.
    """

    def __init__(
            self, recorder: Recorder | None = None,
            receives: Iterable[type[m.Message]] = cycle_log.RECEIVES,
            scenario: Scenario | None = None,
            on_malformed: Callable[[m.MessageError], None] | None = None,
            log: cycle_log.CycleLog | None = None, **node_options: Any) -> None:
        super().__init__('cycle_observer', **node_options)
        self.log = log or cycle_log.CycleLog()
        if recorder:
            recorder.record_topics(self)
        endpoints.subscribe_messages(self, receives, scenario, self.observe, on_malformed,
                                     exchange=endpoints.OBSERVATION)

    @property
    def complete(self) -> Sequence[cycle_log.CompleteCycle]:
        """Served cycles whose messages have all arrived."""
        return self.log.complete

    def observe(self, message: m.Message, now_s: float) -> None:
        """Process a message that arrived at `now_s` [s]; subclasses may extend this method."""
        if isinstance(message, cycle_log.RECEIVES):
            self.log.add(message, now_s)
