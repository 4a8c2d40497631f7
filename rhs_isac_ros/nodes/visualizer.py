"""The executable ``visualizer``: publishes markers, paths and transforms for RViz and Foxglove."""

import copy
import functools
import itertools
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Path
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from rhs_isac_ros import model
from rhs_isac_ros.model.pose import rotation_matrix
from rhs_isac_ros.monitoring import shapes
from rhs_isac_ros.monitoring.network_state import SCENE_RECEIVES, SceneState
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, endpoints, parameters, topics
from rhs_isac_ros.ros.convert import to_ros
from rhs_isac_ros.ros.node_surface import NodeSurface
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.ros.topics import RHS_FRAME, Frame
from rhs_isac_ros.support.frame_watch import FrameWatch

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # It has no wheel.
    TFMessage = None

# Opacity of translucent bodies.
_ELLIPSOID, _OUTLINE, _MESH = 0.35, 0.15, 0.25
# Corners of the middle of a cuboid, in half sizes, as a grid of points.
_PLATE = np.array([[[0, -1, -1], [0, 1, -1]], [[0, -1, 1], [0, 1, 1]]])
# Width in the scene that corresponds to a line width of one screen point [m].
_LINE_M = 0.02
# Minimum period of the scene while nobody receives it [s].
_UNOBSERVED_S = 2.0


def marker(
        namespace: str, number: int,
        shape: shapes.Points | shapes.Ellipsoids | shapes.Boxes | shapes.Lines | shapes.Mesh,
        stamp: Time) -> Marker:
    """Convert a shape to a marker; ellipsoids, meshes and outlined boxes are translucent.

    A sphere marker has one position and size, so only the first point or ellipsoid is drawn.
    """
    match shape:
        case shapes.Points():
            found = _marker(namespace, number, Marker.SPHERE, stamp)
            found.pose.position = to_ros(Point, shape.positions[0])
            found.scale = to_ros(Vector3, np.full(3, 2 * shape.radii_m[0]))
            found.color = _colour(shape.colours[0], 1.0)
        case shapes.Ellipsoids():
            x, y, z, w = shape.quaternions[0].tolist()
            found = _marker(namespace, number, Marker.SPHERE, stamp)
            found.pose = Pose(position=to_ros(Point, shape.centres[0]),
                              orientation=Quaternion(x=x, y=y, z=z, w=w))
            found.scale = to_ros(Vector3, 2 * shape.half_sizes_m[0])
            found.color = _colour(shape.colours[0], _ELLIPSOID)
        case shapes.Boxes(quaternions=np.ndarray() as quaternions):
            # A marker has one orientation for all its cuboids. Elements are thin.
            plates = [_triangles(plate) for plate in shape.centres[:, None, None] + [
                _PLATE * half_m @ rotation_matrix(quaternion).T
                for half_m, quaternion in zip(shape.half_sizes_m, quaternions, strict=True)]]
            found = _marker(namespace, number, Marker.TRIANGLE_LIST, stamp)
            found.scale = Vector3(x=1.0, y=1.0, z=1.0)
            found.points = [to_ros(Point, corner) for plate in plates for corner in plate]
            found.colors = [_colour(colour, 1.0) for colour, plate in zip(
                shape.colours, plates, strict=True) for _ in plate]
        case shapes.Boxes():
            # A marker has one size for all its cuboids.
            found = _marker(namespace, number, Marker.CUBE_LIST, stamp)
            found.scale = to_ros(Vector3, 2 * shape.half_sizes_m[0])
            found.points = [to_ros(Point, centre) for centre in shape.centres]
            found.colors = [_colour(colour, 1.0 if shape.solid else _OUTLINE)
                            for colour in shape.colours]
        case shapes.Lines():
            found = _marker(namespace, number, Marker.LINE_LIST, stamp)
            found.scale.x = _LINE_M * shape.width
            found.points = [to_ros(Point, end) for strip in shape.strips
                            for pair in itertools.pairwise(strip) for end in pair]
            found.color = _colour(shape.colour, 1.0)
        case shapes.Mesh():
            found = _marker(namespace, number, Marker.TRIANGLE_LIST, stamp)
            found.scale = Vector3(x=1.0, y=1.0, z=1.0)
            found.points = [to_ros(Point, corner) for corner in _triangles(shape.points)]
            found.color = _colour(shape.colour, _MESH)
    return found


# Namespaces of markers of shapes that are in the frame of the surface.
_OF_SURFACE = ('region', 'board', 'traced', 'beam')


def in_site(marker: Marker, frame: Frame, pose: model.Pose) -> Marker:
    """Move a marker to the frame of the site, given the pose of the surface, and return it."""
    marker.header.frame_id = frame.name
    if marker.ns in _OF_SURFACE:
        # The points of a marker are relative to its pose.
        marker.pose = Pose(position=to_ros(Point, pose.origin),
                           orientation=to_ros(Quaternion, pose.unit_quaternion))
    return marker


def path(positions: Iterable[np.ndarray], stamp: Time, frame: Frame) -> Path:
    """Convert positions, float64 [3] [m] each, to a path in a frame, without orientations."""
    header = Header(stamp=stamp, frame_id=frame.name)
    return Path(header=header, poses=[
        PoseStamped(header=header, pose=Pose(position=to_ros(Point, position)))
        for position in positions])


def _triangles(points: np.ndarray) -> np.ndarray:
    """Return the vertices of the triangles of a mesh, float64 [N, 3], with outward normals."""
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    corners = np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3, 3)
    # Triangles without area are invisible.
    areas = np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return corners[areas > 0].reshape(-1, 3)


def _marker(namespace: str, number: int, kind: int, stamp: Time) -> Marker:
    found = Marker(header=Header(stamp=stamp, frame_id=RHS_FRAME), ns=namespace, type=kind,
                   # Marker ids are signed, user numbers are unsigned.
                   id=number & 0x7fffffff, action=Marker.ADD)
    found.pose.orientation.w = 1.0
    return found


def _colour(channels: Iterable[float], opacity: float) -> ColorRGBA:
    red, green, blue = map(float, channels)
    return ColorRGBA(r=red, g=green, b=blue, a=opacity)


_NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])


def transform(
        frame: Frame, child: str, position: np.ndarray, stamp: Time,
        orientation: np.ndarray = _NO_TURN) -> TransformStamped:
    """Return the transform from a frame to a child, by default without rotation."""
    return TransformStamped(
        header=Header(stamp=stamp, frame_id=frame.name), child_frame_id=child,
        transform=Transform(translation=to_ros(Vector3, position),
                            rotation=to_ros(Quaternion, orientation)))


class VisualizerNode(Node):
    """Publishes the scene of a network as markers, paths and transforms."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('visualizer', **node_options)
        values = parameters.declare(self, 'visualizer')
        self._scenario = NodeSurface.of(values, self.get_namespace()).scenario
        self._frame = Frame.of(self, values)
        self._forget_s, self._period_s = values.forget_s, values.period_s
        self._scene, self._frames = SceneState(), FrameWatch(self._frame.name)
        # The latest beam and its marker, because a beam pattern is slow to compute.
        self._drawn: tuple[m.Beam, Marker] | None = None
        # A marker that is no longer published disappears after three periods.
        self._lifetime = Duration(seconds=3 * values.period_s).to_msg()
        self._publisher = endpoints.create_publisher(
            self, MarkerArray, topics.MARKERS, endpoints.EXCHANGE, overridable=True)
        self._paths = endpoints.UserTopics(
            self, {topics.PATH: Path, topics.TRUE_PATH: Path}, values.user_topics)
        if TFMessage:
            self._transforms = endpoints.create_publisher(
                self, TFMessage, topics.TF, endpoints.EXCHANGE)
            pose = self._scenario.pose
            endpoints.create_publisher(
                self, TFMessage, topics.TF_STATIC, endpoints.LATCHED).publish(TFMessage(
                    transforms=[transform(self._frame, self._frame.surface, pose.origin,
                                          self.get_clock().now().to_msg(), pose.unit_quaternion)]))
        endpoints.subscribe_messages(self, SCENE_RECEIVES, self._scenario, self._on_message,
                                     on_foreign=lambda message: None, on_frame=self._note_frame)
        endpoints.steady_timer(self, values.period_s, self._show)
        endpoints.log(
            self, 'serving: markers, paths' + (
                ' and transforms' if TFMessage
                else '; no transforms, because tf2_msgs is not installed'))

    def _note_frame(self, topic: str, frame: str) -> None:
        self._frames.add(topic, frame, time.monotonic())

    def _on_message(self, message: m.Message, arrived_s: float) -> None:
        self._scene.add(message, arrived_s)
        # The number of frames is limited like the number of topics, because tf2 keeps every frame.
        if isinstance(message, m.PositionEstimate) and self._paths.publishers(
                message.user) and TFMessage:
            self._transforms.publish(TFMessage(transforms=[transform(
                self._frame, self._frame.user(message.user), message.position,
                convert.stamp_of(message, self))]))

    def _show(self) -> float:
        """Publish all markers and paths, so that late joiners receive them.

        Return the time until the next call [s], which is longer if nobody receives them.
        """
        now_s = time.monotonic()
        problem = self._frames.update(now_s)
        endpoints.journal(self).update({'frame': problem} if problem else {})
        for number in self._scene.discard_stale(now_s - self._forget_s):
            self._paths.remove(number)
        stamp = self.get_clock().now().to_msg()
        for number, user in self._scene.users.items():
            # Without publishers, the zip is empty.
            for publisher, places in zip(self._paths.publishers(number), (
                    user.estimated_path, user.true_path), strict=False):
                if places:
                    endpoints.publish_if_subscribed(
                        (publisher,), functools.partial(path, places, stamp, self._frame))
        endpoints.publish_if_subscribed((self._publisher,), lambda: self._markers(stamp))
        observed = any(one.get_subscription_count() for one in (
            self._publisher, *self._paths.created()))
        return self._period_s if observed else max(self._period_s, _UNOBSERVED_S)

    def _markers(self, stamp: Time) -> MarkerArray:
        state = self._scene
        bodies: dict[tuple[str, int], shapes.Points | shapes.Ellipsoids | shapes.Boxes
                     | shapes.Lines] = {
            ('region', 0): shapes.region(self._scenario),
            ('board', 0): shapes.board(self._scenario, *(
                (state.configuration.analog, state.configuration.band)
                if state.configuration else (None,)))}
        for number, user in state.users.items():
            if user.truth:
                bodies['truth', number], _ = shapes.truth(user.truth)
                if self._scenario.channel:
                    bodies['traced', number] = shapes.traced(self._scenario, user.truth)
            if user.estimate:
                _, bodies['estimate', number] = shapes.estimate(user.estimate)
        array = [marker(*key, body, stamp) for key, body in bodies.items()]
        if state.beam:
            array.append(self._beam_marker(state.beam, stamp))
        for found in array:
            in_site(found, self._frame, self._scenario.pose)
            found.lifetime = self._lifetime
        return MarkerArray(markers=array)

    def _beam_marker(self, message: m.Beam, stamp: Time) -> Marker:
        if self._drawn is None or self._drawn[0] is not message:
            lobe = shapes.lobe(shapes.pattern(self._scenario, message), message.user)
            self._drawn = message, marker('beam', 0, lobe, stamp)
        drawn = copy.copy(self._drawn[1])
        drawn.header = Header(stamp=stamp, frame_id=drawn.header.frame_id)
        return drawn


main = entry('visualizer', lambda: [VisualizerNode()])
