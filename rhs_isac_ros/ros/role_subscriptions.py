"""The subscriptions of a role, to messages for all nodes and for this node alone."""

import collections
import functools
from collections.abc import Callable, Iterable

from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.delivery import DELIVERIES, USER, Recipient, deliveries_to
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.subscriptions import subscribe

# Number of messages kept to recognise copies; those of a cycle are fewer.
_MAX_RECENT = 32


class RoleSubscriptions:
    """Subscribes to the messages of a role.

    Messages of `DELIVERIES` are received on the topics for this role or node. A publisher that
    does not deliver them, such as ``ros2 topic pub``, makes the node subscribe to the topic for
    all nodes as well.

    Parameters
    ----------
    recipient
        The role.
    instance
        Instance of the node.
    on_message
        Called with the class and the serialized content of each message.
    """

    def __init__(
            self, node: Node, recipient: str, instance: int,
            on_message: Callable[[type[m.Message], bytes], None]) -> None:
        self._node, self._instance, self._on_message = node, instance, on_message
        self._deliveries = deliveries_to(recipient)
        # By message: the topic for all nodes, and topics on which each node that delivers has one
        # publisher. The counts do not apply remapping rules.
        self._names = {one.kind: (
            node.resolve_topic_name(topics.NAMES[one.kind]),
            [*map(node.resolve_topic_name, _delivery_topics(one.kind))])
            for one in self._deliveries}
        self._subscribed: set[type[m.Message]] = set()
        # Messages with a publisher that the last examination found to use no other topic.
        self._suspected: set[type[m.Message]] = set()
        # Messages that are received on the topics for all nodes as well. Of the latest, by topic
        # for all nodes or not, those whose copy on the other topic has not arrived.
        self._both: set[type[m.Message]] = set()
        self._single: collections.deque[tuple[bool, bytes]] = collections.deque(
            maxlen=_MAX_RECENT)

    def subscribe(self, kinds: Iterable[type[m.Message]]) -> None:
        """Create the subscriptions to messages that have none."""
        for kind in kinds:
            if kind in self._subscribed:
                continue
            self._subscribed.add(kind)
            delivery = next((one for one in self._deliveries if one.kind is kind), None)
            if delivery is None:
                self._create(kind)
                continue
            self._create(kind, delivery.recipient)
            if delivery.recipient == USER:
                self._create(kind, self._instance)

    def _create(self, kind: type[m.Message], recipient: Recipient | None = None) -> None:
        """Subscribe to the topic for a recipient; None: for all nodes."""
        name = topics.NAMES[kind] if recipient is None else topics.delivery(kind, recipient)
        subscribe(self._node, convert.ros_type(kind), name,
                  functools.partial(self._receive, kind, recipient is None),
                  qos.profile_for(kind), raw=True)

    def _receive(self, kind: type[m.Message], to_all: bool, content: bytes) -> None:
        """Pass a message on, unless it is a copy of one that came on the other topic.

        Messages that are equal on one topic are not copies: a sender by hand may repeat them.
        """
        if kind in self._both:
            other = not to_all, content
            if other in self._single:
                self._single.remove(other)
                return
            self._single.append((to_all, content))
        self._on_message(kind, content)

    def examine_senders(self) -> None:
        """Subscribe to the topics for all nodes if a publisher uses no others.

        Two examinations in a row must find it, because nodes appear and disappear gradually.
        Each takes 0.2 ms.
        """
        found = {kind for kind, (documented, deliveries) in self._names.items()
                 if kind in self._subscribed - self._both
                 and self._node.count_publishers(documented) > sum(
                     map(self._node.count_publishers, deliveries))}
        for kind in found & self._suspected:
            self._both.add(kind)
            self._create(kind)
        self._suspected = found


def _delivery_topics(kind: type[m.Message]) -> frozenset[str]:
    """Return topics on which each node that delivers a message has one publisher."""
    recipients = {one.sender: one.recipient for one in DELIVERIES if one.kind is kind}
    return frozenset(topics.delivery(kind, recipient) for recipient in recipients.values())
