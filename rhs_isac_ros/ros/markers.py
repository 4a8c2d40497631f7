"""Shapes as markers for RViz, in metres in the frame of the surface, and paths.

`place` moves a marker to the frame of standard messages.
"""

from collections.abc import Iterable

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3
from nav_msgs.msg import Path
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from rhs_isac_ros.monitoring.shapes import Boxes, Ellipsoids, Mesh, Points
from rhs_isac_ros.ros.frames import Frame
from rhs_isac_ros.ros.topics import RHS_FRAME

# Opacity of bodies through which others remain visible.
_ELLIPSOID, _OUTLINE, _MESH = 0.35, 0.15, 0.25


def marker(
        namespace: str, number: int, shape: Points | Ellipsoids | Boxes | Mesh, stamp: Time
) -> Marker:
    """Return a ball, an ellipsoid, cuboids or a mesh as a marker.

    Rerun draws an ellipsoid and a box that is not solid as outlines; here they are translucent.
    """
    match shape:
        case Points():
            found = _marker(namespace, number, Marker.SPHERE, stamp)
            found.pose.position = _point(shape.positions[0])
            found.scale = _vector(np.full(3, 2 * shape.radii_m[0]))
            found.color = _colour(shape.colours[0], 1.0)
        case Ellipsoids():
            x, y, z, w = shape.quaternions[0].tolist()
            found = _marker(namespace, number, Marker.SPHERE, stamp)
            found.pose = Pose(position=_point(shape.centres[0]),
                              orientation=Quaternion(x=x, y=y, z=z, w=w))
            found.scale = _vector(2 * shape.half_sizes_m[0])
            found.color = _colour(shape.colours[0], _ELLIPSOID)
        case Boxes():
            # All cuboids have the size of the first.
            found = _marker(namespace, number, Marker.CUBE_LIST, stamp)
            found.scale = _vector(2 * shape.half_sizes_m[0])
            found.points = [_point(centre) for centre in shape.centres]
            found.colors = [_colour(colour, 1.0 if shape.solid else _OUTLINE)
                            for colour in shape.colours]
        case Mesh():
            found = _marker(namespace, number, Marker.TRIANGLE_LIST, stamp)
            found.scale = Vector3(x=1.0, y=1.0, z=1.0)
            found.points = [_point(corner) for corner in _triangles(shape.points)]
            found.color = _colour(shape.colour, _MESH)
    return found


def deletion(namespace: str, number: int, stamp: Time) -> Marker:
    """Return a marker that deletes the marker with a namespace and an id."""
    found = _marker(namespace, number, Marker.SPHERE, stamp)
    found.action = Marker.DELETE
    return found


def place(found: Marker, frame: Frame) -> Marker:
    """Return a marker in the frame of standard messages; its points are relative to its pose."""
    found.header.frame_id = frame.name
    found.pose = frame.pose(found.pose)
    return found


def path(positions: Iterable[np.ndarray], stamp: Time, frame: Frame) -> Path:
    """Return positions, float64 [3] [m] each, as a path in a frame, with unknown orientation."""
    header = Header(stamp=stamp, frame_id=frame.name)
    return Path(header=header, poses=[
        PoseStamped(header=header, pose=Pose(position=_point(frame.from_surface(position))))
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


def _point(values: np.ndarray) -> Point:
    x, y, z = values.tolist()
    return Point(x=x, y=y, z=z)


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)
