"""Listening to a network from outside: what is malformed is dropped, with a word in the log."""

from collections.abc import Callable, Iterable, Mapping

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics


def listen(
        node: Node, kinds: Iterable[type[m.Message]], sizes: Mapping[str, int] | None,
        then: Callable[[m.Message], None],
        dropped: Callable[[m.MessageError], None] | None = None) -> None:
    """Subscribe to messages of the protocol.

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

    def take(kind: type[m.Message], message: object) -> None:
        try:
            plain = convert.from_ros(kind, message)
            if sizes is not None:
                m.check(plain, sizes)
        except m.MessageError as error:
            (dropped or complain)(error)
            return
        then(plain)
    for kind in kinds:
        node.create_subscription(
            convert.ros_type(kind), topics.NAMES[kind],
            lambda message, kind=kind: take(kind, message), qos.of(kind),
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))
