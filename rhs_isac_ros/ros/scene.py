"""The scene of a network for RViz: markers, paths and transforms.

Markers are in metres in the frame of the surface; `place` moves them to the frame of standard
messages.
"""

import itertools
from collections.abc import Iterable

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
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from rhs_isac_ros.monitoring.shapes import Boxes, Ellipsoids, Lines, Mesh, Points
from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.endpoints import create_publisher
from rhs_isac_ros.ros.frames import Frame, to_ros
from rhs_isac_ros.ros.topics import RHS_FRAME, TF, TF_STATIC

# Opacity of bodies through which others remain visible.
_ELLIPSOID, _OUTLINE, _MESH = 0.35, 0.15, 0.25
# Width of a line for a point of the screen [m].
_LINE_M = 0.02


def marker(
        namespace: str, number: int, shape: Points | Ellipsoids | Boxes | Lines | Mesh, stamp: Time
) -> Marker:
    """Return a ball, an ellipsoid, cuboids, lines or a mesh as a marker.

    Rerun draws an ellipsoid and a box that is not solid as outlines; here they are translucent.
    """
    match shape:
        case Points():
            found = _marker(namespace, number, Marker.SPHERE, stamp)
            found.pose.position = to_ros(Point, shape.positions[0])
            found.scale = to_ros(Vector3, np.full(3, 2 * shape.radii_m[0]))
            found.color = _colour(shape.colours[0], 1.0)
        case Ellipsoids():
            x, y, z, w = shape.quaternions[0].tolist()
            found = _marker(namespace, number, Marker.SPHERE, stamp)
            found.pose = Pose(position=to_ros(Point, shape.centres[0]),
                              orientation=Quaternion(x=x, y=y, z=z, w=w))
            found.scale = to_ros(Vector3, 2 * shape.half_sizes_m[0])
            found.color = _colour(shape.colours[0], _ELLIPSOID)
        case Boxes():
            # All cuboids have the size of the first.
            found = _marker(namespace, number, Marker.CUBE_LIST, stamp)
            found.scale = to_ros(Vector3, 2 * shape.half_sizes_m[0])
            found.points = [to_ros(Point, centre) for centre in shape.centres]
            found.colors = [_colour(colour, 1.0 if shape.solid else _OUTLINE)
                            for colour in shape.colours]
        case Lines():
            found = _marker(namespace, number, Marker.LINE_LIST, stamp)
            found.scale.x = _LINE_M * shape.width
            found.points = [to_ros(Point, end) for strip in shape.strips
                            for pair in itertools.pairwise(strip) for end in pair]
            found.color = _colour(shape.colour, 1.0)
        case Mesh():
            found = _marker(namespace, number, Marker.TRIANGLE_LIST, stamp)
            found.scale = Vector3(x=1.0, y=1.0, z=1.0)
            found.points = [to_ros(Point, corner) for corner in _triangles(shape.points)]
            found.color = _colour(shape.colour, _MESH)
    return found


def deletion(namespace: str, number: int, stamp: Time) -> Marker:
    """Return a marker that deletes the marker with a namespace and an id."""
    marker = _marker(namespace, number, Marker.SPHERE, stamp)
    marker.action = Marker.DELETE
    return marker


def place(marker: Marker, frame: Frame) -> Marker:
    """Return a marker in the frame of standard messages; its points are relative to its pose."""
    marker.header.frame_id = frame.name
    marker.pose = frame.pose(marker.pose)
    return marker


def path(positions: Iterable[np.ndarray], stamp: Time, frame: Frame) -> Path:
    """Return positions, float64 [3] [m] each, as a path in a frame, with unknown orientation."""
    header = Header(stamp=stamp, frame_id=frame.name)
    return Path(header=header, poses=[
        PoseStamped(header=header, pose=Pose(position=to_ros(Point, frame.from_surface(position))))
        for position in positions])


def _triangles(points: np.ndarray) -> np.ndarray:
    """Return the corners of the triangles of a mesh, float64 [N, 3], front sides outward."""
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    corners = np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3, 3)
    # Triangles without area are invisible and need not be sent.
    areas = np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return corners[areas > 0].reshape(-1, 3)


def _marker(namespace: str, number: int, kind: int, stamp: Time) -> Marker:
    found = Marker(header=Header(stamp=stamp, frame_id=RHS_FRAME), ns=namespace, type=kind,
                   # Marker ids are signed, user numbers are unsigned.
                   id=number & 0x7fffffff, action=Marker.ADD)
    found.pose.orientation.w = 1.0
    return found


def _colour(values: Iterable[float], opacity: float) -> ColorRGBA:
    red, green, blue = (float(value) for value in values)
    return ColorRGBA(r=red, g=green, b=blue, a=opacity)


_NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])


def surface_transform(frame: Frame, stamp: Time) -> TransformStamped:
    """Return the transform of the surface."""
    return _transform(frame, frame.surface, frame.origin, frame.orientation, stamp)


def user_transform(
        frame: Frame, number: int, position: np.ndarray, stamp: Time) -> TransformStamped:
    """Return the transform of a user at a position, float64 [3] [m], of unknown orientation.

    The position is in the frame of the surface.
    """
    return _transform(frame, frame.user(number), frame.from_surface(position), _NO_TURN, stamp)


def _transform(
        frame: Frame, child: str, position: np.ndarray, orientation: np.ndarray, stamp: Time
) -> TransformStamped:
    return TransformStamped(
        header=Header(stamp=stamp, frame_id=frame.name), child_frame_id=child,
        transform=Transform(translation=to_ros(Vector3, position),
                            rotation=to_ros(Quaternion, orientation)))


class TransformPublisher:
    """Publishes transforms, provided that ``tf2_msgs`` is `available`, which has no wheel.

    The constructor publishes the transform of the surface, latched.
    """

    def __init__(self, node: Node, frame: Frame) -> None:
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self.available = False
            return
        self.available = True
        self._message = TFMessage
        self._dynamic = create_publisher(node, TFMessage, TF, endpoints.EXCHANGE)
        self._static = create_publisher(node, TFMessage, TF_STATIC, endpoints.LATCHED)
        self._static.publish(TFMessage(transforms=[
            surface_transform(frame, node.get_clock().now().to_msg())]))

    def publish(self, transform: TransformStamped) -> None:
        """Publish a transform that changes."""
        if self.available:
            self._dynamic.publish(self._message(transforms=[transform]))
