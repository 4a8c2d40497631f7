"""The action ``locate``, called by a client, during the messages of a cycle."""

import time
import types

import numpy as np
import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from builtin_interfaces.msg import Time
from rclpy.action.client import ActionClient
from rclpy.node import Node
from ros_messages import position_estimate

from rhs_isac_msgs.action import Locate
from rhs_isac_ros.nodes import bs
from rhs_isac_ros.nodes.bs import LocateServer
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, endpoints
from rhs_isac_ros.ros.endpoints import LATCHED
from rhs_isac_ros.ros.topics import LOCATE, Frame

PHASES = (m.Phase.POSITIONING, m.Phase.ESTIMATING)
FRAME = Frame('odom')


def state(user, phase, outcome='', cycle_id=7):
    return m.ProtocolState(cycle_id=cycle_id, user=user, phase=phase, outcome=outcome,
                           began_s=np.zeros(len(m.Phase)), elapsed_s=0.0)


def estimate(user, cycle_id=7):
    return position_estimate(user, [9.0, user, 0.0], cycle_id=cycle_id)


@pytest.fixture
def action(bench, request):
    """The action, the users it requested, and a function that sends a goal."""
    requested = []
    server = LocateServer(
        bench.add(Node, 'bs'), requested.append,
        lambda found: convert.pose(found, Time(sec=4), FRAME), max_users=8,
        max_goals=getattr(request, 'param', 100))
    client = ActionClient(bench.add(Node, 'client'), Locate, LOCATE)
    bench.until(client.server_is_ready, 'the action')

    def send(user, timeout_s=60.0):
        goal = types.SimpleNamespace(feedback=[])
        goal.handle = bench.result(client.send_goal_async(
            Locate.Goal(user=user, timeout_s=timeout_s),
            lambda message: goal.feedback.append(
                (message.feedback.phase, message.feedback.cycle_id))))
        if goal.handle.accepted:
            goal.result = goal.handle.get_result_async()
            bench.until(lambda: user in requested and goal.feedback, 'the begin of the goal')
        return goal
    yield types.SimpleNamespace(server=server, client=client, requested=requested, send=send)
    client.destroy()
    server.destroy()


def finish(bench, goal, status):
    found = bench.result(goal.result)
    assert found.status == status
    return found.result


def test_the_position_arrives_after_the_feedback_of_each_phase(bench, action):
    goal = action.send(1)
    for phase in PHASES:
        action.server.observe(state(1, phase))
    bench.until(lambda: len(goal.feedback) == 3, 'the feedback')
    action.server.observe(estimate(1))
    result = finish(bench, goal, GoalStatus.STATUS_SUCCEEDED)
    assert goal.feedback == [(m.Phase.BEACONING, 0), *((phase, 7) for phase in PHASES)]
    assert (result.cycle_id, result.reason) == (7, '')
    assert (result.pose.header.frame_id, result.pose.header.stamp.sec) == ('odom', 4)
    assert (result.pose.pose.pose.position.x, result.pose.pose.pose.position.y) == (9.0, 1.0)


@pytest.mark.parametrize('phases', [PHASES[:n] for n in range(3)])
def test_a_goal_can_be_cancelled_in_each_phase(bench, action, phases):
    goal = action.send(1)
    for phase in phases:
        action.server.observe(state(1, phase))
    response = bench.result(goal.handle.cancel_goal_async())
    assert len(response.goals_canceling) == 1
    result = finish(bench, goal, GoalStatus.STATUS_CANCELED)
    assert (result.cycle_id, result.reason) == (0, 'canceled')
    # The position arrives too late.
    action.server.observe(estimate(1))


def test_a_cycle_that_began_before_the_goal_does_not_end_it(bench, action):
    goal = action.send(1)
    action.server.observe(state(1, m.Phase.ESTIMATING))
    action.server.observe(estimate(1))
    action.server.observe(state(1, m.Phase.POSITIONING, cycle_id=8))
    action.server.observe(estimate(1, cycle_id=8))
    assert finish(bench, goal, GoalStatus.STATUS_SUCCEEDED).cycle_id == 8


def test_after_a_lost_cycle_the_user_is_requested_again(bench, action):
    goal = action.send(1)
    action.server.observe(state(1, m.Phase.POSITIONING))
    action.server.observe(state(1, m.Phase.BEACONING, 'rhs_silent'))
    assert action.requested == [1, 1]
    bench.until(lambda: goal.feedback[-1:] == [(m.Phase.BEACONING, 0)] and len(goal.feedback) == 3,
                'the feedback')


def test_signals_without_a_position_abort_the_goal(bench, action):
    goal = action.send(1)
    action.server.observe(state(1, m.Phase.POSITIONING))
    action.server.observe(m.NoFix(cycle_id=7, user=1, codebook_id='a', reason='outside'))
    assert finish(bench, goal, GoalStatus.STATUS_ABORTED).reason == 'no fix: outside'


def test_a_goal_ends_after_its_timeout(bench, action):
    assert finish(bench, action.send(1, 0.05), GoalStatus.STATUS_ABORTED).reason == (
        'user 1 has answered no beacon within 0.05 s')
    goal = action.send(1, 60.0)
    action.server.observe(m.Ack(cycle_id=7, user=1))
    (timer,) = action.server._node.timers
    endpoints.set_period(timer, 1e-3)
    assert finish(bench, goal, GoalStatus.STATUS_ABORTED).reason == 'no position within 60 s'


def test_results_are_kept_for_a_short_time(bench, request, monkeypatch):
    """Each status message lists all of them, so that many goals would cost more and more."""
    monkeypatch.setattr(bs, '_RESULT_S', 0.2)
    action, lists = request.getfixturevalue('action'), []
    bench.add(Node, 'probe').create_subscription(
        GoalStatusArray, f'{LOCATE}/_action/status', lambda found: lists.append(
            len(found.status_list)), LATCHED)

    for _ in range(2):
        before = len(lists)
        action.send(1, 0.05)
        bench.until(lambda before=before: len(lists) > before, 'the status of the goal')
        bench.until(lambda: not action.server._server._goal_handles, 'the end of its result')
    assert max(lists) == 1


@pytest.mark.parametrize('action', [3], indirect=True)
def test_the_number_of_goals_and_of_timers_is_limited(bench, action):
    node = action.server._node
    for _ in range(2):
        goals = [action.send(1) for _ in range(3)]
        assert not action.send(1).handle.accepted
        for goal in goals:
            bench.result(goal.handle.cancel_goal_async())
            finish(bench, goal, GoalStatus.STATUS_CANCELED)
        bench.until(lambda: not [*node.timers], 'no timers')


@pytest.mark.parametrize('n_clients', [1, 20])
@pytest.mark.parametrize('action', [40], indirect=True)
def test_each_of_many_goals_at_once_is_accepted_or_refused(bench, action, n_clients):
    node = bench.add(Node, 'clients')
    # Each client receives the answers to all others.
    clients = [ActionClient(node, Locate, LOCATE, goal_service_qos_profile=endpoints.SERVICES)
               for _ in range(n_clients)]
    bench.until(lambda: all(client.server_is_ready() for client in clients), 'the action')
    sent = [clients[n % n_clients].send_goal_async(Locate.Goal(user=1, timeout_s=60.0))
            for n in range(50)]
    bench.until(lambda: all(future.done() for future in sent), 'the answers')
    assert sum(future.result().accepted for future in sent) == 40
    for client in clients:
        client.destroy()


@pytest.mark.parametrize(('n_clients', 'interval_s'), [(1, bs._ANSWER_S), (5, 5 * 0.01)])
def test_answers_to_many_goals_leave_clients_in_one_process_the_time_to_take_them(
        bench, action, monkeypatch, n_clients, interval_s):
    """By default, the queue of a client holds ten answers."""
    monkeypatch.setattr(bs, '_ANSWER_PER_CLIENT_S', interval_s / n_clients)
    node = bench.add(Node, 'eager')
    clients = [ActionClient(node, Locate, LOCATE) for _ in range(n_clients)]
    topic = f'/{LOCATE}/_action/feedback'
    bench.until(lambda: action.server._node.count_subscribers(topic) >= n_clients, 'the clients')
    begin_s = time.monotonic()
    sent = [clients[n % n_clients].send_goal_async(Locate.Goal(user=1, timeout_s=60.0))
            for n in range(12)]
    bench.until(lambda: all(future.done() for future in sent), 'the answers')
    assert time.monotonic() >= begin_s + 10 * interval_s
    for client in clients:
        client.destroy()


def test_a_goal_ends_with_the_action(bench, action):
    goal = action.send(1)
    action.server.destroy(60.0)
    assert 'stands by' in finish(bench, goal, GoalStatus.STATUS_ABORTED).reason


def test_an_action_that_is_to_be_withdrawn_later_ends_with_its_node(bench, action):
    action.server.destroy(3600.0)
    assert action.client.server_is_ready()
    action.server.destroy()
    bench.until(lambda: not action.client.server_is_ready(), 'the end of the action')


@pytest.mark.parametrize(('user', 'timeout_s'), [
    (0, 1.0), (9, 1.0), (1, -1.0), (1, np.nan), (1, 5e-324)])
def test_an_invalid_goal_is_rejected(action, user, timeout_s):
    assert not action.send(user, timeout_s).handle.accepted
    assert not action.requested
