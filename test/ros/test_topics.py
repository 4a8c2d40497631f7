"""Names and quality of service of the topics."""

import pytest
from rclpy.node import Node
from rclpy.validate_topic_name import validate_topic_name

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics

ALL = [*topics.NAMES.values(), topics.POSITION, topics.CODEBOOK, topics.DIAGNOSTICS]


def test_every_message_has_a_topic_of_its_own():
    assert set(topics.NAMES) == set(m.Message.__subclasses__())
    assert len(set(ALL)) == len(ALL)


@pytest.mark.parametrize('name', ALL)
def test_names_are_valid_and_relative(name):
    assert validate_topic_name(name)
    assert not name.startswith(('/', '~'))


def test_a_burst_of_messages_is_received_whole(bench, probe):
    # The acks of a hundred users, or the pilots of a band, before anybody spins.
    heard = []
    probe.create_subscription(
        convert.ros_type(m.Ack), topics.NAMES[m.Ack], heard.append, qos.EXCHANGE)
    outlet = bench.outlet(probe, m.Ack)
    for user in range(100):
        outlet.publish(convert.ros_type(m.Ack)(cycle_id=1, user=user))
    bench.until(lambda: len(heard) == 100, 'the last ack')
    assert [ack.user for ack in heard] == list(range(100))


def test_who_joins_late_gets_the_last_of_what_is_latched_and_nothing_of_the_exchange(
        bench, probe):
    kind = convert.ros_type(m.Ack)
    outlets = {name: probe.create_publisher(kind, name, profile)
               for name, profile in (('exchange', qos.EXCHANGE), ('latched', qos.LATCHED))}
    for user in (1, 2):
        for outlet in outlets.values():
            outlet.publish(kind(user=user))
    late = bench.add(Node, 'late')
    heard = {'exchange': [], 'latched': []}
    late.create_subscription(kind, 'exchange', heard['exchange'].append, qos.EXCHANGE)
    late.create_subscription(kind, 'latched', heard['latched'].append, qos.LATCHED)
    bench.until(lambda: heard['latched'] and all(
        outlet.get_subscription_count() for outlet in outlets.values()), 'what is latched')
    for outlet in outlets.values():
        outlet.publish(kind(user=3))
    bench.until(lambda: all(messages and messages[-1].user == 3 for messages in heard.values()),
                'what comes next')
    assert [ack.user for ack in heard['latched']] == [2, 3]
    assert [ack.user for ack in heard['exchange']] == [3]


def test_the_statistics_are_latched_and_nothing_else_of_the_protocol():
    assert {kind for kind in topics.NAMES if qos.of(kind) is qos.LATCHED} == {
        m.CapacityStatistics}
    assert {kind for kind in topics.NAMES if qos.of(kind) is qos.EXCHANGE} == set(
        topics.NAMES) - {m.CapacityStatistics}
