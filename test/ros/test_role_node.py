"""The adapter between a role and ROS 2."""

import itertools
import math
from unittest import mock

import numpy as np
import pytest
from rclpy.node import Node
from ros_messages import to_ros

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import LogMessage, Send, Timeout
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.ros import endpoints, role_node
from rhs_isac_ros.ros.role_node import Clocks, RoleNode
from rhs_isac_ros.support import plugins


class Scripted(Role):
    """A role that records its events and follows the script of the test."""

    def __init__(self, script=lambda role, event, now_s: [], sends=(), receives=()):
        super().__init__()
        self.SENDS, self.RECEIVES = tuple(sends), tuple(receives)
        self.deadline_s = None
        self.events = []
        self._script = script

    def handle(self, event, now_s):
        self.events.append((event, now_s))
        return self._script(self, event, now_s) or []

    def next_deadline(self):
        return self.deadline_s

    @property
    def ticks_s(self):
        return [now_s for event, now_s in self.events if isinstance(event, Timeout)]


@pytest.fixture
def start():
    """Function that starts a scripted role on a node of a bench."""
    def start(bench, role, *, name='scripted', **options):
        # The executable only determines the parameters.
        node = bench.add(RoleNode, 'channel', name, **options)
        node.start(role)
        return node
    return start


def feed_signals(**changes):
    content = dict(cycle_id=1, user=1, band=0, signals=np.ones((4, 8, 3), complex))
    return m.FeedSignals(**(content | changes))


NAN = np.where(np.arange(96).reshape(4, 8, 3) == 5, math.nan, 1.0 + 0j)


def test_a_malformed_message_is_dropped_counted_and_logged_once(each_bench, start, capfd):
    role = Scripted(receives=[m.FeedSignals])
    start(each_bench, role)
    publisher = each_bench.publisher(each_bench.add(Node, 'probe'), m.FeedSignals)
    malformed = to_ros(feed_signals(signals=NAN), None)
    for message in (malformed, malformed, type(malformed)(), to_ros(feed_signals(user=7), None)):
        publisher.publish(message)
    each_bench.until(lambda: role.events, 'the good message')
    (event, _), = role.events
    assert event.user == 7
    assert role.counters == {'malformed': 3}
    log = capfd.readouterr().err
    assert log.count('dropped: ') == 1
    assert 'dropped: FeedSignals.signals: not finite' in log
    assert '[ERROR]' in log


def test_many_malformed_messages_do_not_fill_the_log(bench, start, probe, capfd):
    role = Scripted(receives=[m.RhsCommand])
    start(bench, role)
    publisher = bench.publisher(probe, m.RhsCommand)
    for part in range(10):
        for band in range(50):
            message = m.RhsCommand(cycle_id=1, band=2 + 50 * part + band, codebook_id='')
            publisher.publish(to_ros(message, None))
        bench.until(lambda part=part: role.counters['malformed'] == 50 * (part + 1), 'all of them')
    assert 1 <= capfd.readouterr().err.count('dropped: ') <= 100


def test_an_invalid_message_of_the_role_is_not_published(each_bench, start, capfd):
    bad = m.FeedSignals(cycle_id=1, user=1, band=0, signals=NAN)
    surrogate = m.NoFix(cycle_id=1, user=1, codebook_id='', reason='\ud800')
    # The latest stamp, as of pilots without a time, and the time until the middle of the cycle.
    late = feed_signals(stamp_ns=10**9 * 2**31)
    good = feed_signals(user=2)
    role = Scripted(
        lambda role, event, now_s: [
            Send(bad), Send(bad), Send(surrogate), Send(late), Send(good)],
        sends=[m.FeedSignals, m.NoFix])
    node = start(each_bench, role)
    received = each_bench.collect(each_bench.add(Node, 'probe'), m.FeedSignals)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: received, 'the good message')
    assert [message.user for message in received] == [2]
    log = capfd.readouterr().err
    assert log.count('not sent: FeedSignals.signals: not finite') == 1
    assert log.count("not sent: NoFix.reason: '\\ud800', expected valid Unicode") == 1
    assert log.count('not sent: FeedSignals.header: stamp of 2147483648 s') == 1
    assert '[ERROR]' in log


def test_log_messages_are_logged_with_their_severity(bench, start, capfd):
    role = Scripted(lambda role, event, now_s: [
        LogMessage('information'), LogMessage('a warning', True),
        LogMessage('a state', True, 'key', True), LogMessage('its end', False, 'key', False)])
    start(bench, role).dispatch(m.Ack(cycle_id=1, user=1))
    lines = capfd.readouterr().err.strip().splitlines()
    for line, severity, text in zip(lines, ('INFO', 'WARN', 'WARN', 'INFO'), (
            'information', 'a warning', 'a state', 'its end'), strict=True):
        assert f'[{severity}]' in line
        assert line.endswith(f'[scripted]: {text}')


def test_a_node_survives_a_plug_in_that_fails_and_logs_its_traceback(bench, start, capfd):
    class Failing(Role):
        def react(self, event):
            with plugins.calling('Grid.estimate'):
                raise KeyError(event.key)
    def fail(place):
        with plugins.calling(place):
            return 1 / 0
    node = start(bench, role := Failing())
    node.dispatch(LogMessage('', key='gain'))
    with endpoints.surviving(node):
        raise plugins.PluginError('Circle.state: nothing')
    worker = endpoints.BackgroundWorker(node)
    node.endings.callback(worker.close)
    worker.run(lambda: fail('job'), lambda result: None)
    timer = endpoints.steady_timer(node, 0.01, lambda: (timer.cancel(), fail('timer')))
    bench.until(lambda: role.counters == {'plugin_fault': 4})
    log = capfd.readouterr().err
    assert all(f'plug-in: {place}: ZeroDivisionError: division by zero\nTraceback' in log
               for place in ('job', 'timer'))
    assert "plug-in: Grid.estimate: KeyError: 'gain'\nTraceback" in log
    assert 'raise KeyError(event.key)' in log and 'plug-in: Circle.state: nothing' in log


def test_messages_keep_their_order(each_bench, start):
    role = Scripted(lambda role, event, now_s: [
        Send(m.Grant(cycle_id=event.cycle_id, user=event.user)),
            Send(m.Grant(cycle_id=event.cycle_id, user=99))],
        sends=[m.Grant], receives=[m.Ack])
    start(each_bench, role)
    probe = each_bench.add(Node, 'probe')
    received = each_bench.collect(probe, m.Grant)
    publisher = each_bench.publisher(probe, m.Ack)
    for user in range(1, 51):
        publisher.publish(to_ros(m.Ack(cycle_id=3, user=user), None))
    each_bench.until(lambda: len(received) == 100, 'the last grant')
    assert [message.user for message in received] == [
        user for number in range(1, 51) for user in (number, 99)]


def test_a_role_may_subscribe_to_its_topics_later_and_only_once(bench, probe):
    role = Scripted(sends=[m.Grant], receives=[m.Ack])
    node = bench.add(RoleNode, 'channel', 'scripted')
    node.start(role, needs_codebook=True)
    assert not node.count_subscribers('ack')
    for _ in range(2):
        node.subscribe()
    publisher = bench.publisher(probe, m.Ack)
    assert node.count_publishers('grant') == publisher.get_subscription_count() == 1
    for user in (1, 2):
        publisher.publish(to_ros(m.Ack(cycle_id=1, user=user), None))
    bench.until(lambda: len(role.events) >= 2, 'both messages')
    assert [event.user for event, _ in role.events] == [1, 2]


def test_topics_follow_the_namespace_and_remapping(bench, start):
    # The command line defines the remapping.
    role = Scripted(sends=[m.Beacon, m.Grant], receives=[m.Ack])
    start(bench, role, namespace='/a',
          cli_args=['--ros-args', '-r', 'grant:=permit'], use_global_arguments=False)
    probe = bench.add(Node, 'probe')
    names = bench.until(lambda: {'/a/beacon', '/a/permit', '/a/ack'} <= {
        name for name, _ in probe.get_topic_names_and_types()}, 'the topics')
    assert names
    assert not probe.count_publishers('/a/grant')
    assert probe.count_publishers('/a/beacon') == probe.count_publishers('/a/permit') == 1


@pytest.mark.parametrize('pace', [0.2, 5.0])
def test_the_world_follows_a_simulation_and_the_clock_of_the_roles_only_in_its_states(
        pace, monkeypatch):
    now_s, simulated_s, node = 7.0, 1000.0, mock.Mock()
    clock = node.get_clock.return_value
    clock.ros_time_is_active = True
    clock.now.side_effect = lambda: mock.Mock(nanoseconds=1e9 * simulated_s)
    monkeypatch.setattr(role_node, 'time', mock.Mock(monotonic=lambda: now_s))
    clocks = Clocks(node)
    assert (clocks.world_s(), clocks.role_s(in_world=True)) == (7.0, 7.0)
    now_s, simulated_s = now_s + 1.0, simulated_s + pace
    assert clocks.role_s(in_world=True) == clocks.world_s() == pytest.approx(7.0 + pace)
    now_s, simulated_s = now_s + 1.0, simulated_s + pace
    assert clocks.role_s(in_world=False) == pytest.approx(8.0 + pace)
    assert clocks.world_s() == pytest.approx(7.0 + 2 * pace)
    # The simulation restarts.
    now_s, simulated_s = now_s + 1.0, 0.0
    assert clocks.world_s() == pytest.approx(7.0 + 2 * pace)
    clock.ros_time_is_active = False
    now_s += 1.0
    assert clocks.world_s() == pytest.approx(8.0 + 2 * pace)


# Deadlines. The delay of a tick depends on the machine; only that it is not early is certain.

def deadlines(*delays_s):
    """Return a role whose events set the deadline to a delay after them; None: no deadline."""
    remaining = iter(delays_s)

    def script(role, event, now_s):
        delay_s = next(remaining, None)
        role.deadline_s = None if delay_s is None else now_s + delay_s
        role.deadlines_s = [*getattr(role, 'deadlines_s', []), role.deadline_s]
    return Scripted(script)


def test_an_earlier_deadline_replaces_a_later_one(each_bench, start):
    role = deadlines(3000.0, 0.05)
    node = start(each_bench, role)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    node.dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: role.ticks_s, 'the tick')
    assert role.ticks_s[0] >= role.deadlines_s[1]


def test_a_cancelled_deadline_causes_no_tick(each_bench, start):
    cancelled, later = deadlines(0.02, None), deadlines(0.2)
    node = start(each_bench, cancelled)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    node.dispatch(m.Ack(cycle_id=1, user=1))
    start(each_bench, later, name='later').dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: later.ticks_s, 'the later tick')
    assert not cancelled.ticks_s
    # The node accepts a new deadline afterwards.
    cancelled._script = deadlines(0.02)._script
    node.dispatch(m.Ack(cycle_id=1, user=1))
    each_bench.until(lambda: cancelled.ticks_s, 'the tick')


def test_a_deadline_in_the_past_causes_a_tick_at_once(bench, start):
    role = deadlines(-1.0, 0.0, -5.0, 0.02)
    node = start(bench, role)
    node.dispatch(m.Ack(cycle_id=1, user=1))
    assert [type(event) for event, _ in role.events] == [m.Ack, Timeout, Timeout, Timeout]
    bench.until(lambda: len(role.ticks_s) == 4, 'the tick that was not due')


def test_deadlines_are_kept_while_messages_arrive(each_bench, start):
    """Each of many messages changes the deadline, and many deadlines pass in between."""
    delays_s = itertools.cycle((0.002, 0.05, 0.0, 0.01, 3000.0, 0.001))
    deadlines_s = []

    def script(role, event, now_s):
        if isinstance(event, Timeout):
            assert now_s >= role.deadline_s
            role.deadline_s = None
            return
        role.deadline_s = now_s + next(delays_s)
        deadlines_s.append(role.deadline_s)

    role = Scripted(script, receives=[m.Ack])
    start(each_bench, role)
    publisher = each_bench.publisher(each_bench.add(Node, 'probe'), m.Ack)
    for number in range(120):
        publisher.publish(to_ros(m.Ack(cycle_id=1, user=1 + number), None))
        # Short deadlines get time to pass.
        each_bench.until(lambda number=number: len(deadlines_s) > number and (
            number % 2 or role.deadline_s is None or number % 6 == 4), 'message or tick')
    assert len(deadlines_s) == 120
    assert len(role.ticks_s) >= 40


def test_messages_carry_the_identity_of_their_sender(bench, start, probe):
    node = start(bench, Scripted(sends=[m.Ack]))
    received = bench.collect(probe, m.Ack)
    bench.until(lambda: probe.count_publishers('/ack'), 'the publisher')
    # A role may pass on a message of another node.
    node.publish(m.Ack(cycle_id=1, user=1, sender=5, scenario_id='other'))
    bench.until(lambda: received, 'the message')
    assert (received[0].sender, received[0].scenario_id) == (node.instance, node.scenario.id)


def test_messages_of_another_scenario_are_dropped_counted_and_logged_once(
        each_bench, start, capfd):
    role = Scripted(receives=[m.Ack])
    node = start(each_bench, role)
    publisher = each_bench.publisher(each_bench.add(Node, 'probe'), m.Ack)
    for sender in (5, 5, 6, *range(100, 140)):
        publisher.publish(to_ros(
            m.Ack(cycle_id=1, user=1, sender=sender, scenario_id='other'), None))
    for known in ('', node.scenario.id):
        publisher.publish(to_ros(m.Ack(cycle_id=2, user=1, scenario_id=known), None))
    each_bench.until(lambda: len(role.events) == 2, 'the messages of this scenario')
    assert {event.cycle_id for event, _ in role.events} == {2}
    assert role.counters == {'wrong_scenario': 43}
    log = capfd.readouterr().err
    assert log.count('Ack dropped: sent with scenario other, expected sc') == 1
    assert '[WARN]' in log
