"""Transforms of the surface and of the users."""

import functools
import importlib.util
import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rclpy.parameter import Parameter
from rclpy.time import Time as RosTime

from rhs_isac_ros.nodes.visualizer import VisualizerNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics, transforms
from rhs_isac_ros.ros.frames import Frame

HAS_TF2 = importlib.util.find_spec('tf2_msgs') is not None


def test_the_surface_is_at_the_origin_of_the_map():
    transform = transforms.surface(Frame(), Time(sec=3))
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'rhs_link')
    assert transform.header.stamp.sec == 3
    assert [getattr(transform.transform.translation, axis) for axis in 'xyz'] == [0.0] * 3
    assert transform.transform.rotation.w == 1.0


def test_a_user_is_at_its_estimate():
    transform = transforms.user(Frame(), 7, np.array([9.0, -1.5, 0.25]), Time(sec=4))
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'user_7')
    assert [getattr(transform.transform.translation, axis) for axis in 'xyz'] == [9.0, -1.5, 0.25]
    assert [getattr(transform.transform.rotation, axis) for axis in 'xyzw'] == [0.0, 0.0, 0.0, 1.0]


def test_two_networks_have_frames_of_their_own():
    frames = [Frame('odom', prefix=f'{space}/') for space in ('left', 'right')]
    children = [transform.child_frame_id for frame in frames for transform in (
        transforms.surface(frame, Time()), transforms.user(frame, 1, np.zeros(3), Time()))]
    assert children == ['left/rhs_link', 'left/user_1', 'right/rhs_link', 'right/user_1']


@pytest.mark.skipif(HAS_TF2, reason='tf2_msgs is installed')
def test_without_tf2_msgs_the_visualizer_logs_one_line(bench, probe, capfd):
    bench.add(VisualizerNode)
    assert capfd.readouterr().err.count(
        'no transforms, because tf2_msgs is not installed') == 1
    assert probe.count_publishers(topics.TF) == probe.count_publishers(topics.TF_STATIC) == 0


@pytest.mark.skipif(not HAS_TF2, reason='tf2_msgs is not installed')
def test_the_visualizer_publishes_transforms(bench, probe):
    from tf2_msgs.msg import TFMessage
    bench.add(VisualizerNode)
    found = {}

    def store(message):
        found.update({one.child_frame_id: one.transform.translation for one in message.transforms})
    probe.create_subscription(TFMessage, topics.TF_STATIC, store, qos.LATCHED)
    probe.create_subscription(TFMessage, topics.TF, store, qos.EXCHANGE)
    bench.until(lambda: topics.RHS_FRAME in found, 'the surface')
    bench.until(lambda: probe.count_publishers(topics.TF), 'the publisher')
    estimates = bench.publisher(probe, m.PositionEstimate)
    estimate = convert.to_ros(m.PositionEstimate(
        cycle_id=1, user=2, codebook_id='cb', position=np.array([8.0, 2.5, 0.1]),
        covariance_m2=np.eye(3), crlb_m2=0.1, estimator='bayes', latency_s=0.01), Time())
    probe.create_timer(0.05, lambda: estimates.publish(estimate))
    bench.until(lambda: 'user_2' in found, 'the user')
    assert found['user_2'].y == 2.5


@pytest.mark.skipif(not HAS_TF2, reason='tf2_msgs is not installed')
def test_two_networks_share_one_tree(bench, probe):
    tf2_ros = pytest.importorskip('tf2_ros')
    buffer = tf2_ros.Buffer(node=probe)
    # It subscribes as long as it exists.
    listener = tf2_ros.TransformListener(buffer, probe)
    poses = {'left': [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
             'right': [0.0, 4.0, 0.0, 0.0, 0.0, -math.pi / 2]}
    for space, pose in poses.items():
        bench.add(VisualizerNode, namespace=f'/{space}', parameter_overrides=[
            Parameter('frame_id', value='odom'), Parameter('surface_pose', value=pose)])
        estimates = probe.create_publisher(
            convert.ros_type(m.PositionEstimate), f'/{space}/position_estimate', qos.EXCHANGE)
        estimate = convert.to_ros(m.PositionEstimate(
            cycle_id=1, user=2, codebook_id='cb', position=np.array([8.0, 2.5, 0.1]),
            covariance_m2=np.eye(3), crlb_m2=0.1, estimator='bayes', latency_s=0.01), Time())
        probe.create_timer(0.05, functools.partial(estimates.publish, estimate))
    for space, place in (('left', [9.0, 2.5, 0.1]), ('right', [2.5, -4.0, 0.1])):
        bench.until(lambda space=space: buffer.can_transform(
            'odom', f'{space}/user_2', RosTime()), f'the user of {space}')
        found = buffer.lookup_transform('odom', f'{space}/user_2', RosTime())
        moved = found.transform.translation
        np.testing.assert_allclose([moved.x, moved.y, moved.z], place, atol=1e-9)
        assert buffer.can_transform('odom', f'{space}/rhs_link', RosTime())
    assert listener
