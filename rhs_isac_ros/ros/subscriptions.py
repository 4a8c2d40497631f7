"""Subscribing, and listening to a network from outside."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics


def subscribe(
        node: Node, kind: type, name: str, callback: Callable[[Any], None], profile: QoSProfile,
        raw: bool = False) -> None:
    """Subscribe to a topic, without the events that would make executors slow.

    Parameters
    ----------
    node
        The node that listens.
    kind
        ROS type of the topic.
    name
        Name of the topic.
    callback
        Called with each message.
    profile
        Quality of service.
    raw
        Whether the callback gets the message in CDR, as bytes.
    """
    node.create_subscription(
        kind, name, callback, profile, raw=raw,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))


def listen(
        node: Node, kinds: Iterable[type[m.Message]], sizes: Mapping[str, int] | None,
        then: Callable[[m.Message], None],
        dropped: Callable[[m.MessageError], None] | None = None) -> None:
    """Subscribe to messages of the protocol; what is malformed is dropped, with a word in the log.

    Parameters
    ----------
    node
        The node that listens.
    kinds
        Classes of the messages.
    sizes
        Sizes by symbol, as `Scenario.sizes` gives them, that the messages must have; None: any.
    then
        Called with each message.
    dropped
        Called with the reason for each that is malformed; by default the node logs it.
    """
    def complain(error: m.MessageError) -> None:
        node.get_logger().warning(f'dropped: {error}', throttle_duration_sec=10.0)

    def take(kind: type[m.Message], serialized: bytes) -> None:
        try:
            plain = convert.from_bytes(kind, serialized)
            if sizes is not None:
                m.check(plain, sizes)
        except m.MessageError as error:
            (dropped or complain)(error)
            return
        then(plain)
    for kind in kinds:
        subscribe(node, convert.ros_type(kind), topics.NAMES[kind],
                  lambda serialized, kind=kind: take(kind, serialized), qos.of(kind), raw=True)
