"""The frame of standard messages, and the pose of the surface in it.

The model, the region and the messages of the protocol are in the frame of the surface. Standard
messages, such as poses and paths, are in the frame given by the parameter ``frame_id``.
"""

import dataclasses
import math
import types
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion
from rclpy.node import Node

from rhs_isac_ros.ros.topics import MAP_FRAME, RHS_FRAME, USER_FRAME
from rhs_isac_ros.support.fields import ParameterError


def surface_frame(namespace: str) -> str:
    """Return the name of the frame of the surface in a namespace."""
    return f'{namespace.strip("/")}/{RHS_FRAME}'.lstrip('/')


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix [3, 3] of a quaternion x, y, z, w of any length except 0."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def vector(message: Any) -> np.ndarray:
    """Return a point or a vector of ROS as an array [3]."""
    return np.array([message.x, message.y, message.z])


def to_ros(kind: Any, values: np.ndarray) -> Any:
    """Return a point, vector or quaternion of ROS with the given x, y, z and (if any) w."""
    return kind(**dict(zip('xyzw', values.tolist(), strict=False)))


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """The frame of standard messages, and the pose of the surface in it."""

    name: str = MAP_FRAME
    # Prefix of the frames of the surface and the users: the namespace with a final slash, or ''.
    prefix: str = ''
    # Pose of the surface: position, float64 [3] [m], and quaternion x, y, z, w.
    origin: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    orientation: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0., 0., 0., 1.]))

    @classmethod
    def of(cls, node: Node, values: types.SimpleNamespace) -> 'Frame':
        """Return the frame given by ``frame_id`` and ``surface_pose``, or raise ParameterError."""
        pose = values.surface_pose
        if len(pose) != 6:
            raise ParameterError(f'surface_pose: {len(pose)} numbers, expected six, x, y, z [m], '
                                 'roll, pitch, yaw [rad]')
        if not values.frame_id or values.frame_id.startswith('/'):
            raise ParameterError(f'frame_id: {values.frame_id!r}, expected the name of a frame '
                                 'without a slash at its beginning')
        prefix = surface_frame(node.get_namespace()).removesuffix(RHS_FRAME)
        return cls(values.frame_id, prefix, np.array(pose[:3]), _quaternion(*pose[3:]))

    @property
    def surface(self) -> str:
        """Name of the frame of the surface."""
        return f'{self.prefix}{RHS_FRAME}'

    def user(self, number: int) -> str:
        """Return the name of the frame of a user."""
        return f'{self.prefix}{USER_FRAME.format(user=number)}'

    @property
    def rotation(self) -> np.ndarray:
        """Matrix [3, 3] that rotates vectors from the frame of the surface into this frame."""
        return rotation_matrix(self.orientation)

    def from_surface(self, position: np.ndarray) -> np.ndarray:
        """Convert a position, float64 [3] [m], from the frame of the surface to this frame."""
        return self.rotation @ position + self.origin

    def to_surface(self, position: np.ndarray) -> np.ndarray:
        """Convert a position, float64 [3] [m], from this frame to the frame of the surface."""
        return self.rotation.T @ (position - self.origin)

    def covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Convert a covariance [3, 3] from the frame of the surface to this frame."""
        return self.rotation @ covariance @ self.rotation.T

    def pose(self, local: Pose) -> Pose:
        """Convert a pose from the frame of the surface to this frame."""
        second = local.orientation
        turn = _product(
            self.orientation, np.array([second.x, second.y, second.z, second.w]))
        return Pose(position=to_ros(Point, self.from_surface(vector(local.position))),
                    orientation=to_ros(Quaternion, turn))


def _quaternion(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the quaternion of rotations about the fixed axes x, y and z, in this order."""
    about = (np.array([*(math.sin(angle / 2) * axis), math.cos(angle / 2)])
             for angle, axis in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True))
    first, second, third = about
    return _product(_product(first, second), third)


def _product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the quaternion of two successive rotations: first `other`, then `one`."""
    (u, a), (v, b) = (one[:3], one[3]), (other[:3], other[3])
    return np.append(a * v + b * u + np.cross(u, v), a * b - u @ v)
