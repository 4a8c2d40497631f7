import sys
import types
from unittest import mock

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node as Node_

from rhs_isac_ros.model import Pose
from rhs_isac_ros.nodes import user
from rhs_isac_ros.nodes.user import RobotMobility, follow_frame, follow_odometry
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import refusals
from rhs_isac_ros.support.fields import ParameterError

# Turned by 90 degrees about z, and moved.
TURNED = Pose((1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 1.0))


class Clock:
    nanoseconds = 10 * 10**9

    def now(self):
        return self


class Node:
    def get_clock(self):
        return Clock()


def robot():
    return RobotMobility(Node(), TURNED, 'odometry on /odom', 1.0)


def test_a_robot_without_a_position_is_lacking():
    mobility = robot()
    assert mobility.lack == 'odometry on /odom'
    mobility.reject('in the frame')
    assert mobility.lack == 'odometry on /odom: in the frame'


def test_a_robot_is_continued_with_its_velocity():
    mobility = robot()
    mobility.put(Clock.nanoseconds - 10**8, np.array([2.0, 6.0, 3.5]), np.array([0.0, 1.0, 0.0]))
    assert mobility.lack == ''
    position, velocity = mobility.state(0.0)
    np.testing.assert_allclose(position, [4.1, -1.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(velocity, [1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize('velocity', [3e8, -1e300, np.nan, np.inf])
def test_a_velocity_that_no_message_may_have_is_named(velocity):
    mobility = robot()
    mobility.put(0, np.array([2.0, 6.0, 3.5]), np.array([0.0, velocity, 0.0]))
    assert f'velocity [0.0, {velocity}, 0.0] m/s, expected' in mobility.lack
    assert np.isnan(mobility.state(0.0)[0]).all()
    mobility.put(0, np.array([2.0, 6.0, 3.5]), np.array([0.0, 2.9e8, 0.0]))
    assert 'velocity' not in mobility.lack


@pytest.mark.parametrize(('stamp_ns', 'position', 'words'), [
    (10**9, [2.0, 6.0, 3.5], 'use_sim_time'), (0, [2.0, -6.0, 3.5], 'in front of the surface'),
    (0, [2.0, np.nan, 3.5], 'position [2.0, nan, 3.5] m, velocity [0.0, 0.0, 0.0] m/s, expected '
     'finite numbers'),
    (0, [2.0, 5e-324, 3.5], 'position: 4.94066e-324, which is how Python sends an integer'),
    (0, [2.0, 2e6, 3.5], '2e+06 m from the surface, expected coordinates up to 1e+06 m')])
def test_a_position_that_cannot_be_used_is_named(stamp_ns, position, words):
    mobility = robot()
    mobility.put(stamp_ns, np.array(position), np.zeros(3))
    assert words in mobility.lack


def test_positions_with_the_stamps_of_two_clocks_come_from_two_sources(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(user, 'time', types.SimpleNamespace(monotonic=lambda: now_s))
    mobility, lacks = robot(), []
    for number in range(40):
        now_s += 0.05
        mobility.put(Clock.nanoseconds - 6 * 10**9 * (number % 2), np.array([2.0, 6.0, 3.5]),
                     np.zeros(3))
        lacks.append(mobility.lack)
    assert set(lacks[1:]) == {'odometry on /odom: from two sources, expected one'}
    # One of them has gone.
    now_s += 2.0
    mobility.put(Clock.nanoseconds, np.array([2.0, 6.0, 3.5]), np.zeros(3))
    assert mobility.lack == ''


def test_positions_in_two_frames_come_from_two_sources():
    mobility = robot()
    mobility.put(0, np.array([2.0, 6.0, 3.5]), np.zeros(3))
    mobility.reject('in the frame', 'other')
    assert mobility.lack == 'odometry on /odom: from two sources, expected one'


def test_odometry_is_read_in_the_frame_of_the_robot(bench):
    node = bench.add(Node_, 'robot_user')
    publisher = bench.add(Node_, 'robot').create_publisher(Odometry, 'odom', 10)
    mobility = follow_odometry(node, 'map', Pose(), 'odom', 60.0)
    message = Odometry()
    message.header.frame_id = topics.MAP_FRAME
    message.pose.pose.position.x = 5.0
    message.pose.pose.orientation.w = 0.0
    message.twist.twist.linear.x = 2.0

    def lack():
        publisher.publish(message)
        return mobility.lack
    bench.until(lambda: lack().endswith(
        ': orientation: quaternion: [0.0, 0.0, 0.0, 0.0], expected finite numbers and a length '
        'other than 0'), 'the reason')
    # Of any length but 0, also where squares are 0.
    message.pose.pose.orientation.z = message.pose.pose.orientation.w = 1e-200
    bench.until(lambda: not lack(), 'the odometry')
    np.testing.assert_allclose(mobility.state(0.0)[1], [0.0, 2.0, 0.0], atol=1e-12)


@pytest.mark.parametrize('second', [-2**31, -1, 2**31 - 1])
def test_odometry_with_any_stamp_is_compared_with_the_clock(bench, second):
    node = bench.add(Node_, 'robot_user')
    publisher = bench.add(Node_, 'robot').create_publisher(Odometry, 'odom', 10)
    mobility = follow_odometry(node, 'map', Pose(), 'odom', 60.0)
    message = Odometry()
    message.header.frame_id, message.header.stamp.sec = topics.MAP_FRAME, second
    message.header.stamp.nanosec = 999_999_999

    def lack():
        publisher.publish(message)
        return mobility.lack
    bench.until(lambda: 'its stamps differ from the clock of this node' in lack(), 'the reason')


@pytest.mark.parametrize('refused', ['Buffer', 'TransformListener'])
def test_transforms_that_were_refused_are_lacking(bench, monkeypatch, refused):
    def refuse(*_, **__):
        raise rclpy_implementation.RCLError('rt/tf topic not found in allow rule')
    monkeypatch.setitem(sys.modules, 'tf2_ros', types.SimpleNamespace(**{
        'Buffer': Buffer, 'TransformListener': mock.Mock(), refused: refuse}))
    node = bench.add(Node_, 'robot_user')
    mobility = follow_frame(node, 'map', Pose(), 'base_link', 1.0)
    bench.until(lambda: [*node.timers], 'the timer')
    bench.spin_once()
    assert mobility.lack == 'transform from map to base_link'
    assert '/tf was refused: rt/tf' in ''.join(refusals(node).values())


class Buffer:
    """The part of tf2_ros.Buffer that a robot uses, which has no wheel; tf2_ros itself is tested
    in test/nodes/test_robot_example.py."""

    latest = None

    def __init__(self, cache_time=None, node=None):
        Buffer.last = self

    def can_transform(self, target_frame, source_frame, time):
        return self.latest is not None and (target_frame, source_frame) == ('map', 'base_link')

    def lookup_transform(self, target_frame, source_frame, time):
        assert self.can_transform(target_frame, source_frame, time)
        return self.latest

    def put(self, nanoseconds, x):
        self.latest = TransformStamped()
        self.latest.header.stamp.sec, self.latest.header.stamp.nanosec = divmod(
            nanoseconds, 10**9)
        self.latest.transform.translation.x = x


def test_a_frame_is_followed_with_the_velocity_between_two_transforms(bench, monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_ros', types.SimpleNamespace(
        Buffer=Buffer, TransformListener=lambda buffer, node: object()))
    node = bench.add(Node_, 'robot_user')
    mobility = follow_frame(node, 'map', Pose(), 'base_link', 60.0)
    assert mobility.lack == 'transform from map to base_link'
    begin_ns = node.get_clock().now().nanoseconds
    Buffer.last.put(begin_ns, 5.0)
    bench.until(lambda: not mobility.lack, 'the position')
    assert mobility.state(0.0)[1].tolist() == [0.0, 0.0, 0.0]
    Buffer.last.put(begin_ns + 10**9 // 2, 6.0)
    bench.until(lambda: mobility.state(0.0)[1].any(), 'the velocity')
    np.testing.assert_allclose(mobility.state(0.0)[1], [2.0, 0.0, 0.0], atol=1e-9)


def test_a_frame_needs_tf2_ros(monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)
    with pytest.raises(ParameterError, match="mobility: 'tf', .* tf2_ros is not installed"):
        follow_frame(Node(), 'map', Pose(), 'base_link', 1.0)
