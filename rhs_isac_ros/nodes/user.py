"""The executable ``user``: one or many users of the system."""

import functools
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry

from rhs_isac_ros.model import mobility
from rhs_isac_ros.protocol.user import User
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import UserTopics, create_timer, steady_timer
from rhs_isac_ros.ros.frames import Frame
from rhs_isac_ros.ros.parameters import ODOMETRY, ROBOTS
from rhs_isac_ros.ros.robot import RobotMobility, follow_frame, follow_odometry
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support import plugins, streams
from rhs_isac_ros.support.fields import ParameterError

# Period at which the positions of a robot are watched [s].
_WATCH_S = 0.1


class UserNode(RoleNode[User]):
    """One or many users of the network."""

    # The mobility of a robot, if the user is one.
    _robot: RobotMobility | None = None

    def __init__(self, name: str = '', **node_options: Any) -> None:
        super().__init__('user', name, **node_options)
        values = self.values
        self._frame = Frame.of(self, values)
        mobilities = self._mobilities()
        self.start(User(
            mobilities, values.step_timeout_s, values.beacon_timeout_s, self.instance,
            self.clocks.world_s))
        self._true_odometry = UserTopics(
            self, {topics.TRUE_ODOMETRY: Odometry}, values.user_topics)
        # On the clock of ROS, as the mobilities.
        create_timer(self, values.ground_truth_period_s, self._publish_ground_truth)
        if robot := self._robot:
            self._watch_robot(robot)
            steady_timer(self, _WATCH_S, functools.partial(self._watch_robot, robot))

    def _mobilities(self) -> dict[int, mobility.Mobility]:
        """Return the mobility of each user by id."""
        values = self.values
        count = values.user_count
        starts = self._points('position_m')
        if len(starts) not in (0, count):
            one = 'one or none' if count == 1 else f'{count}, one for each user, or none'
            raise ParameterError(f'position_m: {len(starts)} points, expected {one}')
        if values.mobility in ('waypoints', *ROBOTS) and count > 1:
            raise ParameterError(
                f'user_count: {count}, expected 1 with mobility {values.mobility}')
        users = {values.user_id + n: self._mobility(
            values.user_id + n, starts[n] if len(starts) else None) for n in range(count)}
        if channel := self.scenario.channel:
            return {user: mobility.Traced(path, channel) for user, path in users.items()}
        return users

    def _mobility(self, user: int, position: np.ndarray | None) -> mobility.Mobility:
        """Return the mobility of a user that starts at `position`; None: anywhere."""
        values = self.values
        if values.mobility in ROBOTS:
            if position is not None:
                raise ParameterError(
                    f'position_m: given, expected none with mobility {values.mobility}')
            follow, source = ((follow_odometry, values.odometry_topic)
                              if values.mobility == ODOMETRY else
                              (follow_frame, values.robot_frame))
            self._robot = follow(self, self._frame, source, values.robot_timeout_s)
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
            if position is not None:
                raise ParameterError('position_m: given, expected none with mobility waypoints')
            return mobility.Waypoints(waypoints.tolist(), values.speed_mps)
        if values.mobility == 'random_walk':
            return mobility.RandomWalk(self.scenario, values.speed_mps, rng, position)
        if values.mobility == 'static':
            return mobility.Static(
                self.scenario.sample_positions(1, rng)[0] if position is None else position)
        try:
            return mobility.make_plugin(
                values.mobility, self.scenario, values.speed_mps, rng,
                None if position is None else position.tolist())
        except plugins.PluginError as error:
            raise ParameterError(f'mobility: {error}') from None

    def _points(self, name: str) -> np.ndarray:
        """Return the points of a parameter, [N, 3], checked to be in front of the surface."""
        numbers = np.array(getattr(self.values, name))
        if numbers.size % 3:
            raise ParameterError(f'{name}: {numbers.size} numbers, expected three for each point')
        points = numbers.reshape(-1, 3)
        if not (points[:, 0] > 0).all():
            raise ParameterError(
                f'{name}: {points.tolist()}, expected points in front of the surface, x > 0')
        low, high = self.scenario.roi_bounds_m
        if not ((points >= low) & (points <= high)).all():
            self.get_logger().warning(  # type: ignore[no-untyped-call]
                f'{name}: {points.tolist()}: outside of the region of interest, {low.tolist()} to '
                f'{high.tolist()}; a user there gets no position')
        return points

    def _publish_ground_truth(self) -> None:
        if self._robot and self._robot.lack:
            return
        role, now_s, stamp = self.role, self.now_s(), self.get_clock().now().to_msg()
        truths = role.ground_truths(now_s)
        self.publish(truths if len(role.users) > 1 else next(truths.each()))
        for truth in truths.each():
            for publisher in self._true_odometry.publishers(truth.user):
                if publisher.get_subscription_count():
                    publisher.publish(convert.true_odometry(
                        truth.user, truth.position, truth.velocity, stamp, self._frame))

    def _watch_robot(self, robot: RobotMobility) -> None:
        self.set_lacking(robot.lack)


main = entry('user', lambda: [UserNode()])
