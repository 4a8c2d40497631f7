"""Transforms from the frame of standard messages to those of the surface and the users."""

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.node import Node
from std_msgs.msg import Header

from rhs_isac_ros.ros import qos
from rhs_isac_ros.ros.endpoints import create_publisher
from rhs_isac_ros.ros.frames import Frame
from rhs_isac_ros.ros.topics import TF, TF_STATIC

_NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])


def surface(frame: Frame, stamp: Time) -> TransformStamped:
    """Return the transform of the surface."""
    return _transform(frame, frame.surface, frame.origin, frame.orientation, stamp)


def user(frame: Frame, number: int, position: np.ndarray, stamp: Time) -> TransformStamped:
    """Return the transform of a user at a position, float64 [3] [m], of unknown orientation.

    The position is in the frame of the surface.
    """
    return _transform(frame, frame.user(number), frame.from_surface(position), _NO_TURN, stamp)


def _transform(
        frame: Frame, child: str, position: np.ndarray, orientation: np.ndarray, stamp: Time
) -> TransformStamped:
    x, y, z = position.tolist()
    qx, qy, qz, qw = orientation.tolist()
    return TransformStamped(
        header=Header(stamp=stamp, frame_id=frame.name), child_frame_id=child,
        transform=Transform(
            translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw)))


class TransformPublisher:
    """Publishes transforms, provided that ``tf2_msgs`` is installed, which has no wheel.

    The constructor publishes the transform of the surface, latched.

    Attributes
    ----------
    available
        Whether ``tf2_msgs`` is installed; if not, nothing is published.
    """

    def __init__(self, node: Node, frame: Frame) -> None:
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self.available = False
            return
        self.available = True
        self._message = TFMessage
        self._dynamic = create_publisher(node, TFMessage, TF, qos.EXCHANGE)
        self._static = create_publisher(node, TFMessage, TF_STATIC, qos.LATCHED)
        self._static.publish(TFMessage(transforms=[
            surface(frame, node.get_clock().now().to_msg())]))

    def publish(self, transform: TransformStamped) -> None:
        """Publish a transform that changes."""
        if self.available:
            self._dynamic.publish(self._message(transforms=[transform]))
