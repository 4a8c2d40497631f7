"""Markers of the scene, and transforms of the surface and of the users."""

import dataclasses
import functools
import importlib.util

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rclpy.time import Time as RosTime
from ros_messages import position_estimate, to_ros
from visualization_msgs.msg import Marker

from rhs_isac_ros.link import beam_pattern, steer
from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.monitoring import shapes
from rhs_isac_ros.nodes import visualizer as scene
from rhs_isac_ros.nodes.visualizer import VisualizerNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED
from rhs_isac_ros.ros.topics import Frame

STAMP = Time(sec=3)


def of(vector):
    return np.array([vector.x, vector.y, vector.z])


def rgb(colour):
    return (colour.r, colour.g, colour.b)


def an_estimate(covariance_m2, user=1):
    """The ellipsoid of an estimate as a marker, and as a shape."""
    _, shape = shapes.estimate(position_estimate(
        user, [9.0, -1.0, 0.5], covariance_m2=covariance_m2))
    return scene.marker('estimate', user, shape, STAMP), shape


def test_an_ellipsoid_keeps_its_axes():
    marker, shape = an_estimate(np.diag([4.0, 1.0, 0.25]))
    assert marker.type == Marker.SPHERE
    assert of(marker.pose.position) == pytest.approx(shape.centres[0])
    assert of(marker.scale) == pytest.approx(2 * shape.half_sizes_m[0])
    turn = marker.pose.orientation
    assert [turn.x, turn.y, turn.z, turn.w] == pytest.approx(shape.quaternions[0])
    assert of(an_estimate(np.zeros((3, 3)))[0].scale).min() > 0


def test_lines_join_the_points_of_each_strip():
    strips = np.arange(9.0).reshape(3, 3), np.arange(6.0).reshape(2, 3)
    marker = scene.marker('traced', 1, shapes.Lines(strips, (0.5, 0.25, 1.0), 1.0), STAMP)
    assert marker.type == Marker.LINE_LIST
    assert np.array([of(point) for point in marker.points]).tolist() == [
        *strips[0][[0, 1, 1, 2]].tolist(), *strips[1].tolist()]
    assert rgb(marker.color) == (0.5, 0.25, 1.0) and marker.scale.x > 0


def test_the_plates_of_the_board_keep_places_and_colours(small):
    board = shapes.board(small.scenario, np.linspace(0, 1, small.scenario.n_elements)[None])
    marker = scene.marker('board', 0, board, STAMP)
    assert np.array([of(point) for point in marker.points]) == pytest.approx(board.centres)
    assert np.array([rgb(colour) for colour in marker.colors]) == pytest.approx(board.colours)
    assert of(marker.scale) == pytest.approx(2 * board.half_sizes_m[0])


def test_the_region_is_translucent_and_visible_even_if_it_is_flat(small):
    flat = dataclasses.replace(small.scenario, roi_size_m=(4.0, 3.0, 0.0))
    for scenario in (small.scenario, flat):
        marker = scene.marker('region', 0, shapes.region(scenario), STAMP)
        low, high = scenario.roi_bounds_m
        (centre,), size = map(of, marker.points), of(marker.scale)
        assert centre == pytest.approx((low + high) / 2)
        assert size == pytest.approx(high - low, abs=0.01)
        assert size.min() > 0 and 0 < marker.colors[0].a < 1
        assert (marker.header.frame_id, marker.header.stamp) == ('rhs_link', STAMP)
        assert marker.pose.orientation.w == 1


def test_the_beam_points_to_its_user_and_its_triangles_look_outward():
    scenario, place = Scenario(), np.array([9.0, 3.0, 0.3])
    found = beam_pattern(scenario, steer(scenario, place), 10.0)
    marker = scene.marker('beam', 0, shapes.lobe(found, 3), STAMP)
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
    assert rgb(marker.color) == pytest.approx(shapes.user_colour(3))


@pytest.mark.parametrize('namespace', ['region', 'board', 'beam', 'traced'])
def test_the_surface_and_its_shapes_are_at_its_pose(namespace):
    body = shapes.Lines((np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),), (1.0, 1.0, 1.0), 1.0)
    placed = scene.in_site(
        scene.marker(namespace, 0, body, STAMP), Frame('odom'), Pose((1, 2, 3), (0, 0, 1, 1)))
    assert placed.header.frame_id == 'odom'
    assert of(placed.pose.position) == pytest.approx([1.0, 2.0, 3.0])
    turn = placed.pose.orientation
    assert [turn.x, turn.y, turn.z, turn.w] == pytest.approx([0, 0, *2 * [np.sqrt(0.5)]])
    assert of(placed.points[1]) == pytest.approx([1.0, 0.0, 0.0])


def test_users_are_where_their_messages_say():
    marker, _ = an_estimate(np.eye(3), 1)
    before = of(marker.pose.position)
    placed = scene.in_site(marker, Frame('odom'), Pose((1, 2, 3), (0, 0, 1, 1)))
    assert placed.header.frame_id == 'odom'
    assert of(placed.pose.position) == pytest.approx(before)


HAS_TF2 = importlib.util.find_spec('tf2_msgs') is not None


def test_a_transform_has_the_place_of_its_child():
    frame, turned = Frame(), Pose((1, 2, 3), (0, 0, 1, 1))
    for found, child, place, turn in (
            (scene.transform(frame, frame.surface, turned.origin, STAMP, turned.unit_quaternion),
             'rhs_link', [1.0, 2.0, 3.0], [0.0, 0.0, *2 * [np.sqrt(0.5)]]),
            (scene.transform(frame, frame.user(7), np.array([9.0, -1.5, 0.25]), STAMP),
             'user_7', [9.0, -1.5, 0.25], [0.0, 0.0, 0.0, 1.0])):
        assert (found.header.frame_id, found.child_frame_id) == ('map', child)
        assert found.header.stamp == STAMP
        assert of(found.transform.translation).tolist() == place
        assert [getattr(found.transform.rotation, axis) for axis in 'xyzw'] == pytest.approx(turn)


def test_two_networks_have_frames_of_their_own():
    frames = [Frame('odom', prefix=f'{space}/') for space in ('left', 'right')]
    children = [child for frame in frames for child in (frame.surface, frame.user(1))]
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
    estimate = to_ros(position_estimate(2), Time())
    probe.create_timer(0.05, lambda: estimates.publish(estimate))
    bench.until(lambda: 'user_2' in found, 'the user')
    assert found['user_2'].y == 2.5


@pytest.mark.skipif(not HAS_TF2, reason='tf2_msgs is not installed')
def test_two_networks_share_one_tree(bench, probe, tmp_path):
    tf2_ros = pytest.importorskip('tf2_ros')
    buffer = tf2_ros.Buffer(node=probe)
    # It subscribes as long as it exists.
    listener = tf2_ros.TransformListener(buffer, probe)
    poses = {'left': [1.0, 0.0, 0.0], 'right': [0.0, 4.0, 0.0]}
    for space, position_m in poses.items():
        file = tmp_path / f'{space}.yaml'
        file.write_text(f'pose: {{position_m: {position_m}}}', encoding='utf-8')
        bench.add(VisualizerNode, namespace=f'/{space}', values={
            'frame_id': 'odom', 'scenario_file': file})
        estimates = probe.create_publisher(
            convert.ros_type(m.PositionEstimate), f'/{space}/position_estimate', EXCHANGE)
        estimate = to_ros(position_estimate(2), Time())
        probe.create_timer(0.05, functools.partial(estimates.publish, estimate))
    for space, position_m in poses.items():
        for child, place in (('user_2', [8.0, 2.5, 0.1]), ('rhs_link', position_m)):
            bench.until(lambda child=f'{space}/{child}': buffer.can_transform(
                'odom', child, RosTime()), f'{child} of {space}')
            found = buffer.lookup_transform('odom', f'{space}/{child}', RosTime())
            moved = found.transform.translation
            np.testing.assert_allclose([moved.x, moved.y, moved.z], place, atol=1e-9)
    assert listener
