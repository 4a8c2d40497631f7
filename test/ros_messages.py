"""Messages of the protocol as ROS messages, as another program publishes and receives them."""

from rclpy.serialization import deserialize_message, serialize_message

from rhs_isac_ros.ros import convert


def to_ros(message, stamp=None, identity=None):
    """Convert a dataclass to a ROS message; the identity is as in `convert.to_bytes`."""
    stamp_ns = 10**9 * stamp.sec + stamp.nanosec if stamp is not None else 0
    return deserialize_message(
        convert.to_bytes(message, stamp_ns, identity), convert.ros_type(type(message)))


def from_ros(kind, message):
    return convert.from_bytes(kind, serialize_message(message))


def codebook_from_ros(message):
    return from_ros(convert.CodebookMessage, message).codebook()
