"""The scene of a network for RViz: markers, paths and transforms.

Markers are in metres in the frame of the surface; `place` moves them to the frame of standard
messages.
"""

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

from rhs_isac_ros.link import BeamPattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_interval_m, element_positions
from rhs_isac_ros.monitoring.shapes import ellipsoid_95, lobe_m, user_colour
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.endpoints import create_publisher
from rhs_isac_ros.ros.frames import Frame, to_ros
from rhs_isac_ros.ros.topics import RHS_FRAME, TF, TF_STATIC

_USER_SIZE_M = 0.25
# RViz rejects bodies without extent [m].
_MIN_EXTENT_M = 1e-3


def board(scenario: Scenario, configuration: np.ndarray | None, stamp: Time) -> Marker:
    """Return the surface as one cube for each element, from dark for 0 to bright for 1.

    It shows the mean over the frames of a configuration, float64 [F, N_E] in [0, 1]; None if
    unknown.
    """
    positions = element_positions(scenario)
    levels = (np.full(len(positions), 0.5) if configuration is None
              else np.mean(configuration, axis=0))
    side_m = 0.9 * element_interval_m(scenario)
    marker = _marker('board', 0, Marker.CUBE_LIST, stamp)
    marker.scale = Vector3(x=_MIN_EXTENT_M, y=side_m, z=side_m)
    marker.points = [to_ros(Point, position) for position in positions]
    marker.colors = [ColorRGBA(r=c, g=c, b=0.3 + 0.2 * c, a=1.0) for c in levels.tolist()]
    return marker


def region(scenario: Scenario, stamp: Time) -> Marker:
    """Return the region of interest as a translucent cuboid."""
    marker = _marker('region', 0, Marker.CUBE, stamp)
    marker.pose.position = to_ros(Point, np.array(scenario.roi_center_m))
    marker.scale = to_ros(Vector3, np.maximum(scenario.roi_size_m, _MIN_EXTENT_M))
    marker.color = ColorRGBA(r=0.6, g=0.6, b=0.6, a=0.15)
    return marker


def truth(message: m.GroundTruth, stamp: Time) -> Marker:
    """Return the true position of a user as a small ball in the colour of the user."""
    marker = _marker('truth', message.user, Marker.SPHERE, stamp)
    marker.pose.position = to_ros(Point, message.position)
    marker.scale = to_ros(Vector3, np.full(3, _USER_SIZE_M))
    marker.color = _colour(message.user, 1.0)
    return marker


def estimate(message: m.PositionEstimate, stamp: Time) -> Marker:
    """Return the ellipsoid that contains 95 % of an estimate, in the colour of the user."""
    half_m, quaternion = ellipsoid_95(message.covariance_m2)
    marker = _marker('estimate', message.user, Marker.SPHERE, stamp)
    marker.pose.position = to_ros(Point, message.position)
    marker.pose.orientation = to_ros(Quaternion, quaternion)
    marker.scale = to_ros(Vector3, np.maximum(2 * half_m, _MIN_EXTENT_M))
    marker.color = _colour(message.user, 0.35)
    return marker


def beam(pattern: BeamPattern, user: int, stamp: Time) -> Marker:
    """Return the surface of `lobe_m` as triangles in the colour of the user."""
    points = lobe_m(pattern)
    # Two triangles for each cell of the mesh, with their front sides outward.
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    corners = np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3, 3)
    # Triangles without area are invisible and need not be sent.
    corners = corners[np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 0]
    marker = _marker('beam', 0, Marker.TRIANGLE_LIST, stamp)
    marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
    marker.points = [to_ros(Point, corner) for corner in corners.reshape(-1, 3)]
    marker.color = _colour(user, 0.25)
    return marker


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


def _marker(namespace: str, number: int, kind: int, stamp: Time) -> Marker:
    marker = Marker(header=Header(stamp=stamp, frame_id=RHS_FRAME), ns=namespace, type=kind,
                    # Marker ids are signed, user numbers are unsigned.
                    id=number & 0x7fffffff, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    return marker


def _colour(user: int, opacity: float) -> ColorRGBA:
    red, green, blue = user_colour(user)
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
