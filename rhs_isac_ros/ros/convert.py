"""Conversions between the dataclasses of the protocol and ROS messages."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.protocol.events import PublishTrack
from rhs_isac_ros.protocol.messages import Message, MessageError, PositionEstimate
from rhs_isac_ros.protocol.presences import Presence
from rhs_isac_ros.ros import cdr
from rhs_isac_ros.ros.topics import NAMES, RHS_FRAME, Frame

# Variance of an unknown angular velocity [rad^2/s^2], a value that ROS drivers often use.
_UNKNOWN_ROTATION_VARIANCE = 1e6


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class CodebookMessage:
    """The announcement of a codebook; `sender` and `scenario_id` are as in `Message`."""

    sender: int = 0
    scenario_id: str = ''
    codebook_id: str
    analog: np.ndarray
    digital: np.ndarray
    average_crlb_m2: float

    @classmethod
    def of(cls, codebook: Codebook, sender: int = 0, scenario_id: str = '') -> 'CodebookMessage':
        """Return the announcement of a codebook."""
        return cls(
            sender=sender, scenario_id=scenario_id, codebook_id=codebook.id,
            analog=codebook.analog, digital=codebook.digital,
            average_crlb_m2=codebook.average_crlb_m2)

    def codebook(self) -> Codebook:
        """Return the codebook, or raise CodebookError if it is invalid."""
        return Codebook(self.analog, self.digital, self.average_crlb_m2)


_ROS_TYPES: dict[type, Any] = {
    **{kind: getattr(ros, kind.__name__) for kind in NAMES},
    CodebookMessage: ros.Codebook, Presence: ros.Presence}
_CODECS = {kind: cdr.Codec(kind, own.get_fields_and_field_types())
           for kind, own in _ROS_TYPES.items()}
_MessageT = TypeVar('_MessageT', bound=Message | CodebookMessage | Presence)


def ros_type(kind: type[_MessageT]) -> Any:
    """Return the class in `rhs_isac_msgs.msg` for a dataclass."""
    return _ROS_TYPES[kind]


def to_bytes(
        message: _MessageT, stamp_ns: int, identity: tuple[int, str] | None = None,
        frame: str = RHS_FRAME) -> bytes:
    """Serialize a message (CDR) for a publisher of `ros_type`.

    The header contains `stamp_ns` and `frame`. `identity`, if given, replaces the fields `sender`
    and `scenario_id` of the message. Raises MessageError if a string has no UTF-8 encoding, or the
    stamp is out of range.
    """
    sender, scenario_id = identity or (message.sender, message.scenario_id)
    return _CODECS[type(message)].encode(message, frame, stamp_ns, sender, scenario_id)


def from_bytes(kind: type[_MessageT], serialized: bytes) -> _MessageT:
    """Convert a serialized message (CDR) from a raw subscription.

    Raises MessageError if the bytes are not a message of `ros_type` in little-endian byte order,
    an array has the wrong number of values, or the stamp or the value of an enumeration is
    invalid. Subscriptions of rclpy that are not raw silently drop bytes that they cannot
    deserialize.
    """
    return _CODECS[kind].decode(serialized)


def frame_of(serialized: bytes) -> str:
    """Return the frame of a message that `from_bytes` has converted; empty if it has none."""
    return cdr.frame_of(serialized)


def extension(own: type, n_fields: int) -> Callable[[bytes], bytes] | None:
    """Return a function that adds the last fields to serialized messages of an earlier version.

    `own` is a ROS type, of which the messages have the first `n_fields`; see
    `cdr.Codec.extension`.
    """
    codec = next((codec for kind, codec in _CODECS.items() if _ROS_TYPES[kind] is own), None)
    return codec.extension(n_fields) if codec else None


def deserialize(content: bytes, kind: type) -> Any:
    """Return a message of any ROS type; raise MessageError if it has no valid serialization."""
    try:
        return deserialize_message(content, kind)
    except rclpy_implementation.RMWError as error:
        raise MessageError(f'{kind.__name__}: {str(error).partition(",")[0]}') from error


def vector(message: Any) -> np.ndarray:
    """Return a point or a vector of ROS as an array [3]."""
    return np.array([message.x, message.y, message.z])


def to_ros(kind: Any, numbers: np.ndarray) -> Any:
    """Return a point, vector or quaternion of ROS with the given x, y, z and (if any) w."""
    return kind(**dict(zip('xyzw', numbers.tolist(), strict=False)))


def nanoseconds(stamp: Time) -> int:
    """Return any stamp [ns]; a time of rclpy cannot be negative, but a stamp can."""
    return 10**9 * int(stamp.sec) + int(stamp.nanosec)


def stamp_of(message: Message | PublishTrack, node: Any) -> Time:
    """Return the stamp of a message, or the current time of a node if the stamp is unknown."""
    if not message.stamp_ns:
        return node.get_clock().now().to_msg()
    return Time(sec=message.stamp_ns // 10**9, nanosec=message.stamp_ns % 10**9)


def pose(estimate: PositionEstimate, stamp: Time, frame: Frame) -> PoseWithCovarianceStamped:
    """Return a position estimate as a pose of unknown orientation.

    Each rotation angle has the variance of a uniform distribution from -pi to pi.
    """
    result = PoseWithCovarianceStamped(header=Header(stamp=stamp, frame_id=frame.name))
    result.pose.pose.position = to_ros(Point, estimate.position)
    result.pose.covariance = _with_rotation(estimate.covariance_m2, math.pi**2 / 3)
    return result


def odometry(
        user: int, estimate: Estimate, stamp: Time, frame: Frame) -> Odometry:
    """Return a track as odometry, with unknown orientation and angular velocity.

    The child frame, in which the velocity is given, has the same axes as `frame`.
    """
    result = true_odometry(user, estimate.mean, estimate.velocity, stamp, frame)
    result.pose.covariance = _with_rotation(estimate.covariance, math.pi**2 / 3)
    result.twist.covariance = _with_rotation(
        estimate.velocity_covariance, _UNKNOWN_ROTATION_VARIANCE)
    return result


def true_odometry(
        user: int, position: np.ndarray, velocity: np.ndarray, stamp: Time, frame: Frame
) -> Odometry:
    """Return a true position [3] [m] and velocity [3] [m/s] as odometry without covariances."""
    result = Odometry(header=Header(stamp=stamp, frame_id=frame.name),
                      child_frame_id=frame.user(user))
    result.pose.pose.position = to_ros(Point, position)
    result.twist.twist.linear = to_ros(Vector3, velocity)
    return result


def _with_rotation(covariance: np.ndarray, variance: float) -> np.ndarray:
    """Append three independent rotations of equal variance to a covariance [3, 3]; return [36]."""
    both = variance * np.eye(6)
    both[:3, :3] = covariance
    return both.ravel()
