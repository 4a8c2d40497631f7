"""Presence of the roles that a node needs."""

from unittest import mock

import pytest
from rclpy.node import Node

from rhs_isac_ros.nodes.channel import ChannelNode
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.ros import convert, peer_monitor, qos, topics
from rhs_isac_ros.ros.peer_monitor import OF_BASE_STATION, OF_USER, PeerMonitor

NEEDS = {'bs': OF_BASE_STATION, 'user': OF_USER}


def play(node, signs):
    """Show the signs of a role, without any behaviour."""
    publishes, subscribes = signs
    for kind in publishes:
        node.create_publisher(convert.ros_type(kind), topics.NAMES[kind], qos.EXCHANGE)
    for kind in subscribes:
        node.create_subscription(
            convert.ros_type(kind), topics.NAMES[kind], lambda message: None, qos.EXCHANGE)


@pytest.fixture
def watch(bench, monkeypatch):
    """Function that watches for roles, often, and returns the list of reports."""
    monkeypatch.setattr(peer_monitor, '_POLL_S', 0.01)

    def watch(needs, *cli_args):
        reports = []
        node = bench.add(Node, 'watcher', cli_args=['--ros-args', *cli_args])
        PeerMonitor(node, needs, reports.append)
        return reports
    return watch


@pytest.mark.parametrize('needs', NEEDS.values(), ids=NEEDS)
def test_all_are_missing_at_first_and_each_change_is_reported_once(bench, watch, needs):
    reports = watch(needs)
    bench.until(lambda: reports, 'the first report')
    names = tuple(needs)
    players = {}
    for role in reversed(names):
        players[role] = bench.add(Node, role)
        play(players[role], needs[role])
        bench.until(lambda role=role: role not in reports[-1], f'presence of {role}')
    assert reports == [names[:n] for n in range(len(names), -1, -1)]
    for role in names:
        bench.remove(players.pop(role))
        bench.until(lambda role=role: role in reports[-1], f'absence of {role}')
    assert reports[len(names):] == [names[:n] for n in range(len(names) + 1)]


@pytest.mark.parametrize(('owner', 'role', 'side', 'kind'), [
    (owner, role, side, kind) for owner, needs in NEEDS.items()
    for role, signs in needs.items() for side in (0, 1) for kind in signs[side]])
def test_one_sign_less_is_no_presence(bench, watch, owner, role, side, kind):
    signs = NEEDS[owner][role]
    partial = [[k for k in group if (number, k) != (side, kind)]
               for number, group in enumerate(signs)]
    player = bench.add(Node, role)
    play(player, partial)
    # One who is there whole tells that the watcher has looked.
    reports = watch({role: signs, 'decoy': ((), ())})
    bench.until(lambda: reports and 'decoy' not in reports[-1], 'a look at the graph')
    assert reports[-1] == (role,)
    play(player, ([kind], []) if side == 0 else ([], [kind]))
    bench.until(lambda: reports[-1] == (), f'presence of {role}')


def test_presence_counts_from_the_second_look_in_a_row():
    node, reports = mock.Mock(), []
    PeerMonitor(node, {'channel': OF_USER['channel']}, reports.append)
    look = node.create_timer.call_args.args[1]

    def look_while(present):
        node.count_publishers.return_value = node.count_subscribers.return_value = int(present)
        look()
        return () in reports

    # Someone who is seen every other time is not there.
    for _ in range(50):
        assert not look_while(present=True)
        assert not look_while(present=False)
    assert reports == [('channel',)]
    assert not look_while(present=True)
    assert look_while(present=True)


def test_a_watcher_sees_its_own_namespace_only(bench, watch):
    needs = {'channel': OF_USER['channel']}
    play(bench.add(Node, 'channel', namespace='/b'), needs['channel'])
    reports = watch({**needs, 'decoy': ((), ())}, '-r', '__ns:=/a')
    bench.until(lambda: reports and 'decoy' not in reports[-1], 'a look at the graph')
    assert reports[-1] == ('channel',)
    play(bench.add(Node, 'channel', namespace='/a'), needs['channel'])
    bench.until(lambda: reports[-1] == (), 'presence')


def test_a_watcher_follows_remapped_topics(bench, watch):
    rules = ['-r', 'feed_signals:=/elsewhere/feeds', '-r', 'pilot:=tone']
    player = bench.add(Node, 'channel', cli_args=['--ros-args', *rules])
    play(player, OF_USER['channel'])
    reports = watch({'channel': OF_USER['channel']}, *rules)
    bench.until(lambda: () in reports, 'presence')


def test_signs_are_what_the_nodes_show(bench, watch):
    needs = {'channel': OF_USER['channel'], 'bs': (BaseStation.SENDS, BaseStation.RECEIVES)}
    assert set(OF_USER['bs'][0]) <= set(BaseStation.SENDS)
    assert set(OF_USER['bs'][1]) <= set(BaseStation.RECEIVES)
    reports = watch(needs)
    bench.add(ChannelNode)
    bench.until(lambda: reports and reports[-1] == ('bs',), 'presence of the channel')
