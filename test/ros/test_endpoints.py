"""A topic or service that the middleware refuses costs its node that topic or service alone."""

import importlib

import numpy as np
import pytest
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter

from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import endpoints, locate, topics
from rhs_isac_ros.ros.roster import ROSTER

ESTIMATE = m.PositionEstimate(
    cycle_id=1, user=1, codebook_id='', position=np.array([2.0, 0.0, 0.0]),
    covariance_m2=np.eye(3), crlb_m2=0.1, estimator='bayes', latency_s=0.01)


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
    monkeypatch.setattr(locate, 'ActionServer', refuse_action)
    return names


@pytest.fixture
def no_timers(monkeypatch):
    def refuse(*_, **__):
        raise rclpy_implementation.RCLError('no memory\n, at a.cpp:1')
    monkeypatch.setattr(Node, 'create_timer', refuse)


@pytest.fixture
def make(bench):
    def make(executable):
        module = importlib.import_module(f'rhs_isac_ros.nodes.{executable}')
        kind = getattr(module, f'{executable.title().replace("_", "")}Node')
        return bench.add(kind, **({'name': 'user_1'} if executable == 'user' else {}))
    return make


@pytest.mark.parametrize('role', sorted(ROSTER))
def test_a_role_runs_without_what_was_refused(bench, make, refused, capfd, role):
    member, node = ROSTER[role], make(role)
    if member.has_codebook:
        node._on_codebook(Codebook.load(default_codebook_file()))
    if role == 'positioner':
        bench.until(lambda: topics.NAMES[m.ReceivedSignals] in refused, 'the estimator')
        assert node.publish(ESTIMATE)
    if role == 'user':
        node._publish_ground_truth()
    bench.spin_once()
    # Only tracks have odometry.
    assert {*member.sent, *member.received} - {topics.ODOMETRY} <= {
        name.replace('user_1', 'user_{user}') for name in refused}
    texts = endpoints.refusals(node)
    assert {text.partition(' was refused: ')[2] for text in texts.values()} == {
        f'{name} not found in allow rule' for name in refused}
    report = (node._report if role == topics.OPTIMIZER_NODE else node.report)()
    assert report.fault
    assert {*texts.values()} <= {*report.values.values()}
    assert capfd.readouterr().err.count('was refused') == len(texts)


@pytest.mark.parametrize('role', [*sorted(ROSTER), 'visualizer'])
def test_a_role_runs_without_timers(bench, make, no_timers, role):
    node = make(role)
    if role in ROSTER and ROSTER[role].has_codebook:
        node._on_codebook(Codebook.load(default_codebook_file()))
    if role == 'user':
        node.dispatch(m.Beacon(cycle_id=1, attempt=1, sender=1))
    bench.spin_once()
    texts = {*endpoints.refusals(node).values()}
    assert texts
    assert all(text.endswith(' s was refused: no memory') for text in texts)


def test_a_simulation_whose_time_was_refused_is_not_used(bench, make, refused):
    node = make('bs')
    result = node.set_parameters_atomically([Parameter('use_sim_time', value=True)])
    assert (result.successful, result.reason) == (
        False, 'subscription to /clock was refused: /clock not found in allow rule')
    assert not node.get_clock().ros_time_is_active
    assert not node.get_parameter('use_sim_time').value


def test_the_visualizer_runs_without_what_was_refused(make, refused):
    node = make('visualizer')
    node._on_message(ESTIMATE)
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
