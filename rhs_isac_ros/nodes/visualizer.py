"""The executable ``visualizer``: shows a network in RViz and Foxglove."""

import math
import sys
import time
from typing import Any

from builtin_interfaces.msg import Time
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.publisher import Publisher
from visualization_msgs.msg import Marker, MarkerArray

from rhs_isac_ros.link import Beam, beam_pattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.scene_state import RECEIVES, SceneState, UserState
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import markers, parameters, qos, topics
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.ros.subscriptions import listen
from rhs_isac_ros.ros.timers import steady_timer

# Each path is a topic of its own: a crowd would flood the graph.
_MOST_PATHS = 64


class VisualizerNode(Node):
    """Publishes board, region, users, estimates and beam as markers, and a path of each user."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('visualizer', **node_options)
        values = parameters.declare(self, 'visualizer')
        self._scenario = (
            Scenario.from_yaml(values.scenario_file) if values.scenario_file else Scenario())
        self._forget_s = values.forget_s
        self._sightings = SceneState()
        # The beam that was drawn last, and its drawing: a pattern takes its time.
        self._drawn: tuple[m.Beam, Marker] | None = None
        self._shown: set[tuple[str, int]] = set()
        self._publisher = self.create_publisher(MarkerArray, topics.MARKERS, qos.EXCHANGE)
        self._paths: dict[int, tuple[Publisher, Publisher]] = {}
        listen(self, RECEIVES, self._scenario.sizes,
               lambda message: self._sightings.add(message, time.monotonic()))
        steady_timer(self, values.period_s, self._show)

    def _show(self) -> None:
        """Publish all of the scene: who looks on from now on needs all of it."""
        for user in self._sightings.discard_stale(time.monotonic() - self._forget_s):
            for publisher in self._paths.pop(user, ()):
                self.destroy_publisher(publisher)
        stamp = self.get_clock().now().to_msg()
        for sighting in self._sightings.users.values():
            self._show_paths(sighting, stamp)
        if self._publisher.get_subscription_count():
            self._show_markers(stamp)

    def _show_paths(self, sighting: UserState, stamp: Time) -> None:
        if sighting.user not in self._paths:
            if len(self._paths) == _MOST_PATHS:
                return
            self._paths[sighting.user] = tuple(
                self.create_publisher(Path, name.format(user=sighting.user), qos.EXCHANGE)
                for name in (topics.PATH, topics.TRUE_PATH))
        ways = sighting.estimated_path, sighting.true_path
        for publisher, way in zip(self._paths[sighting.user], ways, strict=True):
            if way and publisher.get_subscription_count():
                publisher.publish(markers.path(way, stamp))

    def _show_markers(self, stamp: Time) -> None:
        now = self._sightings
        shown_markers = [markers.region(self._scenario, stamp), markers.board(
            self._scenario, now.configuration.analog if now.configuration else None, stamp)]
        for sighting in now.users.values():
            if sighting.truth:
                shown_markers.append(markers.truth(sighting.truth, stamp))
            if sighting.estimate:
                shown_markers.append(markers.estimate(sighting.estimate, stamp))
        if now.beam:
            shown_markers.append(self._draw(now.beam, stamp))
        shown = {(marker.ns, marker.id) for marker in shown_markers}
        shown_markers += [markers.gone(*key, stamp) for key in sorted(self._shown - shown)]
        self._shown = shown
        self._publisher.publish(MarkerArray(markers=shown_markers))

    def _draw(self, message: m.Beam, stamp: Time) -> Marker:
        """Draw the pattern of a beam as it is at the distance of the region's centre."""
        if self._drawn is None or self._drawn[0] is not message:
            found = beam_pattern(
                self._scenario, Beam(message.analog, message.digital, message.band),
                math.hypot(*self._scenario.roi_center_m))
            self._drawn = message, markers.beam(found, message.user, stamp)
        self._drawn[1].header.stamp = stamp
        return self._drawn[1]


main = entry(lambda: [VisualizerNode()])


if __name__ == '__main__':
    sys.exit(main())
