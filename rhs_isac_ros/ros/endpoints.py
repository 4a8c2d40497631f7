"""Publishers and subscriptions without event handlers.

Those of subscriptions slow down executors. Those of publishers end a node that destroys one while
an observer with an incompatible quality of service is present (ros2/rclpy#1644).
"""

import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics


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
