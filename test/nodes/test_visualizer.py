"""The node that publishes the scene for RViz and Foxglove."""

import math
from pathlib import Path as FilePath

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time
from nav_msgs.msg import Path
from ros_messages import position_estimate, to_ros
from visualization_msgs.msg import Marker, MarkerArray

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import shapes
from rhs_isac_ros.nodes.visualizer import VisualizerNode, marker
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import EXCHANGE

ROOT = FilePath(__file__).parents[2]


@pytest.fixture
def shown(bench, probe, bench_files, request):
    """Dictionary of the latest markers of the node, by namespace and id."""
    bench.add(VisualizerNode, values={
        'scenario_file': bench_files / 'scenario.yaml', 'period_s': 0.02,
        'forget_s': getattr(request, 'param', 60.0)})
    latest = {}

    def receive(array):
        # As in RViz, a marker disappears unless it is published again.
        assert {marker.lifetime.nanosec for marker in array.markers} == {60_000_000}
        latest.clear()
        latest.update({(marker.ns, marker.id): marker for marker in array.markers})
    probe.create_subscription(MarkerArray, topics.MARKERS, receive, EXCHANGE)
    return latest


def ground_truth(user, x):
    return m.GroundTruth(cycle_id=0, user=user, position=np.array([x, user, 0.0]),
        velocity=np.zeros(3))


def test_plates_that_face_along_normals_are_triangles():
    normals = np.array([[1.0, 0, 0], [0.6, 0.8, 0]])
    panel = Scenario(element_positions_m=[[0, 0, 0], [0, 0.1, 0]], element_normals=normals)
    plates = shapes.board(panel, np.array([[0.0, 1.0]]))
    found = marker('board', 0, plates, Time())
    assert (found.type, len(found.colors)) == (Marker.TRIANGLE_LIST, 12)
    corners = np.array([[p.x, p.y, p.z] for p in found.points]).reshape(2, 2, 3, 3)
    for normal, centre, triangles in zip(normals, plates.centres, corners, strict=True):
        assert (triangles - centre) @ normal == pytest.approx(0)
        assert triangles.mean(axis=(0, 1)) == pytest.approx(centre)
    assert found.colors[0].r < found.colors[6].r


def beam(sizes):
    return m.Beam(cycle_id=1, user=1, codebook_id='cb', band=0, analog=np.ones(sizes['N_E']),
                  digital=np.full((sizes['N_SB'], sizes['K']), 1e-3 + 0j), expected_bps=1.0)


def test_users_and_estimates_are_shown_at_their_positions(bench, probe, shown):
    bench.until(lambda: shown, 'markers')
    assert set(shown) == {('region', 0), ('board', 0)}
    truths, estimates = (
        bench.publisher(probe, kind) for kind in (m.GroundTruth, m.PositionEstimate))
    stamp = probe.get_clock().now().to_msg()
    for user in (1, 2):
        truths.publish(to_ros(ground_truth(user, 9.0), stamp))
    estimates.publish(to_ros(position_estimate(2), stamp))
    bench.until(lambda: {('truth', 1), ('truth', 2), ('estimate', 2)} <= shown.keys(), 'the users')
    assert shown['truth', 2].pose.position.y == 2.0
    assert shown['estimate', 2].pose.position.x == 8.0
    assert shown['estimate', 2].type == Marker.SPHERE
    truths.publish(to_ros(ground_truth(1, 9.5), stamp))
    bench.until(lambda: shown['truth', 1].pose.position.x == 9.5, 'the new position')


def test_positions_in_another_frame_are_reported(bench, probe, shown, capfd):
    estimate = to_ros(position_estimate())
    estimate.header.frame_id = 'odom'
    bench.publisher(probe, m.PositionEstimate).publish(estimate)
    bench.until(lambda: ('estimate', 1) in shown, 'the user')
    assert capfd.readouterr().err.count(
        "positions in the frames 'map' (this node), 'odom' (/position_estimate)") == 1


def test_rviz_lists_the_namespaces_of_all_markers(bench, probe, shown, small):
    """So that each can be switched off."""
    layout = yaml.safe_load((ROOT / 'config/rviz/network.rviz').read_text(encoding='utf-8'))
    (display,) = [one for one in layout['Visualization Manager']['Displays']
                  if one['Class'].endswith('/MarkerArray')]
    sizes, stamp = small.scenario.sizes, probe.get_clock().now().to_msg()
    for message in (
            ground_truth(1, 9.0),
            position_estimate(),
            beam(sizes)):
        bench.publisher(probe, type(message)).publish(to_ros(message, stamp))
    # Only a scenario with propagation paths shows these.
    bench.until(lambda: set(display['Namespaces']) == {'traced', *(name for name, _ in shown)},
                'every namespace')


def test_messages_of_another_scenario_are_ignored_without_a_warning(bench, probe, shown, capfd):
    publisher, stamp = bench.publisher(probe, m.Beam), probe.get_clock().now().to_msg()
    other = beam({'N_E': 9, 'N_SB': 1, 'K': 1})
    publisher.publish(to_ros(other, stamp, (7, 'sc2')))
    truths = bench.publisher(probe, m.GroundTruth)
    truths.publish(to_ros(ground_truth(1, 9.0), stamp, (7, 'sc2')))
    truths.publish(to_ros(ground_truth(2, 9.0), stamp))
    bench.until(lambda: ('truth', 2) in shown, 'the other user')
    assert ('truth', 1) not in shown
    assert 'dropped' not in capfd.readouterr().err
    # The same message of an unknown scenario is an error.
    publisher.publish(to_ros(other, stamp))
    log = []
    bench.until(lambda: log.append(capfd.readouterr().err) or 'Beam.analog' in ''.join(log),
                'the warning')


@pytest.mark.parametrize('shown', [0.5], indirect=True)
def test_a_user_without_messages_is_removed(bench, probe, shown, small):
    """Its beam and its topics are removed as well; the other user stays."""
    truths, beams = (bench.publisher(probe, kind) for kind in (m.GroundTruth, m.Beam))
    stamp, sizes = probe.get_clock().now().to_msg(), small.scenario.sizes
    sending = {1, 2}

    def send():
        for user in sending:
            truths.publish(to_ros(ground_truth(user, 9.0), stamp))
        if 1 in sending:
            beams.publish(to_ros(beam(sizes), stamp))
    probe.create_timer(0.05, send)
    bench.until(lambda: {('truth', 1), ('truth', 2), ('beam', 0)} <= shown.keys(), 'both users')
    lobe = np.array([[p.x, p.y, p.z] for p in shown['beam', 0].points])
    distance = math.hypot(*small.scenario.roi_center_m)
    assert np.linalg.norm(lobe, axis=1).max() == pytest.approx(distance)
    sending.remove(1)
    bench.until(lambda: ('truth', 1) not in shown, 'removal of user 1')
    # On a loaded machine, a delayed message may remove user 2 until the next one.
    bench.until(lambda: set(shown) == {('region', 0), ('board', 0), ('truth', 2)}, 'user 2')
    bench.until(lambda: not probe.count_publishers('users/user_1/true_path'),
                'removal of its path')
    bench.until(lambda: probe.count_publishers('users/user_2/true_path'), 'its path')


def test_each_user_has_a_path(bench, probe, shown):
    paths = {}
    for name in (topics.PATH, topics.TRUE_PATH):
        probe.create_subscription(
            Path, name.format(user=7), lambda path, name=name: paths.update({name: path}),
            EXCHANGE)
    truths, estimates = (
        bench.publisher(probe, kind) for kind in (m.GroundTruth, m.PositionEstimate))
    stamp = probe.get_clock().now().to_msg()
    for cycle_id, x in enumerate((8.0, 8.5, 9.0), start=1):
        truths.publish(to_ros(ground_truth(7, x), stamp))
        estimates.publish(to_ros(
            position_estimate(7, [x + 0.1, 2.5, 0.1], cycle_id=cycle_id), stamp))

    def xs(name):
        return [pose.pose.position.x for pose in paths[name].poses] if name in paths else []
    bench.until(lambda: len(xs(topics.PATH)) == len(xs(topics.TRUE_PATH)) == 3, 'the paths')
    assert xs(topics.TRUE_PATH) == [8.0, 8.5, 9.0]
    assert xs(topics.PATH) == [8.1, 8.6, 9.1]
    assert paths[topics.PATH].header.frame_id == 'map'
