"""Names and quality of service of the topics."""

import re
from pathlib import Path

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED, OBSERVATION, profile_for
from rhs_isac_ros.ros.recording import recorded_topics, type_name
from rhs_isac_ros.ros.roster import ROSTER

ALL = [*topics.NAMES.values(), topics.POSITION, topics.CODEBOOK]


def test_every_message_has_its_own_topic():
    assert set(topics.NAMES) == set(m.Message.__subclasses__())
    assert len(set(ALL)) == len(ALL)


def test_a_burst_of_messages_is_received_completely(bench, probe):
    # Such as the acks of a hundred users, or the pilots of a band, before the node spins.
    received = []
    probe.create_subscription(
        convert.ros_type(m.Ack), topics.NAMES[m.Ack], received.append, EXCHANGE)
    publisher = bench.publisher(probe, m.Ack)
    for user in range(100):
        publisher.publish(convert.ros_type(m.Ack)(cycle_id=1, user=user))
    bench.until(lambda: len(received) == 100, 'the last ack')
    assert [ack.user for ack in received] == list(range(100))


def test_a_late_joiner_receives_latched_messages_only(
        bench, probe):
    kind = convert.ros_type(m.Ack)
    publishers = {name: probe.create_publisher(kind, name, profile)
               for name, profile in (('exchange', EXCHANGE), ('latched', LATCHED))}
    for user in (1, 2):
        for publisher in publishers.values():
            publisher.publish(kind(user=user))
    late = bench.add(Node, 'late')
    received = {'exchange': [], 'latched': []}
    late.create_subscription(kind, 'exchange', received['exchange'].append, EXCHANGE)
    late.create_subscription(kind, 'latched', received['latched'].append, LATCHED)
    bench.until(lambda: received['latched'] and all(
        p.get_subscription_count() for p in publishers.values()), 'the latched message')
    for publisher in publishers.values():
        publisher.publish(kind(user=3))
    bench.until(lambda: all(messages and messages[-1].user == 3 for messages in received.values()),
                'the next message')
    assert [ack.user for ack in received['latched']] == [2, 3]
    assert [ack.user for ack in received['exchange']] == [3]


def test_only_the_statistics_are_latched():
    assert {kind for kind in topics.NAMES if profile_for(kind) is LATCHED} == {
        m.CapacityStatistics}
    assert {kind for kind in topics.NAMES if profile_for(kind) is EXCHANGE} == set(
        topics.NAMES) - {m.CapacityStatistics, m.Ack}


def test_the_queue_of_acks_holds_those_of_all_users():
    assert profile_for(m.Ack).depth == MAX_USERS
    assert profile_for(m.Ack, OBSERVATION) is OBSERVATION


def test_the_table_of_the_documentation_is_that_of_the_code():
    page = (Path(__file__).parents[2] / 'docs' / 'interfaces.rst').read_text(encoding='utf-8')
    rows = {name: (kind, published, received, quality) for name, kind, published, received, quality
            in re.findall(r'^   "``([a-z_/]+)``", "``([A-Za-z_/]+)``", "([a-z_, ]*)", '
                          r'"([a-z_, ]*)", "([a-z]+, \d+)"$', page, re.M)}
    recorded = recorded_topics()
    assert rows.keys() - {topics.MARKERS} == recorded.keys()
    for name, (kind, profile) in recorded.items():
        senders = {role for role, member in ROSTER.items() if name in member.sent}
        receivers = {role for role, member in ROSTER.items() if name in member.received}
        latched = profile.durability is DurabilityPolicy.TRANSIENT_LOCAL
        # Each publisher of announcements keeps one, a subscription those of all.
        depth = 1 if latched else profile.depth
        assert rows[name] == (
            type_name(kind).replace('/msg/', '/').removeprefix('rhs_isac_msgs/'),
            'every node except visualizer' if name == topics.DIAGNOSTICS
            else ', '.join(sorted(senders)), ', '.join(sorted(receivers)),
            f'{"latched" if latched else "volatile"}, {depth}')
        assert profile.reliability is ReliabilityPolicy.RELIABLE
