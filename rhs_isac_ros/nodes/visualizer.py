"""The executable ``visualizer``: shows a network in RViz and Foxglove."""

import copy
import time
from typing import Any

from builtin_interfaces.msg import Time
from nav_msgs.msg import Path
from rclpy.node import Node
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from rhs_isac_ros.monitoring import shapes
from rhs_isac_ros.monitoring.network_state import SCENE_RECEIVES, SceneState, UserState
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, parameters, scene, topics
from rhs_isac_ros.ros.endpoints import (
    EXCHANGE,
    UserTopics,
    create_publisher,
    steady_timer,
    subscribe_messages,
)
from rhs_isac_ros.ros.frames import Frame
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.ros.scene import TransformPublisher


class VisualizerNode(Node):
    """Publishes surface, region, users, estimates and beam as markers, paths and transforms."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('visualizer', **node_options)
        values = parameters.declare(self, 'visualizer')
        self._scenario = parameters.scenario_of(values)
        self._frame = Frame.of(self, values)
        self._forget_s = values.forget_s
        self._scene = SceneState()
        # The latest beam and its marker, cached because a beam pattern is slow to compute.
        self._drawn: tuple[m.Beam, Marker] | None = None
        self._shown: set[tuple[str, int]] = set()
        self._publisher = create_publisher(self, MarkerArray, topics.MARKERS, EXCHANGE,
                                           overridable=True)
        self._paths = UserTopics(self, {topics.PATH: Path, topics.TRUE_PATH: Path},
                                 values.user_topics)
        self._transforms = TransformPublisher(self, self._frame)
        subscribe_messages(self, SCENE_RECEIVES, self._scenario.sizes, self._on_message,
                           scenario_id=self._scenario.id)
        steady_timer(self, values.period_s, self._show)
        self.get_logger().info(  # type: ignore[no-untyped-call]
            'serving: markers, paths' + (
                ' and transforms' if self._transforms.available
                else '; no transforms, because tf2_msgs is not installed'))

    def _on_message(self, message: m.Message) -> None:
        self._scene.add(message, time.monotonic())
        # As for the topics, the number of frames is bounded: tf2 keeps every frame.
        if isinstance(message, m.PositionEstimate) and self._paths.publishers(message.user):
            self._transforms.publish(scene.user_transform(
                self._frame, message.user, message.position, convert.stamp_of(message, self)))

    def _show(self) -> None:
        """Publish the whole scene, so that late joiners receive it."""
        for user in self._scene.discard_stale(time.monotonic() - self._forget_s):
            self._paths.remove(user)
        stamp = self.get_clock().now().to_msg()
        for state in self._scene.users.values():
            self._show_paths(state, stamp)
        if self._publisher.get_subscription_count():
            self._show_markers(stamp)

    def _show_paths(self, user: UserState, stamp: Time) -> None:
        paths = user.estimated_path, user.true_path
        # Without publishers, the zip is empty.
        for publisher, path in zip(self._paths.publishers(user.user), paths, strict=False):
            if path and publisher.get_subscription_count():
                publisher.publish(scene.path(path, stamp, self._frame))

    def _show_markers(self, stamp: Time) -> None:
        state = self._scene
        bodies: dict[tuple[str, int], shapes.Points | shapes.Ellipsoids | shapes.Boxes
                     | shapes.Lines] = {
            ('region', 0): shapes.region(self._scenario),
            ('board', 0): shapes.board(
                self._scenario, state.configuration.analog if state.configuration else None)}
        for number, user in state.users.items():
            if user.truth:
                bodies['truth', number], _ = shapes.truth(user.truth)
                if self._scenario.channel:
                    bodies['traced', number] = shapes.traced(self._scenario, user.truth)
            if user.estimate:
                _, bodies['estimate', number] = shapes.estimate(user.estimate)
        array = [scene.marker(*key, body, stamp) for key, body in bodies.items()]
        if state.beam:
            array.append(self._beam_marker(state.beam, stamp))
        array = [scene.place(marker, self._frame) for marker in array]
        shown = {(marker.ns, marker.id) for marker in array}
        array += [scene.deletion(*key, stamp) for key in sorted(self._shown - shown)]
        self._shown = shown
        self._publisher.publish(MarkerArray(markers=array))

    def _beam_marker(self, message: m.Beam, stamp: Time) -> Marker:
        if self._drawn is None or self._drawn[0] is not message:
            lobe = shapes.lobe(shapes.pattern(self._scenario, message), message.user)
            self._drawn = message, scene.marker('beam', 0, lobe, stamp)
        drawn = copy.copy(self._drawn[1])
        drawn.header = Header(stamp=stamp, frame_id=drawn.header.frame_id)
        return drawn


main = entry('visualizer', lambda: [VisualizerNode()])
