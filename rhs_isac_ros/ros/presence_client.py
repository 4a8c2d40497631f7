"""The announcement of a node, and its conflicts with other nodes."""

import time
from collections.abc import Callable

from rclpy.node import Node
from rclpy.serialization import deserialize_message

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.presences import PERIOD_S, Presence, Presences
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.endpoints import create_publisher, subscribe
from rhs_isac_ros.ros.timers import steady_timer

_last_instance = 0


def new_instance() -> int:
    """Return the instance of a node that starts now, unique in this process [ns since 1970]."""
    global _last_instance
    _last_instance = max(time.time_ns(), _last_instance + 1)
    return _last_instance


class PresenceClient:
    """Announces a node of the infrastructure, and decides whether it serves or stands by.

    Parameters
    ----------
    role
        Role of the node.
    on_change
        Called with whether the node stands by whenever the newest other node with the same role
        has appeared or gone.
    """

    def __init__(
            self, node: Node, role: str, instance: int, scenario: Scenario,
            on_change: Callable[[bool], None]) -> None:
        self._node, self._on_change, self._rival = node, on_change, 0
        self._presences = Presences(Presence(
            instance, scenario.id, role, node.get_fully_qualified_name(), scenario.fields()))
        self._publisher = create_publisher(node, ros.Presence, topics.PRESENCE, qos.LATCHED)
        subscribe(node, ros.Presence, topics.PRESENCE, self._receive, qos.PRESENCES, raw=True)
        self._timer = steady_timer(node, PERIOD_S, self._on_timer)
        self._timer.cancel()
        self._announce()

    def conflicts(self) -> dict[str, str]:
        """Return a description of each conflict, by key of the diagnostics."""
        return self._presences.conflicts()

    def _announce(self) -> None:
        self._publisher.publish(convert.presence_to_ros(
            self._presences.own, self._node.get_clock().now().to_msg()))

    def _receive(self, content: bytes) -> None:
        try:
            presence = convert.presence_from_ros(deserialize_message(content, ros.Presence))
        # Anything may be published on the topic, and rclpy raises a RuntimeError without a public
        # class.
        except (RuntimeError, ValueError):
            return
        if self._handle(self._presences.add(presence, time.time_ns(), time.monotonic())):
            self._announce()
        if self._presences.in_conflict and self._timer.is_canceled():
            self._timer.reset()

    def _on_timer(self) -> None:
        self._handle(self._presences.expire(time.monotonic()))
        # Also after the last conflict has ended: a node that was suspended receives this later.
        self._announce()
        if not self._presences.in_conflict:
            self._timer.cancel()

    def _handle(self, messages: list[LogMessage]) -> bool:
        """Log messages and report a change; return whether there is either."""
        logger = self._node.get_logger()
        for message in messages:
            # Not one line: rclpy requires a single severity for each line that logs.
            if message.warning:
                logger.warning(message.text)
            else:
                logger.info(message.text)
        # An older node that returns is not logged again, but it may have served meanwhile.
        previous, self._rival = self._rival, self._presences.rival
        changed = self._rival != previous
        if changed:
            self._on_change(self._presences.stands_by)
        return changed or bool(messages)
