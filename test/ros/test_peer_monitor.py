"""Presence of the roles that a node needs."""

from unittest import mock

import pytest
from rclpy.node import Node

from rhs_isac_ros.nodes.channel import ChannelNode
from rhs_isac_ros.nodes.positioner import PositionerNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, peer_monitor, qos, topics
from rhs_isac_ros.ros.peer_monitor import (
    REQUIRED_BY_BASE_STATION,
    REQUIRED_BY_USER,
    Endpoints,
    PeerMonitor,
    identifying_endpoints,
)

REQUIRED = {'bs': REQUIRED_BY_BASE_STATION, 'user': REQUIRED_BY_USER}


def create_endpoints(node, endpoints):
    """Create the endpoints of a role, without its behaviour."""
    publishers, subscriptions = endpoints
    for kind in publishers:
        node.create_publisher(convert.ros_type(kind), topics.NAMES[kind], qos.EXCHANGE)
    for kind in subscriptions:
        node.create_subscription(
            convert.ros_type(kind), topics.NAMES[kind], lambda message: None, qos.EXCHANGE)


@pytest.fixture
def monitor(bench, monkeypatch):
    """Return a function that starts a monitor with a short period and returns its reports."""
    monkeypatch.setattr(peer_monitor, '_POLL_S', 0.01)

    def monitor(required, *cli_args):
        reports = []
        node = bench.add(Node, 'monitor', cli_args=['--ros-args', *cli_args])
        PeerMonitor(node, required, reports.append)
        return reports
    return monitor


def test_a_role_is_identified_by_messages_that_only_it_sends_or_receives():
    assert {role: identifying_endpoints(role) for role in peer_monitor._ENDPOINTS} == {
        'bs': ((m.Beacon,), (m.Ack,)),
        'user': ((m.Ack,), (m.Beacon,)),
        'rhs_controller': ((m.RhsConfiguration,), (m.RhsCommand,)),
        'channel': ((m.FeedSignals,), (m.Pilot,)),
        'positioner': ((m.PositionEstimate,), (m.ReceivedSignals,)),
        'transmission': ((m.Beam,), ()),
    }


@pytest.mark.parametrize('required', REQUIRED.values(), ids=REQUIRED)
def test_all_roles_are_missing_at_first_and_each_change_is_reported_once(
        bench, monitor, required):
    reports = monitor(required)
    bench.until(lambda: reports, 'the first report')
    names = tuple(required)
    nodes = {}
    for role in reversed(names):
        nodes[role] = bench.add(Node, role)
        create_endpoints(nodes[role], required[role])
        bench.until(lambda role=role: role not in reports[-1], f'presence of {role}')
    assert reports == [names[:n] for n in range(len(names), -1, -1)]
    for role in names:
        bench.remove(nodes.pop(role))
        bench.until(lambda role=role: role in reports[-1], f'absence of {role}')
    assert reports[len(names):] == [names[:n] for n in range(len(names) + 1)]


@pytest.mark.parametrize(('owner', 'role', 'side', 'kind'), [
    (owner, role, side, kind) for owner, required in REQUIRED.items()
    for role, endpoints in required.items() for side in (0, 1) for kind in endpoints[side]])
def test_a_role_without_one_of_its_endpoints_is_missing(bench, monitor, owner, role, side, kind):
    endpoints = REQUIRED[owner][role]
    partial = [[k for k in group if (number, k) != (side, kind)]
               for number, group in enumerate(endpoints)]
    node = bench.add(Node, role)
    create_endpoints(node, partial)
    # The presence of a role without requirements shows that the graph was polled.
    reports = monitor({role: endpoints, 'always_present': Endpoints((), ())})
    bench.until(lambda: reports and 'always_present' not in reports[-1], 'a poll of the graph')
    assert reports[-1] == (role,)
    create_endpoints(node, ([kind], []) if side == 0 else ([], [kind]))
    bench.until(lambda: reports[-1] == (), f'presence of {role}')


def test_a_role_is_present_from_the_second_poll_in_a_row_that_finds_it():
    node, reports = mock.Mock(), []
    PeerMonitor(node, {'channel': REQUIRED_BY_USER['channel']}, reports.append)
    poll = node.create_timer.call_args.args[1]

    def poll_while(present):
        node.count_publishers.return_value = node.count_subscribers.return_value = int(present)
        poll()
        return () in reports

    # A role that every other poll finds is missing.
    for _ in range(50):
        assert not poll_while(present=True)
        assert not poll_while(present=False)
    assert reports == [('channel',)]
    assert not poll_while(present=True)
    assert poll_while(present=True)


def test_a_monitor_observes_its_own_namespace_only(bench, monitor):
    required = {'channel': REQUIRED_BY_USER['channel']}
    create_endpoints(bench.add(Node, 'channel', namespace='/b'), required['channel'])
    reports = monitor({**required, 'always_present': Endpoints((), ())}, '-r', '__ns:=/a')
    bench.until(lambda: reports and 'always_present' not in reports[-1], 'a poll of the graph')
    assert reports[-1] == ('channel',)
    create_endpoints(bench.add(Node, 'channel', namespace='/a'), required['channel'])
    bench.until(lambda: reports[-1] == (), 'presence')


def test_a_monitor_follows_remapped_topics(bench, monitor):
    rules = ['-r', 'feed_signals:=/elsewhere/feeds', '-r', 'pilot:=tone']
    node = bench.add(Node, 'channel', cli_args=['--ros-args', *rules])
    create_endpoints(node, REQUIRED_BY_USER['channel'])
    reports = monitor({'channel': REQUIRED_BY_USER['channel']}, *rules)
    bench.until(lambda: () in reports, 'presence')


def test_a_node_is_reported_as_present_when_it_is_ready(bench, monitor):
    """The channel is ready at once; the positioner subscribes when it has an estimator."""
    reports = monitor({role: REQUIRED_BY_BASE_STATION[role] for role in ('channel', 'positioner')})
    bench.add(ChannelNode)
    positioner = bench.add(PositionerNode)
    bench.until(lambda: reports and reports[-1] == ('positioner',), 'presence of the channel')
    positioner.subscribe()
    bench.until(lambda: reports[-1] == (), 'presence of the positioner')
