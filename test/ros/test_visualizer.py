"""The node that shows a network."""

import numpy as np
import pytest
from rclpy.parameter import Parameter
from visualization_msgs.msg import Marker, MarkerArray

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.nodes.visualizer import VisualizerNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics


@pytest.fixture
def shown(bench, probe, small_files):
    """What the node publishes, by namespace and id, always the latest."""
    bench.add(VisualizerNode, parameter_overrides=[
        Parameter('scenario_file', value=str(small_files / 'scenario.yaml')),
        Parameter('period_s', value=0.02)])
    latest = {}

    def take(array):
        latest.clear()
        latest.update({(marker.ns, marker.id): marker for marker in array.markers})
    probe.create_subscription(MarkerArray, topics.MARKERS, take, qos.EXCHANGE)
    return latest


def test_the_scene_is_there_before_anybody_speaks(bench, shown):
    bench.until(lambda: shown, 'markers')
    assert set(shown) == {('region', 0), ('board', 0)}


def test_users_and_estimates_come_as_they_are_told(bench, probe, shown):
    truths, estimates = (bench.outlet(probe, kind) for kind in (m.GroundTruth, m.PositionEstimate))
    stamp = probe.get_clock().now().to_msg()
    for user in (1, 2):
        truths.publish(convert.to_ros(m.GroundTruth(
            0, user, np.array([9.0, user, 0.0]), np.zeros(3)), stamp))
    estimates.publish(convert.to_ros(m.PositionEstimate(
        1, 2, 'cb', np.array([8.0, 2.5, 0.1]), np.eye(3), 0.1, 'bayes', 0.01), stamp))
    bench.until(lambda: {('truth', 1), ('truth', 2), ('estimate', 2)} <= shown.keys(), 'the users')
    assert shown['truth', 2].pose.position.y == 2.0
    assert shown['estimate', 2].pose.position.x == 8.0
    assert shown['estimate', 2].type == Marker.SPHERE
    truths.publish(convert.to_ros(m.GroundTruth(
        0, 1, np.array([9.5, 1.0, 0.0]), np.zeros(3)), stamp))
    bench.until(lambda: shown['truth', 1].pose.position.x == 9.5, 'the step')


def test_the_board_takes_the_colours_of_its_configuration(bench, probe, shown, small):
    outlet = bench.outlet(probe, m.RhsConfiguration)
    scenario = small.scenario
    analog = np.ones((scenario.n_frames, scenario.n_elements))
    outlet.publish(ros.RhsConfiguration(cycle_id=1))
    outlet.publish(convert.to_ros(m.RhsConfiguration(1, m.Mode.POSITIONING, 0, 'cb', analog),
                                  probe.get_clock().now().to_msg()))
    bench.until(lambda: shown and shown['board', 0].colors[0].r == 1.0, 'the colours')
