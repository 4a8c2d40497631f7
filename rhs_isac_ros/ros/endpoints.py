"""Timers, and publishers and subscriptions without event handlers.

Those of subscriptions slow down executors. Those of publishers end a node that destroys one while
an observer with an incompatible quality of service is present (ros2/rclpy#1644).
"""

import functools
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.timer import Timer

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Create a running timer on the steady clock, which the deadlines of the roles refer to."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def create_publisher(node: Node, kind: type, name: str, profile: QoSProfile) -> Publisher:
    """Create a publisher of a ROS type on a topic."""
    return node.create_publisher(
        kind, name, profile,
        event_callbacks=PublisherEventCallbacks(use_default_callbacks=False))


def subscribe(
        node: Node, kind: type, name: str, callback: Callable[[Any], None], profile: QoSProfile,
        raw: bool = False) -> None:
    """Subscribe to a topic.

    Parameters
    ----------
    kind
        ROS type of the topic.
    name
        Name of the topic.
    callback
        Called with each message, or with its serialized bytes (CDR) if `raw`.
    """
    node.create_subscription(
        kind, name, callback, profile, raw=raw,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))


def subscribe_messages(
        node: Node, kinds: Iterable[type[m.Message]], sizes: Mapping[str, int] | None,
        on_message: Callable[[m.Message], None],
        on_error: Callable[[m.MessageError], None] | None = None,
        scenario_id: str = '', exchange: QoSProfile = qos.EXCHANGE) -> None:
    """Subscribe to messages of the protocol; malformed ones are dropped.

    Parameters
    ----------
    sizes
        Required array sizes by symbol, as in `Scenario.sizes`; None: any.
    on_error
        Called with the reason why a message was dropped; by default, the node logs it.
    scenario_id
        If given, messages of other scenarios are ignored.
    exchange
        Quality of service for messages that are not latched.
    """
    def log(error: m.MessageError) -> None:
        node.get_logger().warning(f'dropped: {error}', throttle_duration_sec=10.0)

    def receive(kind: type[m.Message], serialized: bytes) -> None:
        try:
            plain = convert.from_bytes(kind, serialized)
            if scenario_id and plain.scenario_id not in ('', scenario_id):
                return
            if sizes is not None:
                m.check(plain, sizes)
        except m.MessageError as error:
            (on_error or log)(error)
            return
        on_message(plain)
    for kind in kinds:
        subscribe(node, convert.ros_type(kind), topics.NAMES[kind],
                  functools.partial(receive, kind), qos.profile_for(kind, exchange), raw=True)


# Every topic takes time in discovery, and the ids of the users come from messages.
MAX_USERS = 64
# A user without messages for this time [s] gives up its topics if another user needs them.
_IDLE_S = 60.0


class UserTopics:
    """Publishers for each of the first `MAX_USERS` users.

    Parameters
    ----------
    kinds
        Types by name of the topic, which contains ``{user}``.
    """

    def __init__(self, node: Node, kinds: Mapping[str, type]) -> None:
        self._node, self._kinds = node, kinds
        self._publishers: dict[int, tuple[Publisher, ...]] = {}
        # Time of the latest use [s], by user; the user idle for longest comes first.
        self._used_s: dict[int, float] = {}

    def publishers(self, user: int) -> tuple[Publisher, ...]:
        """Return the publishers for a user, in the order of `kinds`; empty if there are too many.

        They are created on first use.
        """
        now_s = time.monotonic()
        if user not in self._publishers and not self._has_space(now_s):
            self._node.get_logger().warning(
                f'no topics for user {user}: {MAX_USERS} users have topics', once=True)
            return ()
        if user not in self._publishers:
            self._publishers[user] = tuple(
                create_publisher(self._node, kind, name.format(user=user), qos.EXCHANGE)
                for name, kind in self._kinds.items())
        self._used_s.pop(user, None)
        self._used_s[user] = now_s
        return self._publishers[user]

    def remove(self, user: int) -> None:
        """Destroy the publishers for a user, if any."""
        self._used_s.pop(user, None)
        for publisher in self._publishers.pop(user, ()):
            self._node.destroy_publisher(publisher)

    def _has_space(self, now_s: float) -> bool:
        if len(self._publishers) < MAX_USERS:
            return True
        idle, used_s = next(iter(self._used_s.items()))
        if now_s < used_s + _IDLE_S:
            return False
        self.remove(idle)
        return True
