"""Endpoints that the middleware refuses, topics of single users, and jobs in the background."""

import inspect
import threading

import pytest
from geometry_msgs.msg import Point, Vector3
from rcl_interfaces.msg import Log
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from rclpy.serialization import serialize_message
from ros_messages import position_estimate

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.nodes import bs
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import endpoints, topics
from rhs_isac_ros.ros.endpoints import BackgroundWorker, UserTopics
from rhs_isac_ros.ros.roster import ROSTER
from rhs_isac_ros.support import plugins


def test_a_line_has_its_severity_and_the_place_of_the_call(bench, probe, capfd, monkeypatch):
    """The caller is not searched in all modules, which delays the first line of a process."""
    monkeypatch.setattr(inspect, 'getframeinfo', None)
    lines = []
    bench.add(Node, 'observer').create_subscription(Log, '/rosout', lines.append, 10)
    bench.until(lambda: probe.count_subscribers('/rosout'), 'the observer')
    probe.get_logger().set_level(LoggingSeverity.WARN)
    endpoints.log(probe, 'hidden')
    endpoints.log(probe, 'one', LoggingSeverity.WARN)
    endpoints.log(probe, 'two', LoggingSeverity.ERROR)
    probe.get_logger().set_level(LoggingSeverity.UNSET)
    bench.until(lambda: [line for line in lines if line.msg == 'two'], 'the lines')
    place = inspect.currentframe().f_code
    assert [(line.msg, line.level, line.function, line.file) for line in lines
            if line.name == 'probe'] == [
        (text, level, place.co_name, place.co_filename)
        for text, level in [('one', Log.WARN), ('two', Log.ERROR)]]
    assert ' [probe]: two' in capfd.readouterr().err


def test_a_message_is_created_once_for_all_topics_with_subscribers(bench, probe):
    publishers = [endpoints.create_publisher(probe, Point, name, endpoints.EXCHANGE)
                  for name in ('one', 'two', 'unread')]
    made, received = [], []

    def make():
        made.append(Point(x=1.0))
        return made[-1]
    endpoints.publish_if_subscribed(publishers, make)
    assert not made
    for publisher in publishers[:2]:
        endpoints.subscribe(probe, Point, publisher.topic_name, received.append,
                            endpoints.EXCHANGE)
        bench.until(publisher.get_subscription_count, 'the subscription')
    endpoints.publish_if_subscribed(publishers, make)
    bench.until(lambda: len(received) == 2, 'the messages')
    assert received == 2 * made


def test_the_node_logs_that_it_drops_an_invalid_message(bench, probe, capfd):
    publisher = endpoints.create_publisher(probe, Point, 'point', endpoints.EXCHANGE)
    received = []
    endpoints.subscribe(probe, Point, 'point', received.append, endpoints.EXCHANGE)
    bench.until(publisher.get_subscription_count, 'the subscription')
    content = serialize_message(Point(x=1.0))
    for one in (content[:8], content[:12], content):
        publisher.publish(one)
    bench.until(lambda: received == [Point(x=1.0)], 'the valid message')
    text = capfd.readouterr().err
    assert 'dropped: Point: failed to deserialize ROS message' in text
    assert 'rcutils' not in text


@pytest.mark.parametrize('overridable', [False, True])
def test_endpoints_have_no_event_handlers(probe, overridable):
    """Otherwise, a node crashes that withdraws publishers beside an observer that gets nothing."""
    publisher = endpoints.create_publisher(
        probe, Point, 'one', endpoints.EXCHANGE, overridable=overridable)
    endpoints.subscribe(
        probe, Point, 'one', lambda message: None, endpoints.EXCHANGE, overridable=overridable)
    (subscription,) = (one for one in probe.subscriptions if one.topic_name == '/one')
    assert publisher.event_handlers == subscription.event_handlers == []


@pytest.fixture
def refused(monkeypatch):
    """Names of the topics and services that were refused: all but those of every rclpy node."""
    names = []

    def refuse(method):
        create = getattr(Node, method)

        def attempt(node, kind, name, *args, **options):
            if kind.__module__.startswith(('rcl_interfaces.msg', 'type_description')) or (
                    method == 'create_service' and kind.__module__.startswith('rcl_interfaces')):
                return create(node, kind, name, *args, **options)
            names.append(name)
            raise rclpy_implementation.RCLError(f'{name} not found in allow rule\n, at a.cpp:1')
        monkeypatch.setattr(Node, method, attempt)
    for method in ('create_publisher', 'create_subscription', 'create_client', 'create_service'):
        refuse(method)

    def refuse_action(node, kind, name, *_, **__):
        names.append(name)
        raise ValueError(f'{name} not found in allow rule, at a.cpp:1')
    monkeypatch.setattr(bs, 'ActionServer', refuse_action)
    return names


@pytest.mark.parametrize('role', sorted(ROSTER))
def test_a_role_runs_without_what_was_refused(bench, bench_files, refused, capfd, role):
    member = ROSTER[role]
    values = {'scenario_file': bench_files / 'scenario.yaml'} if member.has_codebook else {}
    node = bench.add_role(
        role, values=values, **({'name': 'user_1'} if role == 'user' else {}))
    if member.has_codebook:
        node._on_codebook(Codebook.load(bench_files / 'first.yaml'))
    if role == 'positioner':
        bench.until(lambda: topics.NAMES[m.ReceivedSignals] in refused, 'the estimator')
        assert node.publish(position_estimate())
    if role == 'user':
        node._publish_ground_truth()
    bench.spin_once()
    # Only tracks have odometry.
    assert {*member.sent, *member.received} - {topics.ODOMETRY} <= {
        name.replace('user_1', 'user_{user}') for name in refused}
    texts = endpoints.refusals(node)
    assert {text.partition(' was refused: ')[2] for text in texts.values()} == {
        f'{name} not found in allow rule' for name in refused}
    report = node.report()
    assert report.fault
    assert {*texts.values()} <= {*report.details.values()}
    assert capfd.readouterr().err.count('was refused') == len(texts)


def test_a_simulation_whose_time_was_refused_is_not_used(bench, refused):
    node = bench.add_role('bs')
    result = node.set_parameters_atomically([Parameter('use_sim_time', value=True)])
    assert (result.successful, result.reason) == (
        False, 'subscription to /clock was refused: /clock not found in allow rule')
    assert not node.get_clock().ros_time_is_active
    assert not node.get_parameter('use_sim_time').value


def test_the_visualizer_runs_without_what_was_refused(bench, refused):
    node = bench.add_role('visualizer')
    node._on_message(position_estimate(), 0.0)
    node._show()
    assert {topics.MARKERS, topics.PATH.format(user=1), topics.TRUE_PATH.format(user=1)} <= {
        *refused}


def test_a_refusal_is_logged_once(probe, refused, capfd):
    for _ in range(2):
        publisher = endpoints.create_publisher(probe, m.Ack, 'ack', 1)
        publisher.publish(b'')
        assert (publisher.topic_name, publisher.get_subscription_count()) == ('/ack', 0)
        assert not probe.destroy_publisher(publisher)
    assert refused == ['ack', 'ack']
    assert capfd.readouterr().err.count('publisher of ack was refused: ack not found') == 1


def test_an_override_changes_only_its_topic(bench):
    node = bench.add(Node, 'overridden', values={
        f'qos_overrides./one.{endpoint}.{policy}': value
        for endpoint in ('publisher', 'subscription')
        for policy, value in (('reliability', 'best_effort'), ('depth', 3))})
    for name in ('one', 'two'):
        endpoints.create_publisher(node, Point, name, endpoints.EXCHANGE, overridable=True)
        endpoints.subscribe(node, Point, name, lambda message: None, endpoints.EXCHANGE,
                            overridable=True)
    for find in (node.get_publishers_info_by_topic, node.get_subscriptions_info_by_topic):
        bench.until(lambda find=find: find('/one') and find('/two'), 'the endpoints')
        one, two = (find(name)[0].qos_profile.reliability for name in ('/one', '/two'))
        assert (one, two) == (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE)
    assert endpoints.EXCHANGE.reliability == ReliabilityPolicy.RELIABLE
    assert endpoints.EXCHANGE.depth == 128


@pytest.fixture
def user_topics(probe):
    """Topics of the users up to number 7."""
    return UserTopics(probe, {'users/user_{user}/a': Point, 'users/user_{user}/b': Vector3}, 7)


def names(publishers):
    return [publisher.topic_name for publisher in publishers]


def test_each_user_has_its_publishers(user_topics):
    first = user_topics.publishers(7)
    assert names(first) == ['/users/user_7/a', '/users/user_7/b']
    assert [publisher.msg_type for publisher in first] == [Point, Vector3]
    assert user_topics.publishers(7) == first


def test_users_with_higher_numbers_have_none_and_one_is_logged(user_topics, capfd):
    for user in range(8, 1008):
        assert user_topics.publishers(user) == ()
    assert len(user_topics.publishers(1)) == 2
    assert capfd.readouterr().err.count('no topics for user') == 1
    assert user_topics.publishers(8) == user_topics.publishers(1009) == ()


def test_the_topics_of_a_user_that_was_removed_are_created_again(user_topics, probe):
    user_topics.publishers(1)
    user_topics.remove(1)
    user_topics.remove(9)
    assert not probe.count_publishers('users/user_1/a')
    assert names(user_topics.publishers(1)) == ['/users/user_1/a', '/users/user_1/b']


@pytest.fixture
def background(each_bench):
    background = BackgroundWorker(each_bench.add(Node, 'busy'))
    yield background
    background.close()


def test_a_job_runs_in_another_thread_and_its_result_is_delivered_here(each_bench, background):
    seen = []
    background.run(threading.current_thread, lambda worker: seen.append(
        (worker, threading.current_thread())))
    ((worker, receiver),) = each_bench.until(lambda: seen)
    assert receiver is threading.current_thread()
    assert worker is not receiver
    assert worker.name.startswith('busy')


def test_jobs_run_one_after_the_other(each_bench, background):
    order = []
    for n in range(5):
        background.run(lambda n=n: order.append(('begin', n)) or n,
                       lambda n: order.append(('end', n)))
    each_bench.until(lambda: len(order) == 10)
    assert [n for kind, n in order if kind == 'begin'] == list(range(5))
    assert [n for kind, n in order if kind == 'end'] == list(range(5))


def test_an_exception_of_a_job_is_raised_where_the_node_spins(each_bench, background):
    def fail():
        raise ZeroDivisionError('of the job')
    background.run(fail, lambda result: None)
    with pytest.raises(ZeroDivisionError, match='of the job'):
        each_bench.until(lambda: False)


def test_a_plug_in_that_fails_in_a_job_or_a_timer_is_logged(each_bench, background, capfd):
    """Also by nodes without a role: the visualizer draws beams through boards and patterns."""
    def fail():
        with plugins.calling('Grid.linear'):
            return 1 / 0
    results = []
    background.run(fail, lambda result: None)
    background.run(lambda: 'next', results.append)
    node = each_bench.add(Node, 'drawing')
    timer = endpoints.steady_timer(node, 0.01, lambda: (results.append('drawn'), fail()))
    each_bench.until(lambda: {*results} == {'next', 'drawn'})
    timer.cancel()
    log = capfd.readouterr().err
    assert log.count('plug-in: Grid.linear: ZeroDivisionError: division by zero\nTraceback') == 2


def test_closing_waits_for_the_running_job_and_discards_the_others(
        each_bench, background, monkeypatch):
    begun, released, done, results = threading.Event(), threading.Event(), [], []
    shut_down = background._pool.shutdown

    def release(wait, cancel_futures):
        shut_down(wait=False, cancel_futures=cancel_futures)
        released.set()
        shut_down(wait=wait)

    def first():
        begun.set()
        released.wait()
        done.append(1)
    background.run(first, results.append)
    background.run(lambda: done.append(2), results.append)
    assert begun.wait(60)
    # Until the others are cancelled, the first one runs.
    monkeypatch.setattr(background._pool, 'shutdown', release)
    background.close()
    assert done == [1]
    assert not results
