"""The subscriptions of a role, to messages for all nodes and for this node alone."""

import collections
import functools
from collections.abc import Callable, Iterable

from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.delivery import DELIVERIES, USER, deliveries_to
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
        self._delivery_topics = {one.kind: _delivery_topics(one.kind) for one in self._deliveries}
        self._subscribed: set[type[m.Message]] = set()
        # Messages that are received on the topics for all nodes as well, and the latest of them.
        self._both: set[type[m.Message]] = set()
        self._recent: collections.deque[bytes] = collections.deque(maxlen=_MAX_RECENT)

    def subscribe(self, kinds: Iterable[type[m.Message]]) -> None:
        """Create the subscriptions to messages that have none."""
        for kind in kinds:
            if kind in self._subscribed:
                continue
            self._subscribed.add(kind)
            delivery = next((one for one in self._deliveries if one.kind is kind), None)
            if delivery is None:
                self._create(kind, topics.NAMES[kind])
                continue
            self._create(kind, topics.delivery(kind, delivery.recipient))
            if delivery.recipient == USER:
                self._create(kind, topics.delivery(kind, self._instance))

    def _create(self, kind: type[m.Message], name: str) -> None:
        subscribe(self._node, convert.ros_type(kind), name,
                  functools.partial(self._receive, kind), qos.profile_for(kind), raw=True)

    def _receive(self, kind: type[m.Message], content: bytes) -> None:
        if kind in self._both:
            if content in self._recent:
                return
            self._recent.append(content)
        self._on_message(kind, content)

    def examine_senders(self) -> None:
        """Subscribe to the topics for all nodes if a publisher uses no others."""
        for kind in {one.kind for one in self._deliveries} & self._subscribed - self._both:
            n_delivering = sum(self._n_publishers(name) for name in self._delivery_topics[kind])
            if self._n_publishers(topics.NAMES[kind]) > n_delivering:
                self._both.add(kind)
                self._create(kind, topics.NAMES[kind])

    def _n_publishers(self, name: str) -> int:
        # The counts do not apply remapping rules.
        return self._node.count_publishers(self._node.resolve_topic_name(name))


def _delivery_topics(kind: type[m.Message]) -> frozenset[str]:
    """Return topics on which each node that delivers a message has one publisher."""
    recipients = {one.sender: one.recipient for one in DELIVERIES if one.kind is kind}
    return frozenset(topics.delivery(kind, recipient) for recipient in recipients.values())
