"""The publishers of a role, for all nodes and for single recipients."""

import time
from collections.abc import Iterable
from typing import NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.delivery import USER, Delivery, Recipient, deliveries_from
from rhs_isac_ros.ros import convert, qos, topics

# Time from the discovery of a subscription until messages are sent to it alone [s]; its node may
# discover the publisher later.
_SETTLE_S = 0.2


class _Line(NamedTuple):
    """A publisher to a single node of users.

    Attributes
    ----------
    since_s
        Time of its creation or, if later, when it last had no subscription [s].
    """

    publisher: Publisher
    since_s: float


class RolePublishers:
    """Publishes each message on its topic, and delivers those of `DELIVERIES` to recipients.

    A node of users has topics of its own, for which the publishers are created when the first
    message is addressed to it. Until they are connected, the message goes to all nodes of users.

    Parameters
    ----------
    sender
        The role.
    """

    def __init__(self, node: Node, sender: str) -> None:
        self._node, self._sender = node, sender
        self._publishers: dict[type[m.Message], Publisher] = {}
        self._deliveries: dict[type[m.Message], dict[Delivery, Publisher]] = {}
        self._lines: dict[tuple[type[m.Message], int], _Line] = {}

    def advertise(self, kinds: Iterable[type[m.Message]]) -> None:
        """Create the publishers of messages that have none."""
        new = [kind for kind in kinds if kind not in self._publishers]
        # First, so that no recipient discovers the sender without them.
        for kind in new:
            self._deliveries[kind] = {
                one: self._create(kind, topics.delivery(kind, one.recipient))
                for one in deliveries_from(self._sender) if one.kind is kind}
        for kind in new:
            self._publishers[kind] = self._create(kind, topics.NAMES[kind])

    def withdraw(self) -> None:
        """Destroy all publishers."""
        for publisher in (
                *self._publishers.values(), *(line.publisher for line in self._lines.values()),
                *(one for ones in self._deliveries.values() for one in ones.values())):
            self._node.destroy_publisher(publisher)
        self._publishers.clear()
        self._deliveries.clear()
        self._lines.clear()

    def publish(self, kind: type[m.Message], content: bytes, to: tuple[Recipient, ...]) -> None:
        """Publish a serialized message; `to` is as in `Send`."""
        # Deliveries come first, because most subscribers of the other topic are observers.
        for one, publisher in self._deliveries[kind].items():
            lines = self._lines_to(kind, to) if one.recipient == USER else None
            if lines:
                for line in lines:
                    line.publish(content)
            elif not to or one.recipient in to or lines is not None:
                publisher.publish(content)
        self._publishers[kind].publish(content)

    def _lines_to(
            self, kind: type[m.Message], to: tuple[Recipient, ...]) -> list[Publisher] | None:
        """Return the publishers to the nodes of users among the recipients.

        Empty if one of them is not connected; None if there is none.
        """
        instances = [each for each in to if isinstance(each, int)]
        if not instances:
            return None
        found = [self._line(kind, instance) for instance in instances]
        connected = [line for line in found if line is not None]
        return connected if len(connected) == len(found) else []

    def _line(self, kind: type[m.Message], instance: int) -> Publisher | None:
        """Return the publisher to a node, or None if it is not connected."""
        line = self._lines.get((kind, instance))
        now_s = time.monotonic()
        if line is None:
            # Instances come from messages; only those with a subscription get a publisher.
            name = topics.delivery(kind, instance)
            if not instance or not self._node.count_subscribers(
                    self._node.resolve_topic_name(name)):
                return None
            self._remove_unused()
            line = self._lines[kind, instance] = _Line(self._create(kind, name), now_s)
        if not line.publisher.get_subscription_count():
            # The connection may have been interrupted; both sides then discover each other anew.
            self._lines[kind, instance] = line._replace(since_s=now_s)
            return None
        return line.publisher if now_s >= line.since_s + _SETTLE_S else None

    def _remove_unused(self) -> None:
        """Destroy the publishers to nodes that have gone."""
        end_s = time.monotonic() - _SETTLE_S
        unused = [key for key, line in self._lines.items()
                  if line.since_s < end_s and not line.publisher.get_subscription_count()]
        for key in unused:
            self._node.destroy_publisher(self._lines.pop(key).publisher)

    def _create(self, kind: type[m.Message], name: str) -> Publisher:
        return self._node.create_publisher(convert.ros_type(kind), name, qos.profile_for(kind))
