"""All conversions between the protocol's plain data and ROS messages."""

import array
import dataclasses
import enum
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, Vector3
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.protocol.messages import Message, MessageError, PositionEstimate
from rhs_isac_ros.ros.topics import MAP_FRAME


def ros_type(kind: type[Message]) -> type:
    """Return the ROS type of a message.

    Parameters
    ----------
    kind
        Class of the message.

    Returns
    -------
    type
        The class of `rhs_isac_msgs.msg` with the same name.
    """
    return getattr(ros, kind.__name__)


def to_ros(message: Message, stamp: Time) -> Any:
    """Convert a message to ROS.

    Parameters
    ----------
    message
        The message.
    stamp
        Time for the header, if its type has one.

    Returns
    -------
    Any
        A message of `ros_type`.
    """
    result = ros_type(type(message))()
    for name, encode, _ in _fields(type(message)):
        value = getattr(message, name)
        setattr(result, name, encode(value) if encode else value)
    if hasattr(result, 'header'):
        result.header = Header(stamp=stamp, frame_id=MAP_FRAME)
    return result


def from_ros(kind: type[Message], message: Any) -> Message:
    """Convert a message from ROS.

    Parameters
    ----------
    kind
        Class of the result.
    message
        A message of its `ros_type`.

    Returns
    -------
    Message
        The message; its arrays may share the ROS message's memory.

    Raises
    ------
    MessageError
        If an array does not fill its shape, or a number is none of its constants.
    """
    values = {}
    for name, _, decode in _fields(kind):
        value = getattr(message, name)
        try:
            values[name] = decode(value) if decode else value
        except ValueError as error:
            raise MessageError(f'{kind.__name__}.{name}: {error}') from None
    return kind(**values)


def from_bytes(kind: type[Message], serialized: bytes) -> Message:
    """Convert a message from what a raw subscription gets.

    rclpy drops what it cannot decode without a word; here it is an error like any other.

    Parameters
    ----------
    kind
        Class of the result.
    serialized
        A message of its `ros_type`, in CDR.

    Returns
    -------
    Message
        The message.

    Raises
    ------
    MessageError
        If the bytes are no such message, or as with `from_ros`.
    """
    try:
        message = deserialize_message(serialized, ros_type(kind))
    # What rclpy raises is a RuntimeError without a public name; a string may be no UTF-8.
    except (RuntimeError, ValueError) as error:
        raise MessageError(
            f'{kind.__name__}: {len(serialized)} bytes, expected one in CDR: '
            f'{str(error).splitlines()[0]}') from None
    return from_ros(kind, message)


def codebook_to_ros(codebook: Codebook, stamp: Time) -> ros.Codebook:
    """Convert a codebook to ROS.

    Parameters
    ----------
    codebook
        The codebook.
    stamp
        Time for the header.

    Returns
    -------
    rhs_isac_msgs.msg.Codebook
        The message.
    """
    return ros.Codebook(
        header=Header(stamp=stamp, frame_id=MAP_FRAME), codebook_id=codebook.id,
        analog=_encode_real(codebook.analog), digital=_encode_complex(codebook.digital),
        average_crlb_m2=float(codebook.average_crlb_m2))


def codebook_from_ros(message: ros.Codebook) -> Codebook:
    """Convert a codebook from ROS.

    Parameters
    ----------
    message
        The message.

    Returns
    -------
    Codebook
        The codebook.

    Raises
    ------
    MessageError
        If an array does not fill its shape.
    CodebookError
        If the arrays make no codebook.
    """
    try:
        analog, digital = _decode_real(message.analog), _decode_complex(message.digital)
    except ValueError as error:
        raise MessageError(f'Codebook: {error}') from None
    return Codebook(analog, digital, message.average_crlb_m2)


def pose(estimate: PositionEstimate, stamp: Time) -> PoseWithCovarianceStamped:
    """Return a position estimate as a standard pose; the orientation is unknown.

    Parameters
    ----------
    estimate
        The estimate.
    stamp
        Time for the header.

    Returns
    -------
    geometry_msgs.msg.PoseWithCovarianceStamped
        The pose, with the variance of a uniform angle for each rotation.
    """
    result = PoseWithCovarianceStamped(header=Header(stamp=stamp, frame_id=MAP_FRAME))
    result.pose.pose.position = _encode_vector(Point, estimate.position)
    covariance = np.diag([0.0] * 3 + [math.pi**2 / 3] * 3)
    covariance[:3, :3] = estimate.covariance_m2
    result.pose.covariance = covariance.ravel()
    return result


def _encode_real(values: np.ndarray) -> ros.RealArray:
    return ros.RealArray(
        shape=array.array('I', values.shape), data=array.array('d', values.tobytes()))


def _encode_complex(values: np.ndarray) -> ros.ComplexArray:
    # Filling from bytes is sixty times faster than from an iterable.
    return ros.ComplexArray(
        shape=array.array('I', values.shape), re=array.array('d', values.real.tobytes()),
        im=array.array('d', values.imag.tobytes()))


def _decode_real(message: ros.RealArray) -> np.ndarray:
    return _shaped(message.data, message.shape)


def _decode_complex(message: ros.ComplexArray) -> np.ndarray:
    real, imag = _shaped(message.re, message.shape), _shaped(message.im, message.shape)
    result = np.empty(real.shape, complex)
    result.real, result.imag = real, imag
    return result


def _shaped(values: array.array, shape: array.array) -> np.ndarray:
    if len(values) != math.prod(shape) or not len(values):
        raise ValueError(f'{len(values)} values, expected {list(shape)} of them, at least one')
    return np.frombuffer(values).reshape(tuple(shape))


def _encode_vector(kind: type, values: np.ndarray) -> Any:
    x, y, z = values.tolist()
    return kind(x=x, y=y, z=z)


def _decode_vector(message: Any) -> np.ndarray:
    return np.array([message.x, message.y, message.z])


# How a field of a ROS type is written and read; numbers and strings need nothing.
_CODECS: dict[str, tuple[Callable, Callable]] = {
    'rhs_isac_msgs/RealArray': (_encode_real, _decode_real),
    'rhs_isac_msgs/ComplexArray': (_encode_complex, _decode_complex),
    'geometry_msgs/Point': (functools.partial(_encode_vector, Point), _decode_vector),
    'geometry_msgs/Vector3': (functools.partial(_encode_vector, Vector3), _decode_vector),
    'double[3]': (np.ascontiguousarray, np.asarray),
    'double[4]': (np.ascontiguousarray, np.asarray),
    'double[9]': (np.ravel, lambda values: np.reshape(values, (3, 3))),
}


@functools.cache
def _fields(kind: type[Message]) -> list[tuple[str, Callable | None, Callable | None]]:
    """Name, encoder and decoder of every field."""
    types = ros_type(kind).get_fields_and_field_types()
    result = []
    for field in dataclasses.fields(kind):
        encode, decode = _CODECS.get(types[field.name], (None, None))
        if isinstance(field.type, type) and issubclass(field.type, enum.IntEnum):
            encode, decode = int, field.type
        result.append((field.name, encode, decode))
    return result
