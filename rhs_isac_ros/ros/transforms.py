"""Transforms from the frame ``map`` to the frames of the surface and of the users, for tf2."""

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.node import Node
from std_msgs.msg import Header

from rhs_isac_ros.ros import qos
from rhs_isac_ros.ros.endpoints import create_publisher
from rhs_isac_ros.ros.topics import MAP_FRAME, RHS_FRAME, TF, TF_STATIC, USER_FRAME


def surface(stamp: Time) -> TransformStamped:
    """Return the transform of the surface, which is at the origin."""
    return _transform(RHS_FRAME, np.zeros(3), stamp)


def user(number: int, position: np.ndarray, stamp: Time) -> TransformStamped:
    """Return the transform of a user at a position, float64 [3] [m], of unknown orientation."""
    return _transform(USER_FRAME.format(user=number), position, stamp)


def _transform(child: str, position: np.ndarray, stamp: Time) -> TransformStamped:
    x, y, z = position.tolist()
    return TransformStamped(
        header=Header(stamp=stamp, frame_id=MAP_FRAME), child_frame_id=child,
        transform=Transform(
            translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)))


class TransformPublisher:
    """Publishes transforms, provided that ``tf2_msgs`` is installed, which has no wheel.

    The constructor publishes the transform of the surface, latched.

    Attributes
    ----------
    available
        Whether ``tf2_msgs`` is installed; if not, nothing is published.
    """

    def __init__(self, node: Node) -> None:
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self.available = False
            return
        self.available = True
        self._message = TFMessage
        self._dynamic = create_publisher(node, TFMessage, TF, qos.EXCHANGE)
        self._static = create_publisher(node, TFMessage, TF_STATIC, qos.LATCHED)
        self._static.publish(TFMessage(transforms=[surface(node.get_clock().now().to_msg())]))

    def publish(self, transform: TransformStamped) -> None:
        """Publish a transform that changes."""
        if self.available:
            self._dynamic.publish(self._message(transforms=[transform]))
