"""Transforms of the surface and of the users."""

import importlib.util

import numpy as np
import pytest
from builtin_interfaces.msg import Time

from rhs_isac_ros.nodes.visualizer import VisualizerNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, scene, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED
from rhs_isac_ros.ros.frames import Frame

HAS_TF2 = importlib.util.find_spec('tf2_msgs') is not None


def test_the_surface_is_at_the_origin_of_the_map():
    transform = scene.surface_transform(Frame(), Time(sec=3))
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'rhs_link')
    assert transform.header.stamp.sec == 3
    assert [getattr(transform.transform.translation, axis) for axis in 'xyz'] == [0.0] * 3
    assert transform.transform.rotation.w == 1.0


def test_a_user_is_at_its_estimate():
    transform = scene.user_transform(Frame(), 7, np.array([9.0, -1.5, 0.25]), Time(sec=4))
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'user_7')
    assert [getattr(transform.transform.translation, axis) for axis in 'xyz'] == [9.0, -1.5, 0.25]
    assert [getattr(transform.transform.rotation, axis) for axis in 'xyzw'] == [0.0, 0.0, 0.0, 1.0]


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
    probe.create_subscription(TFMessage, topics.TF_STATIC, store, LATCHED)
    probe.create_subscription(TFMessage, topics.TF, store, EXCHANGE)
    bench.until(lambda: topics.RHS_FRAME in found, 'the surface')
    bench.until(lambda: probe.count_publishers(topics.TF), 'the publisher')
    estimates = bench.publisher(probe, m.PositionEstimate)
    estimate = convert.to_ros(m.PositionEstimate(
        cycle_id=1, user=2, codebook_id='cb', position=np.array([8.0, 2.5, 0.1]),
        covariance_m2=np.eye(3), crlb_m2=0.1, estimator='bayes', latency_s=0.01), Time())
    probe.create_timer(0.05, lambda: estimates.publish(estimate))
    bench.until(lambda: 'user_2' in found, 'the user')
    assert found['user_2'].y == 2.5
