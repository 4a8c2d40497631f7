"""Other nodes that are present, and endpoints that do not fit."""

import contextlib
import copy
import threading
import time
import types
from unittest import mock

import numpy as np
import pytest
from node_bench import Bench
from rclpy.duration import Duration
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.topic_endpoint_info import TopicEndpointTypeEnum
from ros_messages import parameters, position_estimate, to_ros
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol import presences
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.ros import convert, peers, role_node, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED, PRESENCES, SENSOR
from rhs_isac_ros.ros.peers import Mismatches, Peers
from rhs_isac_ros.ros.role_node import CodebookClient, RoleNode
from rhs_isac_ros.ros.roster import ROSTER
from rhs_isac_ros.support import clock_watch, frame_watch

TYPES = {name: convert.ros_type(kind) for kind, name in topics.NAMES.items()}
ROLES = [name for name, member in ROSTER.items() if member.needed]


@pytest.fixture(autouse=True)
def frequent_polls(monkeypatch):
    """Poll and announce often; a node that announces itself late on a busy machine is present."""
    monkeypatch.setattr(peers, '_POLL_S', 0.01)
    monkeypatch.setattr(peers, '_IDLE_POLL_S', 0.1)
    monkeypatch.setattr(peers, 'PERIOD_S', 0.1)
    monkeypatch.setattr(presences, 'SILENCE_S', 60.0)
    monkeypatch.setattr(presences, 'PERIOD_S', 0.1)
    monkeypatch.setattr(presences, 'SLOW_PERIOD_S', 0.1)


@pytest.fixture
def monitor(bench):
    """Return a function that watches for the peers of a role and returns the reports."""
    def monitor(role, *cli_args):
        reports = []
        node = bench.add(Node, 'monitor', cli_args=['--ros-args', *cli_args])
        found = Peers(node, role, time.time_ns(), Scenario(), reports.append,
                      lambda stands_by: None)
        monitors.append(found)
        return reports
    monitors = []
    yield monitor
    for found in monitors:
        found.close()


@pytest.fixture
def announce(bench):
    """Return a function that adds a node with a role, which only announces itself."""
    def announce(role, **node_options):
        node = bench.add(Node, role, **node_options)
        found = Peers(node, role, time.time_ns(), Scenario(), lambda missing: None,
                      lambda stands_by: None)
        found.take_role()
        announced.append(found)
        return found
    announced = []
    yield announce
    for found in announced:
        found.close()


@pytest.mark.parametrize('role', ROLES)
def test_all_roles_are_missing_at_first_and_each_change_is_reported_once(
        bench, monitor, announce, role):
    """Only the announcements count: the graph contains none of the topics of the roles."""
    reports = monitor(role)
    bench.until(lambda: reports, 'the first report')
    names = ROSTER[role].needed
    found = {}
    for name in reversed(names):
        found[name] = announce(name)
        bench.until(lambda name=name: name not in reports[-1], f'presence of {name}')
    for name in names:
        found[name].close()
        bench.until(lambda name=name: name in reports[-1], f'absence of {name}')
    assert reports == [names[:n] for n in (*range(len(names), -1, -1), *range(1, len(names) + 1))]


def test_a_role_is_present_from_the_second_poll_in_a_row_that_finds_it():
    node, reports = mock.MagicMock(), []
    node.get_fully_qualified_name.return_value = '/user'
    node.get_clock.return_value.ros_time_is_active = False
    found = Peers(node, 'user', 1, Scenario(), reports.append, lambda stands_by: None)

    def poll_while(present):
        for number, role in enumerate(('channel', 'bs')):
            found._presences.add(presences.Presence(
                2 + number, '', role if present else '', f'/{role}', '{}'), 10, time.monotonic())
        found._poll()
        return () in reports

    # A role that every other poll finds is missing, which is reported after a grace period.
    for number in range(1, 101):
        assert not poll_while(present=number % 2)
        assert bool(reports) == (number >= peers._GRACE_POLLS)
    assert reports == [('channel', 'bs')]
    assert not poll_while(present=True)
    assert poll_while(present=True)


def test_a_node_that_was_killed_is_missing_until_its_successor_has_the_role(
        bench, monitor, probe, monkeypatch):
    """Discovery forgets a killed process only after 20 s."""
    monkeypatch.setattr(presences, 'SILENCE_S', 0.5)
    publisher = probe.create_publisher(ros.Presence, topics.PRESENCE, LATCHED)
    reports = monitor('bs')

    def say(sender, role):
        publisher.publish(ros.Presence(
            sender=sender, role=role, node='/positioner', scenario='{}'))

    def present(sender, role):
        say(sender, role)
        return reports and role not in reports[-1]
    bench.until(lambda: present(1, 'positioner'), 'presence')
    bench.until(lambda: 'positioner' in reports[-1], 'silence')
    n_reports = len(reports)
    say(2, role='')
    # Announcements arrive in order.
    bench.until(lambda: present(3, 'channel'), 'the next announcement')
    reports.remove(reports[-1])
    assert len(reports) == n_reports
    bench.until(lambda: present(2, 'positioner'), 'presence of the successor')


def test_a_node_is_reported_as_present_when_it_is_ready(bench, monitor):
    """The channel is ready at once; the positioner subscribes when it has an estimator."""
    reports = monitor('bs')
    bench.add_role('channel')
    positioner = bench.add_role('positioner')
    bench.until(lambda: reports and 'channel' not in reports[-1], 'presence of the channel')
    assert 'positioner' in reports[-1]
    positioner.subscribe()
    bench.until(lambda: 'positioner' not in reports[-1], 'presence of the positioner')


def test_a_node_without_an_optimizer_reports_it(bench, capfd):
    node = bench.add_role('rhs_controller')
    bench.until(lambda: node.report().summary == 'waiting for optimizer', 'the report')
    assert node.report().fault
    optimizer = bench.add_role('optimizer')
    bench.until(lambda: not node._statistics.missing, 'the optimizer')
    bench.until(lambda: node._codebook_client.codebook_id, 'the codebook')
    bench.remove(optimizer)
    bench.until(lambda: node._statistics.missing, 'its absence')
    log = capfd.readouterr().err
    codebook_id = node._codebook_client.codebook_id
    assert log.count('optimizer is not present; the codebook in use is none') == 1
    assert log.count(f'optimizer is not present; the codebook in use is {codebook_id}') == 1
    assert log.count('optimizer is present') == 1


# Simulated time

def test_a_simulation_without_a_clock_is_waited_for(bench, monkeypatch, capfd):
    monkeypatch.setattr(clock_watch, 'STILL_S', 0.2)
    node = bench.add_role('channel', values={'use_sim_time': True})
    bench.until(lambda: 'waiting for /clock' in node.report().summary, 'the report')
    assert node.report().fault
    clock = bench.add(Node, 'simulator').create_publisher(Clock, '/clock', 10)
    message = Clock()

    def tick():
        message.clock.nanosec += 1000
        clock.publish(message)
        return '/clock' not in node.report().summary
    bench.until(tick, 'the clock')
    log = capfd.readouterr().err
    assert log.count('waiting for /clock') == 2
    assert 'no longer: waiting for /clock' in log


def test_nodes_in_different_times_report_each_other(bench, add_channel, announce, capfd):
    node = add_channel()
    announce('optimizer', values={'use_sim_time': True})
    bench.until(lambda: 'conflict.clock' in node.report().details, 'the report')
    assert node.report().fault
    assert '/optimizer: use_sim_time true, expected' in node.report().summary
    bench.until(lambda: '/channel: use_sim_time false, expected' in capfd.readouterr().err,
                'the report of the other node')


# Frames

def test_positions_in_another_frame_are_reported_while_they_arrive(
        bench, probe, monkeypatch, capfd):
    monkeypatch.setattr(frame_watch, 'WINDOW_S', 0.5)
    node, message = bench.add_role('bs'), to_ros(position_estimate())
    publisher = bench.publisher(probe, m.PositionEstimate)
    assert message.header.frame_id == 'map'
    publisher.publish(message)
    message.header.frame_id = ''
    publisher.publish(message)
    bench.until(lambda: node.report().details.get('received.PositionEstimate') == '2')
    node._peers._poll()
    assert 'conflict.frame' not in node.report().details
    message.header.frame_id = 'odom'
    publisher.publish(message)
    bench.until(lambda: 'conflict.frame' in node.report().details, 'the report')
    text = "positions in the frames 'map' (this node), 'odom' (/position_estimate)"
    assert text in node.report().summary
    bench.until(lambda: 'conflict.frame' not in node.report().details, 'its end')
    log = capfd.readouterr().err
    assert log.count(text) == 2
    assert f'no longer: {text}' in log


# Quality of service

def test_endpoints_with_incompatible_qos_are_named_once(bench, capfd):
    node, observer = bench.add_role('channel'), bench.add(Node, 'observer')
    strict = copy.copy(LATCHED)
    strict.deadline = Duration(seconds=1)
    observer.create_subscription(
        TYPES['feed_signals'], 'feed_signals', lambda message: None, strict)
    observer.create_publisher(TYPES['pilot'], 'pilot', qos_profile_sensor_data)
    reasons = {'feed_signals': 'Volatile publisher and transient local subscription; Subscription '
               'deadline is less than publisher deadline',
               'pilot': 'Best effort publisher and reliable subscription'}
    keys = {f'conflict.qos.{topic}.observer' for topic in reasons}
    bench.until(lambda: keys <= node.report().details.keys(), 'the report')
    assert node.report().fault
    log = capfd.readouterr().err
    for topic, reason in reasons.items():
        text = f'/{topic}: no messages between this node and /observer: '
        assert text in node.report().summary
        assert log.count(text) == log.count(reason) == 1
    bench.remove(observer)
    bench.until(lambda: not keys & node.report().details.keys(), 'its end')


def test_endpoints_of_another_type_on_the_hidden_topics_of_an_action_are_named(bench):
    node, hidden = bench.add_role('bs'), [f'locate/_action/{name}' for name in (
        'feedback', 'status')]
    # One participant would refuse two types for a topic.
    with contextlib.closing(Bench(EventsExecutor)) as other:
        observer = other.add(Node, 'observer')
        for name in hidden:
            observer.create_publisher(String, name, 1)
        keys = {f'conflict.type.{name}.observer' for name in hidden}
        bench.until(lambda: keys <= node.report().details.keys(), 'the report')


def test_a_node_examines_its_own_topics_while_another_one_has_its_name(bench):
    """The graph of ROS lists the topics of either for both."""
    twin, observer = bench.add(Node, 'twin'), bench.add(Node, 'observer')
    node = bench.add(Node, 'twin')
    node.create_publisher(TYPES['feed_signals'], 'feed_signals', EXCHANGE)
    observer.create_subscription(
        TYPES['feed_signals'], 'feed_signals', lambda message: None, LATCHED)
    bench.until(lambda: node.count_subscribers('feed_signals'), 'the observer')
    assert [*Mismatches(node).update()] == ['conflict.qos.feed_signals.observer']
    assert not Mismatches(twin).update()


def test_compatible_observers_are_no_conflict(bench):
    node = bench.add_role('channel')
    observer = bench.add(Node, 'observer')
    observer.create_subscription(
        TYPES['feed_signals'], 'feed_signals', lambda message: None, 10)
    bench.until(lambda: node.count_subscribers('feed_signals'), 'the observer')
    node._peers._poll()
    assert not node.report().fault


# Several nodes of a role

class Radio(Role):
    """A role that collects its events."""

    SENDS, RECEIVES = (m.FeedSignals,), (m.Pilot,)

    def __init__(self):
        super().__init__()
        self.events = []

    def handle(self, event, now_s):
        self.events.append(event)
        return []


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
    pilots.publish(to_ros(pilot, None))
    each_bench.until(lambda: newer.role.events, 'the pilot')
    each_bench.remove(newer)
    each_bench.until(lambda: publishers() == ['older'], 'the resumption')
    assert not older.report().fault
    assert not older.role.events
    pilots.publish(to_ros(pilot, None))
    each_bench.until(lambda: older.role.events, 'the pilot after the resumption')
    log = capfd.readouterr().err
    assert log.count('] [older]: two nodes act as channel: this one stands by for /newer') == 1
    assert log.count('] [newer]: two nodes act as channel: this one serves instead of /older') == 1
    assert log.count('] [older]: no longer: two nodes act as channel') == 1


def test_a_node_announces_itself_periodically_also_while_it_computes(bench, probe):
    received = []
    probe.create_subscription(ros.Presence, topics.PRESENCE, received.append, PRESENCES)
    # Nobody executes the callbacks of this node.
    busy = type(bench)(EventsExecutor)
    node = busy.add(RoleNode, 'channel', values={'use_sim_time': True})
    node.start(Radio())
    bench.until(lambda: len(received) >= 3, 'the announcements')
    busy.close()
    assert {(one.sender, one.node, one.scenario_id, one.use_sim_time) for one in received} == {
        (node.instance, '/channel', node.scenario.id, True)}


def test_a_failed_announcement_is_logged_and_the_next_follows(capfd):
    node, announced = mock.MagicMock(), threading.Event()

    def publish(content):
        if node.create_publisher.return_value.publish.call_count == 1:
            raise rclpy_implementation.RCLError('no memory')
        announced.set()
    node.get_fully_qualified_name.return_value = '/channel'
    node.get_clock.return_value.now.return_value.nanoseconds = 0
    node.get_logger.return_value.name = 'channel'
    node.create_publisher.return_value.publish.side_effect = publish
    found = Peers(node, 'channel', 1, Scenario(), lambda missing: None, lambda stands_by: None)
    assert announced.wait(30.0)
    found.close()
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith('[WARN] ')
    assert line.endswith(' [channel]: others may miss this node: presence: no memory')


def test_the_own_standstill_is_no_silence_of_others(bench, add_channel, monkeypatch):
    older, newer = (add_channel(name) for name in ('older', 'newer'))
    bench.until(lambda: older.stands_by, 'the newer node')
    newer._peers.close()
    now_s = time.monotonic()
    monkeypatch.setattr(presences, 'SILENCE_S', 0.5)
    monkeypatch.setattr(peers, 'time', mock.Mock(monotonic=lambda: now_s))

    def poll(step_s):
        nonlocal now_s
        now_s += step_s
        older._peers._poll()
    for step_s in (0.0, 10.0, 10.0, *4 * [0.1]):
        poll(step_s)
        assert older.stands_by
    for _ in range(5):
        poll(0.1)
    assert not older.stands_by


def test_the_newer_of_two_optimizers_is_followed_until_it_has_gone(bench, bench_files, small):
    def add(name):
        return bench.add_role('optimizer', values={
            'scenario_file': bench_files / 'scenario.yaml',
            'codebook_file': bench_files / f'{name}.yaml'})
    first, second = (Codebook.load(bench_files / f'{name}.yaml').id
                     for name in ('first', 'second'))
    got, late = [], []
    older = add('first')
    CodebookClient(bench.add(Node, 'client'), small.scenario, got.append)
    bench.until(lambda: got, 'the first codebook')
    newer = add('second')
    bench.until(lambda: got[-1].id == second, 'the codebook of the newer optimizer')
    bench.until(lambda: older.stands_by, 'the withdrawal')
    # Either optimizer may answer its request.
    CodebookClient(bench.add(Node, 'late'), small.scenario, late.append)
    bench.until(lambda: late, 'the codebook of the late client')
    assert [codebook.id for codebook in late] == [second]
    bench.remove(newer)
    bench.until(lambda: got[-1].id == late[-1].id == first, 'the codebook of the older one')
    assert [codebook.id for codebook in got] == [first, second, first]


def test_a_codebook_that_no_optimizer_holds_is_not_used(bench, probe, bench_files, small):
    """An optimizer that was suspended may announce its codebook for a moment."""
    first, second = (Codebook.load(bench_files / f'{name}.yaml') for name in ('first', 'second'))
    optimizer = bench.add_role('optimizer', values={
        'scenario_file': bench_files / 'scenario.yaml',
        'codebook_file': bench_files / 'first.yaml'})
    got = []
    client = CodebookClient(bench.add(Node, 'client'), small.scenario,
                            lambda codebook: got.append(codebook.id))
    bench.until(lambda: got == [first.id], 'the codebook of the optimizer')
    codebooks = probe.create_publisher(ros.Codebook, topics.CODEBOOK, LATCHED)
    bench.until(codebooks.get_subscription_count, 'the subscription')
    codebooks.publish(convert.to_bytes(convert.CodebookMessage.of(
        second, optimizer.instance - 1, small.scenario.id), 0))
    bench.until(lambda: client._announced_id == second.id, 'the announcement')
    optimizer._publish()
    bench.until(lambda: not client._announced_id, 'the announcement of the optimizer')
    assert got == [first.id]
    optimizer.set_parameters_atomically(parameters(second.to_parameters()))
    bench.until(lambda: got == [first.id, second.id], 'the next codebook')


def test_a_codebook_that_another_node_announces_is_reported_until_the_node_has_gone(
        bench, bench_files, small, monkeypatch, capfd):
    monkeypatch.setattr(role_node, '_PATIENCE_S', 0.3)
    monkeypatch.setattr(role_node, '_SLOW_RETRY_S', 0.1)
    first, second = (Codebook.load(bench_files / f'{name}.yaml') for name in ('first', 'second'))
    files = {'scenario_file': bench_files / 'scenario.yaml'}
    bench.add_role('optimizer', values={**files, 'codebook_file': bench_files / 'first.yaml'})
    node = bench.add_role('rhs_controller', values=files)
    bench.until(lambda: node.report().details.get('codebook_id') == first.id, 'the codebook')
    player = bench.add(Node, 'player')
    codebooks = player.create_publisher(ros.Codebook, topics.CODEBOOK, LATCHED)
    bench.until(codebooks.get_subscription_count, 'the subscription')
    codebooks.publish(convert.to_bytes(convert.CodebookMessage.of(second), 0))
    text = (f'codebook: another node announces {second.id}, but optimizer holds {first.id}, '
            'which is used')
    bench.until(lambda: text in node.report().summary, 'the report')
    assert node.report().details['codebook_id'] == first.id
    bench.remove(player)
    bench.until(lambda: 'conflict.codebook' not in node.report().details, 'its end')
    log = capfd.readouterr().err
    assert log.count(text) == 2
    assert f'no longer: {text}' in log


def test_a_node_of_another_scenario_changes_nothing(bench, add_channel, monkeypatch):
    monkeypatch.setattr(presences, 'SILENCE_S', 0.5)
    node, changes = add_channel(), []
    other = Peers(bench.add(Node, 'other'), 'optimizer', time.time_ns(), node.scenario,
                  lambda missing: None, changes.append)
    stranger = bench.add(Node, 'stranger')
    publisher = stranger.create_publisher(ros.Presence, topics.PRESENCE, LATCHED)

    def is_found():
        publisher.publish(ros.Presence(
            sender=1, scenario_id='sc2', role='optimizer', node='/stranger', scenario='{}'))
        return 'conflict.scenario' in other.conflicts()
    bench.until(is_found, 'the stranger')
    bench.remove(stranger)
    bench.until(lambda: not other.conflicts(), 'its absence')
    assert changes == []


def test_in_a_site_the_base_station_needs_the_fusion_but_no_other_node_beside_it(bench, announce):
    reports, rivals = [], []
    own = Peers(bench.add(Node, 'bs', namespace='/front'), 'bs', time.time_ns(), Scenario(),
                reports.append, rivals.append, site_prefix='/')
    for role in ROSTER['bs'].needed:
        announce(role, namespace='/front')
    # Another network.
    announce('bs', namespace='/')
    bench.until(lambda: ('fusion',) in reports, 'the nodes of the surface')
    fusion = announce('fusion', namespace='/')
    bench.until(lambda: reports[-1] == (), 'the fusion')
    fusion.close()
    bench.until(lambda: reports[-1] == ('fusion',), 'its absence')
    own.close()
    assert rivals == []


def endpoint(name, gid=1, topic_type='rhs_isac_msgs/msg/Ack', profile=EXCHANGE,
             endpoint_type=TopicEndpointTypeEnum.PUBLISHER):
    return types.SimpleNamespace(
        node_name=name, node_namespace='/', topic_type=topic_type, qos_profile=profile,
        endpoint_gid=[gid] * 16, endpoint_type=endpoint_type)


@pytest.fixture
def graph(monkeypatch):
    """A node that subscribes to acks, the publishers of which a test sets, and its clock."""
    node, clock = mock.MagicMock(), mock.MagicMock(return_value=100.0)
    node.get_fully_qualified_name.return_value = '/bs'
    node.publishers, node.subscriptions = [], [types.SimpleNamespace(topic_name='/ack')]
    node.count_publishers.return_value = node.count_subscribers.return_value = 1
    node.get_subscriptions_info_by_topic.return_value = [
        endpoint(name, endpoint_type=TopicEndpointTypeEnum.SUBSCRIPTION)
        for name in ('bs', 'recorder')]
    monkeypatch.setattr(peers.time, 'monotonic', clock)
    return node, clock


@pytest.mark.parametrize('receives', [True, False])
def test_an_endpoint_of_another_type_is_named(graph, receives):
    """Whether it publishes or subscribes: this node does not know for whom a topic is."""
    node, _ = graph
    chatter = endpoint('chatter', topic_type='std_msgs/msg/String',
                       endpoint_type=TopicEndpointTypeEnum(1 + receives))
    node.get_publishers_info_by_topic.return_value = [endpoint('user_1'), chatter]
    assert Mismatches(node).update() == {
        'conflict.type.ack.chatter': '/ack: no messages between this node and /chatter: type '
                                     'std_msgs/msg/String, expected rhs_isac_msgs/msg/Ack'}


@pytest.mark.parametrize('name', peers.UNNAMED)
def test_an_endpoint_that_receives_no_name_is_named_by_its_gid(graph, name):
    node, clock = graph
    publishers = [endpoint(name, 171, profile=SENSOR), endpoint('user_1')]
    node.get_publishers_info_by_topic.return_value = publishers
    mismatches = Mismatches(node)
    for clock.return_value in (100.0, 100.1, 102.9):
        assert not mismatches.update()
    clock.return_value = 103.0
    gid = 16 * 'ab'
    expected = {f'conflict.qos.ack.DDS_endpoint_{gid}': '/ack: no messages between this node and '
                f'DDS endpoint {gid}: Best effort publisher and reliable subscription'}
    assert mismatches.update() == expected
    # Then, the topics are examined only if endpoints appear or go.
    n_calls = node.get_publishers_info_by_topic.call_count
    assert mismatches.update() == expected
    assert node.get_publishers_info_by_topic.call_count == n_calls
    node.count_publishers.return_value = 2
    publishers[0].node_name = 'late'
    assert [*mismatches.update()] == ['conflict.qos.ack.late']
