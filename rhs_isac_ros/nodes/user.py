"""The executable ``user``: one or many users of the network."""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.node import Node
from rclpy.time import Time

from rhs_isac_ros.model import Pose, mobility
from rhs_isac_ros.model.arrays import position_problem
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.geometry import reference_s
from rhs_isac_ros.model.pose import rotation_matrix
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user import User
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros import convert, endpoints, topics
from rhs_isac_ros.ros.cdr import check_floats
from rhs_isac_ros.ros.convert import vector
from rhs_isac_ros.ros.parameters import ODOMETRY, ROBOTS
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support import plugins, streams
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import ParameterError

# Period of looking up a frame, and of checking whether a robot has a position [s]; the same while
# it has none.
_LOOKUP_S, _ABSENT_S = 0.02, 0.5
# Minimum period at which the true positions of users at rest are published [s].
_REST_S = 5.0
# Maximum difference between a stamp and the clock of the node [s].
_MAX_AGE_S = 5.0
# Time in which positions in two frames, or with stamps of two clocks, come from two sources [s],
# and maximum number of frames that are compared.
_SOURCES_S, _MAX_ORIGINS = 1.0, 8


class RobotMobility:
    """Mobility of a robot: the latest position, extrapolated with the velocity.

    `source` describes the origin of the positions. A position is valid for `timeout_s` [s].
    `pose` is the pose of the surface.
    """

    def __init__(self, node: Node, pose: Pose, source: str, timeout_s: float) -> None:
        self._clock, self._pose = node.get_clock(), pose
        self._source, self._timeout_s = source, timeout_s
        self._error = ''
        #: Called after each position, also one that is unusable.
        self.on_change: Callable[[], None] = lambda: None
        # Time of the latest position [s] by its origin: its frame, and whether its stamp fits.
        self._origins: dict[tuple[str, bool], float] = {}
        self._arrived_s, self._stamp_ns = -np.inf, 0
        self._position, self._velocity = np.full(3, np.nan), np.zeros(3)

    def put(self, stamp_ns: int, position: np.ndarray, velocity: np.ndarray) -> None:
        """Store a position [3] [m] and a velocity [3] [m/s]; a stamp of 0 means now."""
        if not (np.isfinite(position) & (np.abs(velocity) <= SPEED_OF_LIGHT_MPS)).all():
            self.reject(f'position {position.tolist()} m, velocity {velocity.tolist()} m/s, '
                        'expected finite numbers, and at most the speed of light')
            return
        try:
            check_floats(position)
        except ValueError as error:
            self.reject(f'position: {error}')
            return
        self._error = ''
        self._arrived_s = time.monotonic()
        self._stamp_ns = stamp_ns or self._clock.now().nanoseconds
        self._origins['', abs(self._age_s()) <= _MAX_AGE_S] = self._arrived_s
        self._position = self._pose.to_surface(position)
        self._velocity = self._pose.vectors_to_surface(velocity)
        self.on_change()

    def reject(self, error: str, frame: str = '') -> None:
        """Store the reason why a position, in another frame if `frame` is given, is unusable."""
        self._error = error
        if frame and len(self._origins) < _MAX_ORIGINS:
            self._origins[frame, True] = time.monotonic()
        self.on_change()

    @property
    def lack(self) -> str:
        """Description of what is missing for a valid position; empty if the position is valid."""
        begin_s = time.monotonic() - _SOURCES_S
        self._origins = {one: last_s for one, last_s in self._origins.items() if last_s > begin_s}
        if len(self._origins) > 1:
            return f'{self._source}: from two sources, expected one'
        if self._error:
            return f'{self._source}: {self._error}'
        if time.monotonic() > self._arrived_s + self._timeout_s:
            return self._source
        if abs(self._age_s()) > _MAX_AGE_S:
            return (f'{self._source}: its stamps differ from the clock of this node by '
                    f'{self._age_s():.0f} s; set use_sim_time alike')
        position, _ = self.state(0.0)
        problem = position_problem(position)
        if not problem and np.abs(position).max() > m.MAX_COORDINATE_M:
            problem = (f'{np.abs(position).max():g} m from the surface, expected coordinates up '
                       f'to {m.MAX_COORDINATE_M:g} m')
        return f'{self._source}: {problem}' if problem else ''

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the current position [3] [m] and velocity [3] [m/s] in the surface's frame."""
        age_s = min(max(self._age_s(), 0.0), self._timeout_s)
        return self._position + age_s * self._velocity, self._velocity.copy()

    def _age_s(self) -> float:
        return 1e-9 * (self._clock.now().nanoseconds - self._stamp_ns)


def follow_odometry(
        node: Node, frame: str, pose: Pose, topic: str, timeout_s: float) -> RobotMobility:
    """Return the mobility of a robot that publishes odometry in the frame `frame` on a topic."""
    try:
        full_name = node.resolve_topic_name(topic)
    except RuntimeError as error:
        reason = str(error).partition(', at ')[0].removeprefix('failed to resolve name: ')
        raise ParameterError(f'odometry_topic: {topic!r}: {reason}') from None
    mobility = RobotMobility(node, pose, f'odometry on {full_name}', timeout_s)

    def receive(message: Odometry) -> None:
        if message.header.frame_id != frame:
            mobility.reject(f'in the frame {message.header.frame_id!r}, expected frame_id = '
                            f'{frame!r}', message.header.frame_id)
            return
        turn = message.pose.pose.orientation
        try:
            rotation = rotation_matrix(np.array([turn.x, turn.y, turn.z, turn.w]))
        except ValueError as error:
            mobility.reject(f'orientation: {error}')
            return
        # The velocity is in the frame of the robot.
        mobility.put(convert.nanoseconds(message.header.stamp),
                     vector(message.pose.pose.position),
                     rotation @ vector(message.twist.twist.linear))
    # Drivers and simulators often publish best effort.
    endpoints.subscribe(node, Odometry, topic, receive, endpoints.SENSOR, overridable=True)
    return mobility


def follow_frame(
        node: Node, frame: str, pose: Pose, child: str, timeout_s: float) -> RobotMobility:
    """Return the mobility of the frame `child` in tf2; consecutive transforms give the velocity.

    Raises ParameterError if ``tf2_ros`` is not installed.
    """
    try:
        import tf2_ros
    except ImportError:
        raise ParameterError(
            "mobility: 'tf', expected 'odometry' or a built-in mobility, because tf2_ros is not "
            'installed; it comes with a ROS 2 installation, but not as a wheel') from None
    mobility = RobotMobility(node, pose, f'transform from {frame} to {child}', timeout_s)

    def listen() -> tuple[Any, Any]:
        # The buffer also creates a service, which may be refused.
        buffer = tf2_ros.Buffer(node=node)
        return buffer, tf2_ros.TransformListener(buffer, node)
    source = endpoints.create_or_refuse(node, f'subscription to {topics.TF}', listen)
    last: list[tuple[int, np.ndarray]] = []

    def look() -> float:
        # The reference keeps the listener alive.
        if not source or not (buffer := source[0]).can_transform(frame, child, Time()):
            return _ABSENT_S
        found = buffer.lookup_transform(frame, child, Time())
        stamp_ns = convert.nanoseconds(found.header.stamp)
        position = vector(found.transform.translation)
        before_ns, before = last[0] if last else (stamp_ns, position)
        if last and stamp_ns == before_ns:
            return _LOOKUP_S
        last[:] = [(stamp_ns, position)]
        elapsed_s = 1e-9 * (stamp_ns - before_ns)
        velocity = (position - before) / elapsed_s if elapsed_s > 0 else np.zeros(3)
        mobility.put(stamp_ns, position, velocity)
        return _LOOKUP_S
    endpoints.steady_timer(node, _LOOKUP_S, look)
    return mobility


class UserNode(RoleNode[User]):
    """The ROS node of one or more users."""

    # The mobility of the robot, if the user is a robot.
    _robot: RobotMobility | None = None

    def __init__(self, name: str = '', **node_options: Any) -> None:
        super().__init__('user', name, **node_options)
        values = self.values
        mobilities = self._mobilities()
        self._reference_s = reference_s(self.scenario)
        self.start(User(
            mobilities, self.scenario, values.step_timeout_s, values.beacon_timeout_s,
            self.instance, self.clocks.world_s))
        self._true_odometry = endpoints.UserTopics(
            self, {topics.TRUE_ODOMETRY: Odometry}, values.user_topics)
        # On the clock of ROS, like the mobilities.
        self._truth_timer = self.create_timer(
            values.ground_truth_period_s, self._publish_ground_truth)
        if robot := self._robot:
            watch = functools.partial(self._watch_robot, robot)
            timer = endpoints.steady_timer(self, watch(), watch)
            robot.on_change = lambda: endpoints.set_period(timer, watch())

    def _mobilities(self) -> dict[int, mobility.Mobility]:
        values = self.values
        count = values.user_count
        if values.user_id + count - 1 > MAX_USERS:
            raise ParameterError(
                f'user_count: {count}, expected at most {MAX_USERS - values.user_id + 1} with '
                f'user_id {values.user_id}, because user numbers end at {MAX_USERS}')
        starts = self._points('position_m')
        if len(starts) not in (0, count):
            one = 'one or none' if count == 1 else f'{count}, one for each user, or none'
            raise ParameterError(f'position_m: {len(starts)} points, expected {one}')
        if values.mobility in ('waypoints', *ROBOTS):
            if count > 1:
                raise ParameterError(
                    f'user_count: {count}, expected 1 with mobility {values.mobility}')
            if len(starts):
                raise ParameterError(
                    f'position_m: given, expected none with mobility {values.mobility}')
        users = {values.user_id + n: self._mobility(
            values.user_id + n, starts[n] if len(starts) else None) for n in range(count)}
        if channel := self.scenario.channel:
            return {user: mobility.Traced(path, channel) for user, path in users.items()}
        return users

    def _mobility(self, user: int, position: np.ndarray | None) -> mobility.Mobility:
        """Return the mobility of a user, which starts at `position` unless this is None."""
        values = self.values
        if values.mobility in ROBOTS:
            follow, source = ((follow_odometry, values.odometry_topic)
                              if values.mobility == ODOMETRY else
                              (follow_frame, values.robot_frame))
            self._robot = follow(
                self, self.frame.name, self.scenario.pose, source, values.robot_timeout_s)
            return self._robot
        is_moving = values.mobility != 'static'
        if is_moving and values.speed_mps > self.scenario.max_user_speed_mps:
            raise ParameterError(
                f'speed_mps: {values.speed_mps}, expected at most max_user_speed_mps = '
                f'{self.scenario.max_user_speed_mps:g} m/s of the scenario')
        rng = streams.generator(values.seed, streams.USER, user)
        if values.mobility == 'waypoints':
            waypoints = self._points('waypoints_m')
            if not len(waypoints):
                raise ParameterError('waypoints_m: empty, expected x, y, z of the first point')
            return mobility.Waypoints(waypoints.tolist(), values.speed_mps)
        if values.mobility == 'random_walk':
            return mobility.RandomWalk(self.scenario, values.speed_mps, rng, position)
        if values.mobility == 'static':
            return mobility.Static(
                self.scenario.sample_positions(1, rng)[0] if position is None else position)
        with translated(plugins.PluginError, ParameterError, 'mobility'):
            return mobility.make_plugin(
                values.mobility, self.scenario, values.speed_mps, rng,
                None if position is None else position.tolist())

    def _points(self, name: str) -> np.ndarray:
        """Return the points of a parameter in the frame of the surface, [N, 3].

        Raises ParameterError if a point is not in front of the surface.
        """
        numbers = np.array(getattr(self.values, name))
        if numbers.size % 3:
            raise ParameterError(f'{name}: {numbers.size} numbers, expected three for each point')
        given = numbers.reshape(-1, 3)
        points = self.scenario.pose.to_surface(given)
        if not (points[:, 0] > 0).all():
            raise ParameterError(
                f'{name}: {given.tolist()}, expected points in front of the surface, x > 0')
        low, high = self.scenario.roi_bounds_m
        if not ((points >= low) & (points <= high)).all():
            endpoints.log(
                self, f'{name}: {given.tolist()}: outside of the region of interest, '
                f'{low.tolist()} to {high.tolist()} in the frame of the surface; a user there '
                'gets no position', LoggingSeverity.WARN)
        return points

    def publish(self, message: m.Message) -> bool:
        """Publish a message; a true position in a cycle has the stamp of the reference time."""
        if isinstance(message, m.GroundTruth) and message.cycle_id:
            stamp = self.get_clock().now() + Duration(seconds=self._reference_s)
            message = dataclasses.replace(message, stamp_ns=stamp.nanoseconds)
        return super().publish(message)

    def _publish_ground_truth(self) -> None:
        if self._robot and self._robot.lack:
            return
        role, now_s, stamp = self.role, self.now_s(), self.get_clock().now().to_msg()
        with endpoints.surviving(self):
            self._publish_truths(role.ground_truths(now_s), stamp)

    def _publish_truths(self, truths: m.GroundTruths, stamp: Time) -> None:
        period_s = self.values.ground_truth_period_s
        endpoints.set_period(self._truth_timer, period_s if self._robot or truths.velocity.any()
                             else max(period_s, _REST_S))
        self.publish(truths if len(self.role.users) > 1 else next(truths.each()))
        for truth in truths.each():
            endpoints.publish_if_subscribed(
                self._true_odometry.publishers(truth.user), functools.partial(
                    convert.true_odometry, truth.user, truth.position, truth.velocity, stamp,
                    self.frame))

    def _watch_robot(self, robot: RobotMobility) -> float:
        """Report what the robot lacks, and return the time until the next check [s]."""
        self.set_lacking(lack := robot.lack)
        return _ABSENT_S if lack else _LOOKUP_S


main = entry('user', lambda: [UserNode()])
