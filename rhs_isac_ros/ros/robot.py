"""Users whose positions come from a robot or a simulation: its odometry, or a frame of tf2."""

import time
from collections.abc import Callable

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.time import Time

from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import SENSOR, create_or_refuse, steady_timer, subscribe
from rhs_isac_ros.ros.frames import Frame, rotation_matrix, vector
from rhs_isac_ros.support.fields import ParameterError

# Period at which a frame is looked up [s].
_LOOKUP_S = 0.02
# Maximum difference between a stamp and the clock of the node [s].
_MAX_AGE_S = 5.0


class RobotMobility:
    """Mobility of a robot: the latest position, continued with its velocity.

    Parameters
    ----------
    source
        Description of where the positions come from.
    timeout_s
        Time without a position after which there is none [s].
    """

    def __init__(self, node: Node, frame: Frame, source: str, timeout_s: float) -> None:
        self._clock, self._frame = node.get_clock(), frame
        self._source, self._timeout_s = source, timeout_s
        self._error = ''
        self._arrived_s, self._stamp_ns = -np.inf, 0
        self._position, self._velocity = np.full(3, np.nan), np.zeros(3)

    def put(self, stamp_ns: int, position: np.ndarray, velocity: np.ndarray) -> None:
        """Store a position [3] [m] and a velocity [3] [m/s] in the frame of standard messages."""
        self._error = ''
        self._arrived_s = time.monotonic()
        self._stamp_ns = stamp_ns or self._clock.now().nanoseconds
        self._position = self._frame.to_surface(position)
        self._velocity = self._frame.rotation.T @ velocity

    def reject(self, error: str) -> None:
        """Store why a position cannot be used."""
        self._error = error

    @property
    def lack(self) -> str:
        """Why there is no position at present; empty if there is one."""
        if self._error:
            return f'{self._source}: {self._error}'
        if time.monotonic() > self._arrived_s + self._timeout_s:
            return self._source
        if abs(self._age_s()) > _MAX_AGE_S:
            return (f'{self._source}: its stamps differ from the clock of this node by '
                    f'{self._age_s():.0f} s; set use_sim_time alike')
        if not self.state(0.0)[0][0] > 0:
            return f'{self._source}: a position in front of the surface'
        return ''

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position [3] [m] and velocity [3] [m/s] in the frame of the surface, now."""
        age_s = min(max(self._age_s(), 0.0), self._timeout_s)
        return self._position + age_s * self._velocity, self._velocity.copy()

    def _age_s(self) -> float:
        return 1e-9 * (self._clock.now().nanoseconds - self._stamp_ns)


def follow_odometry(node: Node, frame: Frame, topic: str, timeout_s: float) -> RobotMobility:
    """Return the mobility of a robot that publishes its odometry in the frame `frame`."""
    full_name = node.resolve_topic_name(topic)
    mobility = RobotMobility(node, frame, f'odometry on {full_name}', timeout_s)

    def receive(message: Odometry) -> None:
        if message.header.frame_id != frame.name:
            mobility.reject(f'in the frame {message.header.frame_id!r}, expected frame_id = '
                            f'{frame.name!r}')
            return
        turn = message.pose.pose.orientation
        orientation = np.array([turn.x, turn.y, turn.z, turn.w])
        if not np.linalg.norm(orientation) > 0:
            mobility.reject(f'orientation {orientation.tolist()}, expected a quaternion')
            return
        # The velocity is in the frame of the robot.
        mobility.put(Time.from_msg(message.header.stamp).nanoseconds,
                     vector(message.pose.pose.position),
                     rotation_matrix(orientation) @ vector(message.twist.twist.linear))
    # Drivers and simulators often publish best effort.
    subscribe(node, Odometry, topic, receive, SENSOR, overridable=True)
    return mobility


def follow_frame(node: Node, frame: Frame, child: str, timeout_s: float) -> RobotMobility:
    """Return the mobility of a frame of tf2; its velocity is the difference of two transforms.

    Raises
    ------
    ParameterError
        If ``tf2_ros`` is not installed.
    """
    try:
        import tf2_ros
    except ImportError:
        raise ParameterError(
            "mobility: 'tf', expected 'odometry' or a built-in mobility, because tf2_ros is not "
            'installed; it comes with a ROS 2 installation, but not as a wheel') from None
    mobility = RobotMobility(node, frame, f'transform from {frame.name} to {child}', timeout_s)
    buffer = tf2_ros.Buffer(node=node)
    listener = create_or_refuse(
        node, f'subscription to {topics.TF}', lambda: tf2_ros.TransformListener(buffer, node))
    steady_timer(node, _LOOKUP_S, _lookup(mobility, buffer, listener, frame.name, child))
    return mobility


def _lookup(
        mobility: RobotMobility, buffer: object, listener: object, parent: str, child: str
) -> Callable[[], None]:
    last: list[tuple[int, np.ndarray]] = []

    def look() -> None:
        # The listener lives as long as this function.
        if not listener or not buffer.can_transform(parent, child, Time()):  # type: ignore[attr-defined]
            return
        found = buffer.lookup_transform(parent, child, Time())  # type: ignore[attr-defined]
        stamp_ns = Time.from_msg(found.header.stamp).nanoseconds
        position = vector(found.transform.translation)
        before_ns, before = last[0] if last else (stamp_ns, position)
        if last and stamp_ns == before_ns:
            return
        last[:] = [(stamp_ns, position)]
        elapsed_s = 1e-9 * (stamp_ns - before_ns)
        velocity = (position - before) / elapsed_s if elapsed_s > 0 else np.zeros(3)
        mobility.put(stamp_ns, position, velocity)
    return look
