"""Messages of the protocol as ROS messages, as another program has them, and parameters."""

from pathlib import Path

import numpy as np
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics


def position_estimate(user=1, position=(8.0, 2.5, 0.1), **given):
    return m.PositionEstimate(user=user, position=np.array(position), **{
        'cycle_id': 1, 'codebook_id': 'cb', 'covariance_m2': np.eye(3), 'crlb_m2': 0.1,
        'estimator': 'bayes', 'latency_s': 0.01} | given)


def to_ros(message, stamp=None, identity=None):
    """Convert a dataclass to a ROS message; the identity is as in `convert.to_bytes`."""
    stamp_ns = 10**9 * stamp.sec + stamp.nanosec if stamp is not None else 0
    frame = topics.MAP_FRAME if isinstance(message, m.POSITIONS) else topics.RHS_FRAME
    return deserialize_message(convert.to_bytes(
        message, stamp_ns, identity, frame), convert.ros_type(type(message)))


def from_ros(kind, message):
    return convert.from_bytes(kind, serialize_message(message))


def codebook_from_ros(message):
    return from_ros(convert.CodebookMessage, message).codebook()


def parameters(values):
    """Return ROS parameters of a mapping; paths are strings."""
    return [Parameter(name, value=str(value) if isinstance(value, Path) else value)
            for name, value in values.items()]
