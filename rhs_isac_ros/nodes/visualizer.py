"""The executable ``visualizer``: shows a network in RViz and Foxglove."""

import sys
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, parameters, qos, scene, topics
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.ros.timers import steady_timer

RECEIVES = (m.RhsConfiguration, m.GroundTruth, m.PositionEstimate)


class VisualizerNode(Node):
    """Publishes board, region of interest, users and estimates as markers."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('visualizer', **node_options)
        values = parameters.declare(self, 'visualizer')
        self._scenario = (
            Scenario.from_yaml(values.scenario_file) if values.scenario_file else Scenario())
        self._latest: dict[tuple[type, int], m.Message] = {}
        self._publisher = self.create_publisher(MarkerArray, topics.MARKERS, qos.EXCHANGE)
        for kind in RECEIVES:
            self.create_subscription(
                convert.ros_type(kind), topics.NAMES[kind],
                lambda message, kind=kind: self._on_message(kind, message), qos.of(kind),
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))
        steady_timer(self, values.period_s, self._show)

    def _on_message(self, kind: type[m.Message], message: Any) -> None:
        try:
            plain = convert.from_ros(kind, message)
            m.check(plain, self._scenario.sizes)
        except m.MessageError as error:
            self.get_logger().warning(f'dropped: {error}', throttle_duration_sec=10.0)
            return
        self._latest[kind, getattr(plain, 'user', 0)] = plain

    def _show(self) -> None:
        """Publish all of the scene: who looks on from now on needs all of it."""
        if not self._publisher.get_subscription_count():
            return
        stamp = self.get_clock().now().to_msg()
        configuration = self._latest.get((m.RhsConfiguration, 0))
        markers = [scene.region(self._scenario, stamp), scene.board(
            self._scenario, configuration.analog if configuration else None, stamp)]
        for message in self._latest.values():
            match message:
                case m.GroundTruth():
                    markers.append(scene.truth(message, stamp))
                case m.PositionEstimate():
                    markers.append(scene.estimate(message, stamp))
        self._publisher.publish(MarkerArray(markers=markers))


main = entry(lambda: [VisualizerNode()])


if __name__ == '__main__':
    sys.exit(main())
