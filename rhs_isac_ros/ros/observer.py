"""A node that watches the cycles of a network from outside."""

import time
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node

from rhs_isac_ros.protocol import cycle_log
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics


class CycleObserver(Node):
    """Collects the cycles that it sees on the topics.

    Attributes
    ----------
    log
        The cycles.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('cycle_observer', **node_options)
        self.log = cycle_log.CycleLog()
        for kind in cycle_log.RECEIVES:
            self.create_subscription(
                convert.ros_type(kind), topics.NAMES[kind],
                lambda message, kind=kind: self._on_message(kind, message), qos.EXCHANGE,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))

    def _on_message(self, kind: type[m.Message], message: Any) -> None:
        self.log.add(convert.from_ros(kind, message), time.monotonic())
