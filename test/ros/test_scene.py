"""Markers of the scene, and transforms of the surface and of the users."""

import dataclasses
import functools
import importlib.util
import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rclpy.parameter import Parameter
from rclpy.time import Time as RosTime
from visualization_msgs.msg import Marker

from rhs_isac_ros.link import beam_pattern, steer
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.nodes.visualizer import VisualizerNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, scene, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED
from rhs_isac_ros.ros.frames import Frame

STAMP = Time(sec=3)
# From a table of the chi-square distribution with three degrees of freedom.
CHI_SQUARE_95 = 7.815


def of(vector):
    return np.array([vector.x, vector.y, vector.z])


def rotation(q):
    """Return the rotation matrix of a unit quaternion."""
    return np.array([
        [1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y - q.z * q.w), 2 * (q.x * q.z + q.y * q.w)],
        [2 * (q.x * q.y + q.z * q.w), 1 - 2 * (q.x**2 + q.z**2), 2 * (q.y * q.z - q.x * q.w)],
        [2 * (q.x * q.z - q.y * q.w), 2 * (q.y * q.z + q.x * q.w), 1 - 2 * (q.x**2 + q.y**2)]])


def an_estimate(covariance_m2, user=1):
    return m.PositionEstimate(
        cycle_id=5, user=user, codebook_id='cb', position=np.array([9.0, -1.0, 0.5]),
        covariance_m2=covariance_m2, crlb_m2=0.1, estimator='bayes', latency_s=0.01)


@pytest.mark.parametrize('seed', range(4))
def test_the_ellipsoid_is_that_of_the_covariance(seed):
    root = np.random.default_rng(seed).normal(size=(3, 3))
    marker = scene.estimate(an_estimate(root @ root.T), STAMP)
    assert marker.type == Marker.SPHERE
    assert of(marker.pose.position) == pytest.approx([9.0, -1.0, 0.5])
    turn = rotation(marker.pose.orientation)
    assert np.linalg.det(turn) == pytest.approx(1)
    radii = of(marker.scale) / 2
    assert turn @ np.diag(radii**2) @ turn.T == pytest.approx(
        CHI_SQUARE_95 * root @ root.T, rel=1e-3, abs=1e-3)


def test_a_position_without_variance_is_visible():
    marker = scene.estimate(an_estimate(np.zeros((3, 3))), STAMP)
    assert of(marker.scale).min() > 0


def test_each_user_has_one_hue_for_truth_and_estimate():
    hues = {}
    for user in (1, 2, 2**32 - 1):
        position = np.array([user % 7, 0.0, 0.0], float)
        one = scene.truth(m.GroundTruth(
            cycle_id=0, user=user, position=position, velocity=np.zeros(3)), STAMP)
        other = scene.estimate(an_estimate(np.eye(3), user), STAMP)
        assert of(one.pose.position) == pytest.approx(position)
        assert (one.ns, one.id) != (other.ns, other.id)
        assert (one.color.r, one.color.g, one.color.b) == (
            other.color.r, other.color.g, other.color.b)
        assert one.color.a == 1 > other.color.a > 0
        hues[one.color.r, one.color.g, one.color.b] = one
    assert len(hues) == 3


def test_the_board_shows_its_configuration(small):
    configuration = np.linspace(0, 1, 2 * small.scenario.n_elements).reshape(2, -1)
    marker = scene.board(small.scenario, configuration, STAMP)
    assert np.array([of(point) for point in marker.points]) == pytest.approx(
        element_positions(small.scenario))
    assert [color.r for color in marker.colors] == pytest.approx(configuration.mean(axis=0))
    places = np.unique(element_positions(small.scenario)[:, 1])
    assert 0 < marker.scale.y == marker.scale.z < np.diff(places).min()
    unknown = scene.board(small.scenario, None, STAMP)
    assert len({color.r for color in unknown.colors}) == 1


def test_a_flat_region_is_visible(small):
    flat = dataclasses.replace(small.scenario, roi_size_m=(4.0, 3.0, 0.0))
    scale = of(scene.region(flat, STAMP).scale)
    assert scale[:2].tolist() == [4.0, 3.0]
    assert 0 < scale[2] < 0.01


def test_the_region_has_the_bounds_of_the_scenario(small):
    marker = scene.region(small.scenario, STAMP)
    low, high = small.scenario.roi_bounds_m
    assert of(marker.pose.position) - of(marker.scale) / 2 == pytest.approx(low)
    assert of(marker.pose.position) + of(marker.scale) / 2 == pytest.approx(high)
    assert (marker.header.frame_id, marker.header.stamp) == ('rhs_link', STAMP)
    assert marker.pose.orientation.w == 1


def test_the_beam_points_to_its_user_and_its_triangles_look_outward():
    scenario, place = Scenario(), np.array([9.0, 3.0, 0.3])
    found = beam_pattern(scenario, steer(scenario, place), 10.0)
    marker = scene.beam(found, 3, STAMP)
    corners = np.array([of(point) for point in marker.points]).reshape(-1, 3, 3)
    assert (marker.type, marker.header.frame_id) == (Marker.TRIANGLE_LIST, 'rhs_link')
    lengths = np.linalg.norm(corners, axis=-1)
    assert lengths.max() == pytest.approx(10.0)
    tip = corners.reshape(-1, 3)[lengths.argmax()] / 10.0
    assert np.degrees(np.arccos(tip @ place / np.linalg.norm(place))) < 8.0
    assert corners[..., 0].min() >= -1e-9
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum('nu,nu->n', normals, corners.mean(axis=1)) >= -1e-9).all()
    assert 0 < marker.color.a < 1
    assert marker.color.r == scene.estimate(an_estimate(np.eye(3), 3), STAMP).color.r


def test_a_path_contains_its_positions_in_order():
    places = np.array([[9.0, 1.0, 0.0], [8.5, 1.5, 0.1], [8.0, 1.0, 0.2]])
    path = scene.path(places, STAMP, Frame())
    assert (path.header.frame_id, path.header.stamp) == ('map', STAMP)
    assert np.array([of(pose.pose.position) for pose in path.poses]) == pytest.approx(places)
    assert all(pose.header == path.header and pose.pose.orientation.w == 1
               for pose in path.poses)


def test_a_deletion_names_its_marker():
    marker = scene.deletion('truth', 4, STAMP)
    assert (marker.ns, marker.id, marker.action) == ('truth', 4, Marker.DELETE)


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


def test_two_networks_have_frames_of_their_own():
    frames = [Frame('odom', prefix=f'{space}/') for space in ('left', 'right')]
    children = [transform.child_frame_id for frame in frames for transform in (
        scene.surface_transform(frame, Time()),
        scene.user_transform(frame, 1, np.zeros(3), Time()))]
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
            convert.ros_type(m.PositionEstimate), f'/{space}/position_estimate', EXCHANGE)
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
