"""A node that logs the cycles of a network, and may record it."""

import time
from typing import Any

from rclpy.node import Node

from rhs_isac_ros.monitoring import cycle_log
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.recording import Recorder
from rhs_isac_ros.ros.subscriptions import listen


class CycleObserver(Node):
    """Subscribes to the messages of a network and logs its cycles.

    Parameters
    ----------
    recorder
        Recorder of all topics, if any; the caller closes it.

    Attributes
    ----------
    log
        The cycles.
    """

    def __init__(self, recorder: Recorder | None = None, **node_options: Any) -> None:
        super().__init__('cycle_observer', **node_options)
        self.log = cycle_log.CycleLog()
        if recorder is not None:
            # The log and the recorder share subscriptions, so that a replay yields the same
            # cycles in the same order.
            kinds = {topics.NAMES[kind]: kind for kind in cycle_log.RECEIVES}
            recorder.listen(self, lambda name, message: self._on_recorded(
                kinds.get(name), message))
            return
        listen(self, cycle_log.RECEIVES, None, self._on_message)

    def _on_recorded(self, kind: type[m.Message] | None, message: bytes) -> None:
        if kind is not None:
            self._on_message(convert.from_bytes(kind, message))

    def _on_message(self, message: m.Message) -> None:
        self.log.add(message, time.monotonic())
