"""What a node knows about others from the ROS graph."""

import threading
import time
from unittest import mock

import numpy as np
import pytest
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from ros_messages import to_ros

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.channel import ChannelNode
from rhs_isac_ros.nodes.optimizer import OptimizerNode
from rhs_isac_ros.nodes.positioner import PositionerNode
from rhs_isac_ros.nodes.rhs_controller import RhsControllerNode
from rhs_isac_ros.nodes.transmission import TransmissionNode
from rhs_isac_ros.nodes.user import UserNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol import presences
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.ros import convert, peers, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED, PRESENCES
from rhs_isac_ros.ros.peers import Peers, new_instance
from rhs_isac_ros.ros.role_node import CodebookClient, RoleNode
from rhs_isac_ros.ros.roster import ROSTER, identifying_endpoints

TYPES = {name: convert.ros_type(kind) for kind, name in topics.NAMES.items()} | {
    topics.CODEBOOK: ros.Codebook}
REQUIRED = {name: {role: identifying_endpoints(role) for role in member.needed}
            for name, member in ROSTER.items() if member.needed}


def create_endpoints(node, endpoints):
    """Create the endpoints of a role, without its behaviour."""
    publishers, subscriptions = endpoints
    for name in publishers:
        node.create_publisher(TYPES[name], name, EXCHANGE)
    for name in subscriptions:
        node.create_subscription(TYPES[name], name, lambda message: None, EXCHANGE)


@pytest.fixture(autouse=True)
def frequent_polls(monkeypatch):
    monkeypatch.setattr(peers, '_POLL_S', 0.01)
    monkeypatch.setattr(peers, '_IDLE_POLL_S', 0.1)
    monkeypatch.setattr(peers, 'PERIOD_S', 0.1)
    monkeypatch.setattr(presences, 'SILENCE_S', 0.5)


@pytest.fixture
def monitor(bench):
    """Return a function that watches for the peers of a role and returns the reports."""
    def monitor(role, *cli_args):
        reports = []
        node = bench.add(Node, 'monitor', cli_args=['--ros-args', *cli_args])
        Peers(node, role, new_instance(), Scenario(), lambda missing: reports.append(missing),
              lambda stands_by: None)
        return reports
    return monitor


def test_a_required_role_is_identified_by_topics_that_only_it_publishes_or_receives():
    assert {role: one for required in REQUIRED.values() for role, one in required.items()} == {
        'bs': (('beacon',), ('ack',)),
        'rhs_controller': (('rhs/configuration',), ('rhs/command',)),
        'channel': (('feed_signals',), ('pilot',)),
        'positioner': (('position_estimate',), ('received_signals',)),
        'transmission': (('beam',), ()),
        'optimizer': (('codebook',), ()),
    }


@pytest.mark.parametrize('role', REQUIRED)
def test_all_roles_are_missing_at_first_and_each_change_is_reported_once(bench, monitor, role):
    required = REQUIRED[role]
    reports = monitor(role)
    bench.until(lambda: reports, 'the first report')
    names = tuple(required)
    nodes = {}
    for name in reversed(names):
        nodes[name] = bench.add(Node, name)
        create_endpoints(nodes[name], required[name])
        bench.until(lambda name=name: name not in reports[-1], f'presence of {name}')
    for name in names:
        bench.remove(nodes.pop(name))
        bench.until(lambda name=name: name in reports[-1], f'absence of {name}')
    found = [tuple(report) for report in reports if [*report] == [*report.values()]]
    assert found == [names[:n] for n in (*range(len(names), -1, -1), *range(1, len(names) + 1))]


@pytest.mark.parametrize(('role', 'name', 'side', 'topic'), [
    (role, name, side, topic) for role, required in REQUIRED.items()
    for name, endpoints in required.items() for side in (0, 1) for topic in endpoints[side]])
def test_the_lacking_endpoint_of_a_role_is_described(bench, monitor, role, name, side, topic):
    endpoints = REQUIRED[role][name]
    partial = [[one for one in group if (number, one) != (side, topic)]
               for number, group in enumerate(endpoints)]
    node = bench.add(Node, name)
    create_endpoints(node, partial)
    reports = monitor(role)
    # Observers subscribe as well, so that a role without a publisher is missing as a whole.
    text = name if side == 0 else f'{name} (no subscriber of /{topic})'
    bench.until(lambda: reports and reports[-1].get(name) == text, 'the description')
    create_endpoints(node, ([topic], []) if side == 0 else ([], [topic]))
    bench.until(lambda: name not in reports[-1], f'presence of {name}')


def test_a_role_is_present_from_the_second_poll_in_a_row_that_finds_it():
    node, reports = mock.MagicMock(), []
    node.get_fully_qualified_name.return_value = '/user'
    node.resolve_topic_name.side_effect = '/{}'.format
    Peers(node, 'user', 1, Scenario(), reports.append, lambda stands_by: None)
    poll = node.create_timer.call_args.args[1]

    def poll_while(present):
        node.count_publishers.return_value = node.count_subscribers.return_value = int(present)
        node.get_publishers_info_by_topic.return_value = (
            node.get_subscriptions_info_by_topic.return_value) = present * [mock.Mock(
                node_name='other', node_namespace='/', qos_profile=EXCHANGE)]
        poll()
        return {} in reports

    # A role that every other poll finds is missing, which is reported after a grace period.
    for number in range(1, 101):
        assert not poll_while(present=number % 2)
        assert bool(reports) == (number >= peers._GRACE_POLLS)
    assert reports == [{'channel': 'channel', 'bs': 'bs'}]
    assert not poll_while(present=True)
    assert poll_while(present=True)


def test_an_observer_does_not_stand_for_a_role(bench, monitor):
    """The positioner publishes from its start, and subscribes when it has an estimator."""
    publishers, subscriptions = REQUIRED['bs']['positioner']
    positioner = bench.add(Node, 'positioner')
    create_endpoints(positioner, (publishers, ()))
    observer = bench.add(Node, 'observer')
    create_endpoints(observer, ((), subscriptions))
    reports = monitor('bs')
    text = 'positioner (no subscriber of /received_signals)'
    bench.until(lambda: reports and reports[-1]['positioner'] == text, 'a report')
    create_endpoints(positioner, ((), subscriptions))
    bench.until(lambda: 'positioner' not in reports[-1], 'presence')


def test_a_node_that_has_fallen_silent_is_missing_although_the_graph_contains_it(bench, monitor):
    """Discovery forgets a killed process only after 20 s."""
    positioner = bench.add(Node, 'positioner')
    create_endpoints(positioner, REQUIRED['bs']['positioner'])
    publisher = positioner.create_publisher(ros.Presence, topics.PRESENCE, LATCHED)
    reports = monitor('bs')
    bench.until(lambda: reports and 'positioner' not in reports[-1], 'presence')
    for _ in range(2):
        publisher.publish(ros.Presence(
            sender=1, role='positioner', node='/positioner', scenario='{}'))
        bench.until(lambda: reports[-1].get('positioner') == 'positioner', 'silence')
        publisher.publish(ros.Presence(
            sender=2, role='positioner', node='/positioner', scenario='{}'))
        bench.until(lambda: 'positioner' not in reports[-1], 'presence of the second instance')


def test_the_endpoints_of_a_killed_process_do_not_belong_to_its_successor(bench):
    killed = bench.add(Node, 'positioner')
    create_endpoints(killed, REQUIRED['bs']['positioner'])
    publisher = killed.create_publisher(ros.Presence, topics.PRESENCE, LATCHED)
    announcement = {'node': '/positioner', 'scenario': '{}'}
    reports = []
    watch = Peers(bench.add(Node, 'monitor'), 'bs', new_instance(), Scenario(), reports.append,
                  lambda stands_by: None)
    publisher.publish(ros.Presence(sender=1, role='positioner', **announcement))
    bench.until(lambda: reports and 'positioner' not in reports[-1], 'presence')
    bench.until(lambda: 'positioner' in reports[-1], 'silence')
    n_reports, n_polls = len(reports), watch._polls
    publisher.publish(ros.Presence(sender=2, role='', **announcement))
    bench.until(lambda: watch._polls > n_polls + 20, 'polls')
    assert len(reports) == n_reports
    publisher.publish(ros.Presence(sender=2, role='positioner', **announcement))
    bench.until(lambda: 'positioner' not in reports[-1], 'presence of the successor')


@pytest.mark.parametrize('unknown', ['_NODE_NAME_UNKNOWN_', '_CREATED_BY_BARE_DDS_APP_'])
def test_endpoints_without_the_name_of_their_node_belong_to_their_participant(unknown):
    """Fast DDS does not deliver names again after a process has stood still."""
    def endpoint(participant):
        return mock.Mock(node_name=unknown, node_namespace='/', qos_profile=EXCHANGE,
                         endpoint_gid=[*[participant] * 12, 0, 0, 0, 1])
    node, reports = mock.MagicMock(), []
    node.get_fully_qualified_name.return_value = '/user'
    node.resolve_topic_name.side_effect = '/{}'.format
    node.count_publishers.return_value = node.count_subscribers.return_value = 1
    node.get_publishers_info_by_topic.return_value = [endpoint(1)]
    node.get_subscriptions_info_by_topic.return_value = [endpoint(2)]
    Peers(node, 'user', 1, Scenario(), reports.append, lambda stands_by: None)
    poll = node.create_timer.call_args.args[1]
    for _ in range(20):
        poll()
    assert reports == [{'channel': 'channel (no subscriber of /pilot)',
                        'bs': 'bs (no subscriber of /ack)'}]
    node.get_subscriptions_info_by_topic.return_value = [endpoint(1)]
    for _ in range(2):
        poll()
    assert reports[-1] == {}


def test_only_the_own_namespace_counts(bench, monitor):
    endpoints = REQUIRED['transmission'][topics.OPTIMIZER_NODE]
    create_endpoints(bench.add(Node, 'there', namespace='/b'), endpoints)
    reports = monitor('transmission', '-r', '__ns:=/a')
    bench.until(lambda: reports, 'a report')
    assert reports == [{'optimizer': 'optimizer'}]
    create_endpoints(bench.add(Node, 'here', namespace='/a'), endpoints)
    bench.until(lambda: reports[-1] == {}, 'presence')


def test_remapped_topics_are_followed(bench, monitor):
    rules = ['-r', 'codebook:=/elsewhere/book']
    create_endpoints(bench.add(Node, 'optimizer', cli_args=['--ros-args', *rules]),
                     REQUIRED['transmission'][topics.OPTIMIZER_NODE])
    reports = monitor('transmission', *rules)
    bench.until(lambda: {} in reports, 'presence')


def test_a_node_is_reported_as_present_when_it_is_ready(bench, monitor):
    """The channel is ready at once; the positioner subscribes when it has an estimator."""
    reports = monitor('bs')
    bench.add(ChannelNode)
    positioner = bench.add(PositionerNode)
    text = 'positioner (no subscriber of /received_signals)'
    bench.until(lambda: reports and 'channel' not in reports[-1]
                and reports[-1].get('positioner') == text, 'presence of the channel')
    positioner.subscribe()
    bench.until(lambda: 'positioner' not in reports[-1], 'presence of the positioner')


def test_a_user_whose_acks_nobody_receives_names_the_topic(bench, capfd):
    """Its beacons arrive, so that the base station is not missing as a whole."""
    for role in ('bs', 'channel'):
        create_endpoints(bench.add(Node, role), identifying_endpoints(role))
    user = bench.add(UserNode, cli_args=['--ros-args', '-r', 'ack:=elsewhere'])
    text = 'waiting for bs (no subscriber of /elsewhere)'
    bench.until(lambda: user.report().summary == text, 'the report')
    assert capfd.readouterr().err.count(text) == 1


@pytest.mark.parametrize('kind', [RhsControllerNode, PositionerNode, TransmissionNode])
def test_a_node_without_an_optimizer_reports_it(bench, kind, capfd):
    node = bench.add(kind)
    bench.until(lambda: node.report().summary == 'waiting for optimizer', 'the report')
    assert node.report().fault
    optimizer = bench.add(OptimizerNode)
    bench.until(lambda: not node._statistics.missing, 'the optimizer')
    bench.until(lambda: node._codebook_client.codebook_id, 'the codebook')
    bench.remove(optimizer)
    bench.until(lambda: node._statistics.missing, 'its absence')
    log = capfd.readouterr().err
    codebook_id = node._codebook_client.codebook_id
    assert log.count('optimizer is not present; the codebook in use is none') == 1
    assert log.count(f'optimizer is not present; the codebook in use is {codebook_id}') == 1
    assert log.count('optimizer is present again') == 1


def test_what_a_role_lacks_is_reported_with_the_missing_roles(bench):
    node = bench.add(RhsControllerNode)
    # What is missing is not known yet.
    node.set_lacking('power')
    bench.until(lambda: node._statistics.missing == ('optimizer', 'power'), 'the report')
    node.set_lacking('')
    assert node._statistics.missing == ('optimizer',)


# Quality of service

@pytest.mark.parametrize('publishes', [True, False])
def test_endpoints_with_incompatible_qos_are_named_once(bench, probe, publishes, capfd):
    node = bench.add(ChannelNode)
    text = '/feed_signals: no messages between this node and /observer: '
    observer = bench.add(Node, 'observer')
    if publishes:
        observer.create_subscription(
            TYPES['feed_signals'], 'feed_signals', lambda message: None, LATCHED)
        key = 'conflict.qos.feed_signals.observer'
    else:
        observer.create_publisher(TYPES['pilot'], 'pilot', qos_profile_sensor_data)
        key, text = 'conflict.qos.pilot.observer', text.replace('feed_signals', 'pilot')
    bench.until(lambda: key in node.report().values, 'the report')
    assert node.report().fault
    assert text in node.report().summary
    log = capfd.readouterr().err
    assert log.count(text) == 1
    assert ('Volatile publisher and transient local' if publishes else
            'Best effort publisher and reliable') + ' subscription' in log
    bench.remove(observer)
    bench.until(lambda: key not in node.report().values, 'its end')


def test_compatible_observers_are_no_conflict(bench):
    node = bench.add(ChannelNode)
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
    pilots.publish(to_ros(pilot, None))
    each_bench.until(lambda: newer.role.events, 'the pilot')
    each_bench.remove(newer)
    each_bench.until(lambda: publishers() == ['older'], 'the resumption')
    assert not older.report().fault
    assert not older.role.events
    pilots.publish(to_ros(pilot, None))
    each_bench.until(lambda: older.role.events, 'the pilot after the resumption')
    log = capfd.readouterr().err
    assert log.count('this one stands by for /newer') == 1
    assert log.count('this one serves instead of /older') == 1


def test_a_node_announces_itself_periodically_also_while_it_computes(bench, probe):
    received = []
    probe.create_subscription(ros.Presence, topics.PRESENCE, received.append, PRESENCES)
    # Nobody executes the callbacks of this node.
    busy = type(bench)(EventsExecutor)
    node = busy.add(RoleNode, 'channel')
    node.start(Radio())
    bench.until(lambda: len(received) == 3, 'the announcements')
    busy.close()
    assert {(one.sender, one.node, one.scenario_id) for one in received} == {
        (node.instance, '/channel', node.scenario.id)}


def test_a_failed_announcement_is_logged_and_the_next_follows():
    node, announced = mock.MagicMock(), threading.Event()

    def publish(content):
        if node.create_publisher.return_value.publish.call_count == 1:
            raise rclpy_implementation.RCLError('no memory')
        announced.set()
    node.get_fully_qualified_name.return_value = '/channel'
    node.get_clock.return_value.now.return_value.nanoseconds = 0
    node.create_publisher.return_value.publish.side_effect = publish
    found = Peers(node, 'channel', 1, Scenario(), lambda missing: None, lambda stands_by: None)
    assert announced.wait(30.0)
    found.close()
    (call,) = node.get_logger.return_value.error.call_args_list
    assert call.args == ('others may miss this node: presence: no memory',)


def test_a_node_whose_announcements_have_no_thread_reports_that(bench, add_channel, monkeypatch):
    with monkeypatch.context() as limited:
        limited.setattr(threading.Thread, 'start', mock.Mock(side_effect=RuntimeError('no more')))
        node = add_channel()
    assert 'thread of announcements was refused: no more' in node.report().summary
    bench.remove(node)


def test_the_own_standstill_is_no_silence_of_others(bench, add_channel, monkeypatch):
    older, newer = (add_channel(name) for name in ('older', 'newer'))
    bench.until(lambda: older.stands_by, 'the newer node')
    newer._peers.close()
    now_s = time.monotonic()
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
        return bench.add(OptimizerNode, parameter_overrides=[
            Parameter('scenario_file', value=str(bench_files / 'scenario.yaml')),
            Parameter('codebook_file', value=str(bench_files / f'{name}.yaml'))])
    first, second = (Codebook.load(bench_files / f'{name}.yaml').id
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
        bench, probe, bench_files, small):
    """A process that was suspended serves for a moment, because it misses the newer one."""
    first, second = (Codebook.load(bench_files / f'{name}.yaml') for name in ('first', 'second'))
    newer = bench.add(OptimizerNode, parameter_overrides=[
        Parameter('scenario_file', value=str(bench_files / 'scenario.yaml')),
        Parameter('codebook_file', value=str(bench_files / 'first.yaml'))])
    got = []
    CodebookClient(bench.add(Node, 'client'), small.scenario,
                   lambda codebook: got.append(codebook.id))
    bench.until(lambda: got == [first.id], 'the codebook of the newer one')
    def announce():
        """Start a node that announces itself as an older optimizer."""
        node = bench.add(Node, 'older')
        publisher = node.create_publisher(ros.Presence, topics.PRESENCE, LATCHED)
        publisher.publish(ros.Presence(
            sender=newer._instance - 1, scenario_id=small.scenario.id, role='optimizer',
            node='/older', scenario='{}'))
        return node
    older = announce()
    bench.until(newer._peers.conflicts, 'the older one')
    bench.remove(older)
    bench.until(lambda: not newer._peers.conflicts(), 'its absence')
    codebooks = probe.create_publisher(ros.Codebook, topics.CODEBOOK, LATCHED)
    bench.until(codebooks.get_subscription_count, 'the subscription')
    codebooks.publish(convert.to_bytes(convert.CodebookMessage.of(
        second, newer._instance - 1, small.scenario.id), 0))
    bench.until(lambda: got == [first.id, second.id], 'the codebook of the older one')
    announce()
    bench.until(lambda: got == [first.id, second.id, first.id], 'the codebook of the newer one')


def test_a_node_of_another_scenario_changes_nothing(bench, add_channel):
    node, changes = add_channel(), []
    other = Peers(bench.add(Node, 'other'), 'optimizer', new_instance(), node.scenario,
                  lambda missing: None, changes.append)
    stranger = bench.add(Node, 'stranger')
    publisher = stranger.create_publisher(ros.Presence, topics.PRESENCE, LATCHED)
    publisher.publish(ros.Presence(
        sender=1, scenario_id='sc2', role='optimizer', node='/stranger', scenario='{}'))
    bench.until(lambda: 'conflict.sc2' in other.conflicts(), 'the stranger')
    bench.remove(stranger)
    bench.until(lambda: not other.conflicts(), 'its absence')
    assert changes == []


def test_of_three_nodes_with_the_same_name_the_newest_serves_until_it_has_gone(bench, probe):
    nodes = []
    for _ in range(3):
        nodes.append(bench.add(RoleNode, 'channel', 'channel'))
        nodes[-1].start(Radio())
    topic = f'/{topics.NAMES[m.FeedSignals]}'

    def serving():
        return [node.stands_by for node in nodes] == [True] * (len(nodes) - 1) + [False] and (
            len(probe.get_publishers_info_by_topic(topic)) == 1)
    while nodes:
        bench.until(serving, 'the newest node')
        bench.remove(nodes.pop())
