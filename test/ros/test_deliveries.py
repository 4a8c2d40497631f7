"""Messages to single recipients, between nodes in this process."""

import math

import pytest
from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.delivery import DELIVERIES, OBSERVERS, USER
from rhs_isac_ros.ros import convert, role_publishers, topics
from rhs_isac_ros.ros.role_publishers import RolePublishers
from rhs_isac_ros.ros.role_subscriptions import RoleSubscriptions

KINDS = (m.Beacon, m.Grant)


class Recipient:
    """A node of users that stores what it receives."""

    def __init__(self, bench, instance):
        self.received, self.instance = [], instance
        self.node = bench.add(Node, f'user_{instance}')
        self.subscriptions = RoleSubscriptions(
            self.node, USER, instance,
            lambda kind, content: self.received.append(convert.from_bytes(kind, content).user))
        self.subscriptions.subscribe(KINDS)


@pytest.fixture
def recipients(bench):
    return [Recipient(bench, 11), Recipient(bench, 12)]


@pytest.fixture
def station(bench, recipients):
    """Publishers of a base station that all recipients have discovered."""
    publishers = RolePublishers(bench.add(Node, 'bs'), 'bs')
    publishers.advertise(KINDS)
    name = f'/{topics.delivery(m.Grant, USER)}'
    bench.until(lambda: all(one.node.count_publishers(name) for one in recipients), 'publishers')
    bench.until(lambda: publishers._node.count_subscribers(name) == 2, 'subscriptions')
    return publishers


def send(publishers, user, to=()):
    publishers.publish(m.Grant, convert.to_bytes(m.Grant(cycle_id=1, user=user), 0), to)


def connect(bench, station, recipients):
    """Send to single nodes until a message reaches its recipient alone."""
    for one, other in (recipients, recipients[::-1]):
        sent = []

        def alone(one=one, other=other, sent=sent):
            # Users are numbered by recipient and attempt, so that no two messages are equal.
            if not sent or sent[-1] in one.received:
                if sent and sent[-1] not in other.received:
                    return True
                sent.append(1000 * one.instance + len(sent))
                send(station, sent[-1], to=(one.instance,))
            return False
        bench.until(alone, 'a message to one node alone')
    for one in recipients:
        one.received.clear()


def test_a_message_without_recipients_reaches_all_nodes_once(bench, station, recipients):
    send(station, 1)
    send(station, 2, to=(USER,))
    bench.until(lambda: [one.received for one in recipients] == [[1, 2]] * 2, 'both')


def test_messages_reach_all_nodes_until_their_own_topics_are_connected(
        bench, station, recipients):
    send(station, 1, to=(11,))
    bench.until(lambda: all(1 in one.received for one in recipients), 'the message')
    connect(bench, station, recipients)
    send(station, 2, to=(12,))
    send(station, 3, to=(11, 12))
    send(station, 4)
    bench.until(lambda: all(4 in one.received for one in recipients), 'the last message')
    assert [sorted(one.received) for one in recipients] == [[3, 4], [2, 3, 4]]


def test_an_unknown_instance_makes_a_message_reach_all_nodes_once(bench, station, recipients):
    connect(bench, station, recipients)
    # 0 is unknown, and 13 has no node.
    send(station, 1, to=(0,))
    send(station, 2, to=(11, 13))
    send(station, 3)
    bench.until(lambda: all(3 in one.received for one in recipients), 'the last message')
    assert [sorted(one.received) for one in recipients] == [[1, 2, 3]] * 2
    assert f'/{topics.delivery(m.Grant, 13)}' not in dict(
        station._node.get_topic_names_and_types())


def test_a_node_that_returns_has_time_to_discover_its_publisher(
        bench, station, recipients, monkeypatch):
    connect(bench, station, recipients)
    monkeypatch.setattr(role_publishers, '_SETTLE_S', 60.0)
    for key, line in station._lines.items():
        station._lines[key] = line._replace(since_s=-math.inf)
    one, lost = recipients
    bench.remove(lost.node)
    (publisher,) = (line.publisher for (_, instance), line in station._lines.items()
                    if instance == lost.instance)
    bench.until(lambda: not publisher.get_subscription_count(), 'the end of the node')
    send(station, 1, to=(lost.instance,))
    Recipient(bench, lost.instance)
    bench.until(publisher.get_subscription_count, 'the node')
    send(station, 2, to=(lost.instance,))
    bench.until(lambda: one.received == [1, 2], 'both messages')


def test_publishers_to_nodes_that_have_gone_are_removed(bench, station, recipients):
    connect(bench, station, recipients)
    gone = recipients.pop()
    name = f'/{topics.delivery(m.Grant, gone.instance)}'
    bench.remove(gone.node)
    bench.until(lambda: not station._node.count_subscribers(name), 'the end of the node')
    new = Recipient(bench, 13)
    bench.until(lambda: station._node.count_subscribers(
        f'/{topics.delivery(m.Grant, 13)}'), 'the new node')

    def removed():
        send(station, 5, to=(new.instance,))
        return not station._node.count_publishers(name)
    bench.until(removed, 'the end of the publisher')


def test_observers_receive_every_message_once(bench, station, recipients):
    connect(bench, station, recipients)
    observed = bench.collect(bench.add(Node, 'observer'), m.Grant)
    for user, to in enumerate(((), (11,), (11, 12), (OBSERVERS,)), start=1):
        send(station, user, to)
    bench.until(lambda: len(observed) >= 4, 'all messages')
    assert [message.user for message in observed] == [1, 2, 3, 4]
    assert all(4 not in one.received for one in recipients)


def test_a_message_of_a_foreign_publisher_is_received_too_and_others_once(
        bench, station, recipients):
    one, _ = recipients
    one.subscriptions.examine_senders()
    foreign = bench.add(Node, 'foreign')
    assert not foreign.count_subscribers(f'/{topics.NAMES[m.Grant]}')
    publisher = foreign.create_publisher(
        convert.ros_type(m.Grant), topics.NAMES[m.Grant], 128)

    def subscribed():
        one.subscriptions.examine_senders()
        return publisher.get_subscription_count()
    bench.until(subscribed, 'a subscription')
    # A sender by hand may repeat a message.
    for _ in range(2):
        publisher.publish(convert.to_bytes(m.Grant(cycle_id=1, user=7), 0))
    bench.until(lambda: one.received == [7, 7], 'both messages')
    bench.until(lambda: station._node.count_subscribers(f'/{topics.NAMES[m.Grant]}'), 'a match')
    for user in range(8, 20):
        send(station, user)
    bench.until(lambda: len(one.received) >= 14, 'the other messages')
    assert one.received == [7, *range(7, 20)]


def test_names_of_topics_are_distinct_and_hidden():
    names = [topics.delivery(one.kind, one.recipient) for one in DELIVERIES]
    # Base station and users share the topic of offered data.
    assert len({*names}) == len(names) - 1
    assert all(name.startswith('_') for name in names)
    assert topics.delivery(m.Grant, 5) == '_to/user_5/grant'
