"""The names of frames, and conversions of vectors.

Positions in messages are in the frame of the site, which the parameter ``frame_id`` names.
"""

import dataclasses
import types
from typing import Any

import numpy as np
from rclpy.node import Node

from rhs_isac_ros.ros.topics import MAP_FRAME, RHS_FRAME, USER_FRAME


def vector(message: Any) -> np.ndarray:
    """Return a point or a vector of ROS as an array [3]."""
    return np.array([message.x, message.y, message.z])


def to_ros(kind: Any, numbers: np.ndarray) -> Any:
    """Return a point, vector or quaternion of ROS with the given x, y, z and (if any) w."""
    return kind(**dict(zip('xyzw', numbers.tolist(), strict=False)))


@dataclasses.dataclass(frozen=True)
class Frame:
    """The names of the frames of a site, of a surface and of its users."""

    name: str = MAP_FRAME
    # Prefix of the frames of the surface and the users: the namespace with a final slash, or ''.
    prefix: str = ''

    @classmethod
    def of(cls, node: Node, values: types.SimpleNamespace) -> 'Frame':
        """Return the frames given by ``frame_id`` and the namespace.

        Nodes that publish no positions do not have the parameter.
        """
        return cls(getattr(values, 'frame_id', MAP_FRAME),
                   f'{node.get_namespace().strip("/")}/'.lstrip('/'))

    @property
    def surface(self) -> str:
        """Name of the frame of the surface."""
        return f'{self.prefix}{RHS_FRAME}'

    def user(self, number: int) -> str:
        """Return the name of the frame of a user."""
        return f'{self.prefix}{USER_FRAME.format(user=number)}'
