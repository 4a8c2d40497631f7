"""Nodes that announce themselves, on real topics."""

import time

import numpy as np
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.nodes.optimizer import OptimizerNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import PlainRole
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.codebook_client import CodebookClient
from rhs_isac_ros.ros.presence_client import PresenceClient, new_instance
from rhs_isac_ros.ros.role_node import RoleNode


class Radio(PlainRole):
    """A role that collects its events."""

    SENDS, RECEIVES = (m.FeedSignals,), (m.Pilot,)

    def __init__(self):
        super().__init__()
        self.events = []

    def handle(self, event, now_s):
        self.events.append(event)
        return []


def test_instances_are_times_and_differ():
    before = time.time_ns()
    instances = [new_instance() for _ in range(1000)]
    assert before <= instances[0]
    assert instances == sorted(set(instances))


@pytest.fixture
def add_channel(bench):
    """Function that adds a node with the role of the channel."""
    def add(name='channel'):
        node = bench.add(RoleNode, 'channel', name)
        node.start(Radio())
        return node
    return add


def test_the_older_node_stands_by_and_resumes(each_bench, capfd):
    probe = each_bench.add(Node, 'probe')
    nodes = []
    for name in ('older', 'newer'):
        nodes.append(each_bench.add(RoleNode, 'channel', name))
        nodes[-1].start(Radio())
    older, newer = nodes
    topic = f'/{topics.NAMES[m.FeedSignals]}'

    def publishers():
        return [info.node_name for info in probe.get_publishers_info_by_topic(topic)]
    each_bench.until(lambda: publishers() == ['newer'], 'the withdrawal')
    assert 'stands by for /newer' in older.report().summary
    each_bench.until(lambda: newer.report().fault, 'the report of the newer node')
    assert 'serves instead of /older' in newer.report().summary
    pilots = each_bench.publisher(probe, m.Pilot)
    pilot = m.Pilot(cycle_id=1, user=1, band=0, symbols=np.ones(4, complex))
    each_bench.until(lambda: pilots.get_subscription_count() == 2, 'both subscriptions')
    pilots.publish(convert.to_ros(pilot, None))
    each_bench.until(lambda: newer.role.events, 'the pilot')
    each_bench.remove(newer)
    each_bench.until(lambda: publishers() == ['older'], 'the resumption')
    assert not older.report().fault
    assert not older.role.events
    pilots.publish(convert.to_ros(pilot, None))
    each_bench.until(lambda: older.role.events, 'the pilot after the resumption')
    log = capfd.readouterr().err
    assert log.count('this one stands by for /newer') == 1
    assert log.count('this one serves instead of /older') == 1


def test_nothing_is_announced_repeatedly_without_a_conflict(bench, probe, add_channel):
    received = []
    probe.create_subscription(ros.Presence, topics.PRESENCE, received.append, qos.PRESENCES)
    node = add_channel()
    bench.until(lambda: received, 'the announcement')
    assert received[0].sender == node.instance
    assert received[0].node == '/channel'
    assert received[0].scenario_id == node.scenario.id
    assert node._presence._timer.is_canceled()
    # Another role is no conflict.
    other = bench.add(Node, 'other')
    PresenceClient(other, 'bs', new_instance(), node.scenario, lambda stands_by: None)
    bench.until(lambda: len(received) == 2, 'the other announcement')
    assert node._presence._timer.is_canceled()


@pytest.mark.parametrize('scenario', ['[', '3', 'a: b: c'])
def test_invalid_announcements_are_ignored(bench, probe, add_channel, scenario):
    node = add_channel()
    publisher = probe.create_publisher(ros.Presence, topics.PRESENCE, qos.LATCHED)
    bench.until(publisher.get_subscription_count, 'the subscription')
    publisher.publish(ros.Presence(
        sender=new_instance(), role='channel', node='/rogue', scenario=scenario))
    publisher.publish(ros.Presence(
        sender=node.instance - 1, role='channel', node='/rogue', scenario='{}'))
    bench.until(lambda: node._presence.conflicts(), 'the valid announcement')
    assert not node.report().values['conflict.role'].startswith('stands by')


def test_the_newer_of_two_optimizers_is_followed_until_it_has_gone(bench, small_files, small):
    def add(name):
        return bench.add(OptimizerNode, parameter_overrides=[
            Parameter('scenario_file', value=str(small_files / 'scenario.yaml')),
            Parameter('codebook_file', value=str(small_files / f'{name}.yaml'))])
    first, second = (Codebook.load(small_files / f'{name}.yaml').id
                     for name in ('first', 'second'))
    got, late = [], []
    older = add('first')
    CodebookClient(bench.add(Node, 'client'), small.scenario, got.append)
    bench.until(lambda: got, 'the first codebook')
    newer = add('second')
    bench.until(lambda: got[-1].id == second, 'the codebook of the newer optimizer')
    bench.until(lambda: older._publisher is None, 'the withdrawal')
    # Either optimizer may answer its request.
    CodebookClient(bench.add(Node, 'late'), small.scenario, late.append)
    bench.until(lambda: late, 'the codebook of the late client')
    assert [codebook.id for codebook in late] == [second]
    bench.remove(newer)
    bench.until(lambda: got[-1].id == late[-1].id == first, 'the codebook of the older one')
    assert [codebook.id for codebook in got] == [first, second, first]


def test_the_serving_optimizer_announces_again_after_an_older_one_has_returned(
        bench, probe, small_files, small):
    """A process that was suspended serves for a moment, because it misses the newer one."""
    first, second = (Codebook.load(small_files / f'{name}.yaml') for name in ('first', 'second'))
    newer = bench.add(OptimizerNode, parameter_overrides=[
        Parameter('scenario_file', value=str(small_files / 'scenario.yaml')),
        Parameter('codebook_file', value=str(small_files / 'first.yaml'))])
    got = []
    CodebookClient(bench.add(Node, 'client'), small.scenario,
                   lambda codebook: got.append(codebook.id))
    bench.until(lambda: got == [first.id], 'the codebook of the newer one')
    presences = probe.create_publisher(ros.Presence, topics.PRESENCE, qos.LATCHED)
    codebooks = probe.create_publisher(ros.Codebook, topics.CODEBOOK, qos.LATCHED_WITH_LEASE)
    bench.until(lambda: presences.get_subscription_count() and codebooks.get_subscription_count(),
                'the subscriptions')
    older = ros.Presence(sender=newer._instance - 1, scenario_id=small.scenario.id,
                         role='optimizer', node='/older', scenario='{}')
    presences.publish(older)
    bench.until(newer._presence.conflicts, 'the older one')
    bench.until(lambda: not newer._presence.conflicts(), 'its silence')
    codebooks.publish(convert.codebook_to_ros(
        second, probe.get_clock().now().to_msg(), older.sender, older.scenario_id))
    bench.until(lambda: got == [first.id, second.id], 'the codebook of the older one')
    presences.publish(older)
    bench.until(lambda: got == [first.id, second.id, first.id], 'the codebook of the newer one')


def test_a_node_of_another_scenario_changes_nothing(bench, probe, add_channel):
    node, changes = add_channel(), []
    client = PresenceClient(
        bench.add(Node, 'other'), 'optimizer', new_instance(), node.scenario, changes.append)
    publisher = probe.create_publisher(ros.Presence, topics.PRESENCE, qos.LATCHED)
    bench.until(publisher.get_subscription_count, 'the subscription')
    publisher.publish(ros.Presence(
        sender=1, scenario_id='sc2', role='optimizer', node='/stranger', scenario='{}'))
    bench.until(lambda: 'conflict.sc2' in client.conflicts(), 'the stranger')
    bench.until(lambda: not client.conflicts(), 'its silence')
    assert changes == []
