"""A robot as a user, in the frame of the robot and in the time of its simulation.

All nodes of the network are in one process, and the elements of the surface resonate.
"""

import math
import time
import types

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.action.client import ActionClient
from rclpy.clock import Clock, ClockType
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage

from rhs_isac_msgs.action import Locate
from rhs_isac_ros.model import Pose
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import EXCHANGE

# The surface is turned by 90 degrees about z, and moved.
TURNED = Pose((1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 1.0))
SCENARIO = 'pose: {position_m: [1, 2, 3], quaternion: [0, 0, 1, 1]}\nboard: resonant'
# Begin of the simulation, far from the time of the computer [s], and its pace, which is slow, so
# that a busy machine delays the robot little.
BEGIN_S, PACE = 1000.0, 0.2
CENTER, RADIUS_M, TURN_RATE = np.array([9.0, 0.0, 0.0]), 1.0, 0.5
SPEED_MPS = RADIUS_M * TURN_RATE
ROBOT_TIMEOUT_S = 5.0


class Robot:
    """Drives on a circle in front of the surface; publishes odometry at 20 Hz, and ``/clock``."""

    def __init__(self, node):
        self._begin_s = time.monotonic()
        self._odometry = node.create_publisher(Odometry, 'odom', 10)
        self._clock = node.create_publisher(ClockMessage, '/clock', 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.drives = False
        node.create_timer(0.01, self._publish_clock, clock=steady)
        node.create_timer(0.05, self._publish_odometry, clock=steady)

    @staticmethod
    def place(now_s):
        """Return the position in the site, and the angle on the circle before the surface."""
        angle = TURN_RATE * now_s
        return TURNED.to_site(
            CENTER + RADIUS_M * np.array([math.cos(angle), math.sin(angle), 0.0])), angle

    def _now_s(self):
        return BEGIN_S + PACE * (time.monotonic() - self._begin_s)

    def _publish_clock(self):
        now = Time(nanoseconds=int(1e9 * self._now_s()))
        self._clock.publish(ClockMessage(clock=now.to_msg()))

    def _publish_odometry(self):
        if not self.drives:
            return
        now_s = self._now_s()
        place, angle = self.place(now_s)
        message = Odometry()
        message.header.stamp = Time(nanoseconds=int(1e9 * now_s)).to_msg()
        message.header.frame_id, message.child_frame_id = 'odom', 'base_link'
        point = message.pose.pose.position
        point.x, point.y, point.z = place.tolist()
        # The robot looks ahead: along the tangent, which the surface turns by another 90 degrees.
        heading = angle + math.pi
        turn = message.pose.pose.orientation
        turn.z, turn.w = math.sin(heading / 2), math.cos(heading / 2)
        message.twist.twist.linear.x = SPEED_MPS
        self._odometry.publish(message)


@pytest.fixture(scope='module')
def driven(module_processes, make_watch, tmp_path_factory):
    """A network with a user of its own and a robot, in a simulation."""
    space = '/yard'
    file = tmp_path_factory.mktemp('yard') / 'scenario.yaml'
    file.write_text(SCENARIO, encoding='utf-8')
    way = TURNED.to_site(np.array([[8.0, -4.0, 0.0], [8.0, 4.0, 0.0]]))
    watch = make_watch(space)
    robot = Robot(watch.node)
    poses, reports = [], []
    watch.node.create_subscription(
        PoseWithCovarianceStamped, topics.POSE.format(user=2), poses.append, EXCHANGE)
    watch.node.create_subscription(
        DiagnosticArray, topics.DIAGNOSTICS, reports.append, EXCHANGE)
    common = {'namespace': space, 'use_sim_time': True, 'frame_id': 'odom', 'scenario_file': file}
    running = [
        module_processes.start(
            'network', users=1, rest_s=0.1, mobility='waypoints', speed_mps=1.0,
            ground_truth_period_s=0.01, waypoints_m=way.ravel().tolist(), **common),
        module_processes.start(
            'user', name='user_2', user_id=2, mobility='odometry',
            robot_timeout_s=ROBOT_TIMEOUT_S, **common)]
    return types.SimpleNamespace(
        watch=watch, robot=robot, poses=poses, reports=reports, running=running)


def test_a_robot_is_served_where_it_is(driven):
    watch = driven.watch
    # Until odometry arrives, the user names what is missing and answers no beacon.
    watch.until(lambda: any(
        'user_2' in status.name and 'odometry on /yard/odom' in status.message
        for report in driven.reports for status in report.status), 'the reason', driven.running)
    watch.until_served(1, 1, driven.running)
    assert {end.user for end in watch.served} == {1}
    driven.robot.drives = True
    ends = watch.until_served(6, 2, driven.running)
    for end in ends:
        # On a busy machine, messages of a cycle are repeated.
        truth, estimate = (watch.until(
            lambda kind=kind, n=end.cycle_id: watch.of_cycle(kind, n), kind.__name__)[0]
            for kind in (m.GroundTruth, m.PositionEstimate))
        assert BEGIN_S < 1e-9 * estimate.stamp_ns < 1e6
        assert_follows_odometry(truth)
        pose = watch.until(lambda found=estimate: pose_of(driven.poses, found), 'the pose')
        assert pose.header.frame_id == 'odom'
        assert_at(pose, estimate)


def assert_follows_odometry(truth):
    """The user goes on from the position of a message of odometry, at its velocity."""
    assert np.linalg.norm(truth.velocity) == pytest.approx(SPEED_MPS)
    ahead = TURNED.vectors_to_surface(truth.velocity) / SPEED_MPS
    origin = TURNED.to_site(CENTER + RADIUS_M * np.array([ahead[1], -ahead[0], 0.0]))
    moved = TURNED.vectors_to_surface(truth.position - origin)
    assert np.cross(moved, ahead) == pytest.approx(0, abs=1e-6)
    assert -1e-6 < moved @ ahead < ROBOT_TIMEOUT_S * SPEED_MPS


def pose_of(poses, estimate):
    """Return the pose of an estimate, or None.

    It has the stamp of the estimate. A slow clock may give several estimates the same stamp, of
    which it is then the nearest.
    """
    found = [pose for pose in poses
             if Time.from_msg(pose.header.stamp).nanoseconds == estimate.stamp_ns]
    return min(found, default=None, key=lambda pose: np.linalg.norm(
        place_of(pose) - estimate.position))


def place_of(pose):
    point = pose.pose.pose.position
    return np.array([point.x, point.y, point.z])


def assert_at(pose, estimate):
    assert estimate.position[1] > TURNED.origin[1]
    np.testing.assert_array_equal(place_of(pose), estimate.position)
    np.testing.assert_array_equal(
        np.reshape(pose.pose.covariance, (6, 6))[:3, :3], estimate.covariance_m2)


def test_a_mobility_moves_with_the_clock_of_the_simulation(driven):
    watch = driven.watch

    def speeds():
        truths = [truth for truth in watch.received[m.GroundTruth]
                  if truth.user == 1 and not truth.cycle_id]
        return [np.linalg.norm(after.position - before.position)
                / (1e-9 * (after.stamp_ns - before.stamp_ns))
                for before, after in zip(truths[:-5], truths[5:], strict=True)
                if after.stamp_ns > before.stamp_ns]
    assert np.median(watch.until(lambda: (found := speeds())[40:] and found, 'the truths',
                                 driven.running)) == pytest.approx(1.0, rel=0.05)


def test_an_action_returns_the_position_of_each_user(driven):
    watch = driven.watch
    driven.robot.drives = True
    client = ActionClient(watch.node, Locate, topics.LOCATE)
    watch.until(client.server_is_ready, 'the action', driven.running)
    sent = {user: client.send_goal_async(Locate.Goal(user=user, timeout_s=60.0))
            for user in (1, 2)}
    watch.until(lambda: all(future.done() for future in sent.values()), 'the goals')
    results = {user: future.result().get_result_async() for user, future in sent.items()}
    for user in (1, 2):
        found = watch.until(lambda user=user: results[user].done() and results[user].result(),
                            f'the position of user {user}', driven.running)
        assert found.status == GoalStatus.STATUS_SUCCEEDED, found.result.reason
        assert found.result.pose.header.frame_id == 'odom'
        estimate = watch.until(lambda n=found.result.cycle_id: watch.of_cycle(
            m.PositionEstimate, n), 'the estimate')[0]
        assert estimate.user == user
        assert Time.from_msg(found.result.pose.header.stamp).nanoseconds == estimate.stamp_ns
        assert_at(found.result.pose, estimate)
    client.destroy()
