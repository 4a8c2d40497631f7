"""The adapter between a role and ROS 2."""

import collections
import itertools
import math

import numpy as np
import pytest
from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import LogMessage, Send, Tick
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.role_node import RoleNode


class Scripted:
    """A role that notes what it is told and does what the test says."""

    def __init__(self, script=lambda role, event, now_s: []):
        self.counters = collections.Counter()
        self.deadline_s = None
        self.told = []
        self._script = script

    def handle(self, event, now_s):
        self.told.append((event, now_s))
        return self._script(self, event, now_s) or []

    def next_deadline(self):
        return self.deadline_s

    def status(self):
        return {}

    @property
    def ticks_s(self):
        return [now_s for event, now_s in self.told if isinstance(event, Tick)]


@pytest.fixture
def start():
    """Function that puts a scripted role on a node of a bench."""
    def start(bench, role, *, sends=(), receives=(), name='scripted', **options):
        # The executable only decides about the parameters.
        node = bench.add(RoleNode, 'channel', sends, name, **options)
        node.start(role, receives)
        return node
    return start


def feed_signals(**changes):
    content = dict(cycle_id=1, user=1, band=0, frame=0, signals=np.ones((8, 3), complex))
    return m.FeedSignals(**(content | changes))


NAN = np.where(np.arange(24).reshape(8, 3) == 5, math.nan, 1.0 + 0j)


@pytest.mark.parametrize(('changes', 'text'), [
    ({'signals': NAN}, 'FeedSignals.signals: not finite'),
    ({'signals': np.full((8, 3), complex(0, math.inf))}, 'FeedSignals.signals: not finite'),
    ({'signals': np.ones((3, 8), complex)},
     'FeedSignals.signals: shape [3, 8], expected [N_SB = 8, K = 3]'),
    ({'band': 2}, 'FeedSignals.band: 2, expected 0 to 1'),
    ({'frame': 4}, 'FeedSignals.frame: 4, expected 0 to 3'),
])
def test_a_malformed_message_is_dropped_counted_and_logged_once(
        each_bench, start, capfd, changes, text):
    role = Scripted()
    start(each_bench, role, receives=(m.FeedSignals,))
    outlet = each_bench.outlet(each_bench.add(Node, 'probe'), m.FeedSignals)
    for message in (feed_signals(**changes), feed_signals(**changes), feed_signals(user=7)):
        outlet.publish(convert.to_ros(message, None))
    each_bench.until(lambda: role.told, 'the good message')
    (event, _), = role.told
    assert event.user == 7
    assert role.counters == {'malformed': 2}
    log = capfd.readouterr().err
    assert log.count('dropped: ') == log.count(f'dropped: {text}') == 1
    assert '[ERROR]' in log


def test_what_does_not_even_convert_is_dropped_too(bench, start, probe, capfd):
    role = Scripted()
    start(bench, role, receives=(m.Data, m.FeedSignals))
    data, feeds = bench.outlet(probe, m.Data), bench.outlet(probe, m.FeedSignals)
    data.publish(convert.ros_type(m.Data)(direction=9))
    feeds.publish(convert.ros_type(m.FeedSignals)())
    bench.until(lambda: role.counters['malformed'] == 2, 'the second malformed message')
    assert not role.told
    log = capfd.readouterr().err
    assert 'dropped: Data.direction: 9 ' in log
    assert 'dropped: FeedSignals.signals: 0 values' in log


def test_a_babbling_sender_does_not_fill_the_log(bench, start, probe, capfd):
    role = Scripted()
    start(bench, role, receives=(m.RhsCommand,))
    outlet = bench.outlet(probe, m.RhsCommand)
    for part in range(10):
        for band in range(50):
            message = m.RhsCommand(cycle_id=1, band=2 + 50 * part + band, codebook_id='')
            outlet.publish(convert.to_ros(message, None))
        bench.until(lambda part=part: role.counters['malformed'] == 50 * (part + 1), 'them all')
    assert 1 <= capfd.readouterr().err.count('dropped: ') <= 100


def test_a_wrong_message_of_the_role_is_not_published(each_bench, start, capfd):
    bad, good = m.FeedSignals(
        cycle_id=1, user=1, band=0, frame=0, signals=NAN), feed_signals(user=2)
    role = Scripted(lambda role, event, now_s: [Send(bad), Send(bad), Send(good)])
    node = start(each_bench, role, sends=(m.FeedSignals,))
    heard = each_bench.hear(each_bench.add(Node, 'probe'), m.FeedSignals)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: heard, 'the good message')
    assert [message.user for message in heard] == [2]
    log = capfd.readouterr().err
    assert log.count('not sent: FeedSignals.signals: not finite') == 1
    assert '[ERROR]' in log


def test_notes_go_to_the_log(bench, start, capfd):
    role = Scripted(
        lambda role, event, now_s: [LogMessage('all is well'), LogMessage('beware', True)])
    start(bench, role).dispatch(m.Ack(cycle_id=1, user=1))
    first, second = capfd.readouterr().err.strip().splitlines()
    assert '[INFO]' in first
    assert first.endswith('[scripted]: all is well')
    assert '[WARN]' in second
    assert second.endswith('[scripted]: beware')


def test_messages_go_through_in_their_order(each_bench, start):
    role = Scripted(lambda role, event, now_s: [
        Send(m.Grant(
            cycle_id=event.cycle_id,
            user=event.user)), Send(m.Grant(cycle_id=event.cycle_id, user=99))])
    start(each_bench, role, sends=(m.Grant,), receives=(m.Ack,))
    probe = each_bench.add(Node, 'probe')
    heard = each_bench.hear(probe, m.Grant)
    outlet = each_bench.outlet(probe, m.Ack)
    for user in range(1, 51):
        outlet.publish(convert.to_ros(m.Ack(cycle_id=3, user=user), None))
    each_bench.until(lambda: len(heard) == 100, 'the last grant')
    assert [message.user for message in heard] == [
        user for number in range(1, 51) for user in (number, 99)]


def test_listening_twice_hears_once(bench, start, probe):
    role = Scripted()
    node = start(bench, role, receives=(m.Ack,))
    node.listen((m.Ack, m.Grant))
    acks, grants = bench.outlet(probe, m.Ack), bench.outlet(probe, m.Grant)
    assert acks.get_subscription_count() == 1
    for outlet, kind in ((acks, m.Ack), (acks, m.Ack), (grants, m.Grant)):
        outlet.publish(convert.to_ros(kind(cycle_id=1, user=1), None))
    bench.until(lambda: len(role.told) == 3, 'all messages')
    assert collections.Counter(type(event) for event, _ in role.told) == {m.Ack: 2, m.Grant: 1}


def test_topics_follow_the_namespace_and_remapping(bench, start):
    # What is remapped is written on the command line.
    start(bench, Scripted(), sends=(m.Beacon, m.Grant), receives=(m.Ack,), namespace='/a',
          cli_args=['--ros-args', '-r', 'grant:=permit'], use_global_arguments=False)
    probe = bench.add(Node, 'probe')
    names = bench.until(lambda: {'/a/beacon', '/a/permit', '/a/ack'} <= {
        name for name, _ in probe.get_topic_names_and_types()}, 'the topics')
    assert names
    assert not probe.count_publishers('/a/grant')
    assert probe.count_publishers('/a/beacon') == probe.count_publishers('/a/permit') == 1


# Deadlines. How late a tick is depends on the machine, so that only "not early" is certain.

def deadlines(*delays_s):
    """Script: each event sets the deadline this much after it; None sets none."""
    rest = iter(delays_s)

    def script(role, event, now_s):
        delay_s = next(rest, None)
        role.deadline_s = None if delay_s is None else now_s + delay_s
        role.asked_s = [*getattr(role, 'asked_s', []), role.deadline_s]
    return Scripted(script)


def test_a_tick_comes_when_it_is_due(each_bench, start):
    role = deadlines(0.05, 0.02, 0.1)
    node = start(each_bench, role)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    assert not role.ticks_s
    each_bench.until(lambda: len(role.ticks_s) == 3, 'the last tick')
    for asked_s, tick_s in zip(role.asked_s[:3], role.ticks_s, strict=True):
        assert tick_s >= asked_s
    assert role.deadline_s is None


def test_a_deadline_that_moves_ahead_is_met(each_bench, start):
    role = deadlines(3000.0, 0.05)
    node = start(each_bench, role)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    node.dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: role.ticks_s, 'the tick')
    assert role.ticks_s[0] >= role.asked_s[1]


def test_a_deadline_that_moves_back_is_met_once(each_bench, start):
    role = deadlines(0.02, 0.3)
    node = start(each_bench, role)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    node.dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: role.ticks_s, 'the tick')
    assert role.ticks_s[0] >= role.asked_s[1]
    assert len(role.told) == 3


def test_a_deadline_that_is_lifted_brings_no_tick(each_bench, start):
    lifted, later = deadlines(0.02, None), deadlines(0.2)
    node = start(each_bench, lifted)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    node.dispatch(m.Ack(cycle_id=1, user=1))
    start(each_bench, later, name='later').dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: later.ticks_s, 'the later tick')
    assert not lifted.ticks_s
    # And the node takes a new one.
    lifted._script = deadlines(0.02)._script
    node.dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: lifted.ticks_s, 'the tick')


def test_a_deadline_in_the_past_brings_its_tick_at_once(bench, start):
    role = deadlines(-1.0, 0.0, -5.0, 0.02)
    node = start(bench, role)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    assert [type(event) for event, _ in role.told] == [m.Ack, Tick, Tick, Tick]
    bench.until(lambda: len(role.ticks_s) == 4, 'the tick that was not due')


def test_deadlines_go_on_while_messages_come(each_bench, start):
    """Each of many messages moves the deadline, and between them many pass."""
    delays_s = itertools.cycle((0.002, 0.05, 0.0, 0.01, 3000.0, 0.001))
    asked_s = []

    def script(role, event, now_s):
        if isinstance(event, Tick):
            assert now_s >= role.deadline_s
            role.deadline_s = None
            return
        role.deadline_s = now_s + next(delays_s)
        asked_s.append(role.deadline_s)

    role = Scripted(script)
    start(each_bench, role, receives=(m.Ack,))
    outlet = each_bench.outlet(each_bench.add(Node, 'probe'), m.Ack)
    for number in range(120):
        outlet.publish(convert.to_ros(m.Ack(cycle_id=1, user=1 + number), None))
        # Those messages that set a short deadline get time to see it pass.
        each_bench.until(lambda number=number: len(asked_s) > number and (
            number % 2 or role.deadline_s is None or number % 6 == 4), 'message or tick')
    assert len(asked_s) == 120
    assert len(role.ticks_s) >= 40


def test_topic_of_every_message_is_the_listed_one(bench, start, probe):
    start(bench, Scripted(), sends=topics.NAMES)
    for name in topics.NAMES.values():
        bench.until(lambda name=name: probe.count_publishers(f'/{name}'), name)


def test_who_joins_late_hears_the_present_statistics(bench, start):
    node = start(bench, Scripted(), sends=(m.CapacityStatistics,))
    for n in (1, 2):
        figures = ('expected_bps', 'actual_bps', 'perfect_bps', 'loss_bps', 'loss_percent')
        assert node.publish(m.CapacityStatistics(cycle_id=n, n_reports=n, **{
            name: number * np.arange(3.0)
            for name, number in zip(figures, (3, 2, 4, 1, 5), strict=True)}))
    late, heard = bench.add(Node, 'late'), []
    late.create_subscription(
        convert.ros_type(m.CapacityStatistics), topics.NAMES[m.CapacityStatistics], heard.append,
        qos.LATCHED)
    bench.until(lambda: heard, 'the statistics')
    (message,) = heard
    assert message.n_reports == 2
    assert list(message.loss_percent) == [0, 5, 10]
