"""The executable ``user``: one or many users of the system."""

import sys
from typing import Any

import numpy as np

from rhs_isac_ros.model import mobility, plugins, streams
from rhs_isac_ros.protocol.user import User, timeouts
from rhs_isac_ros.ros.endpoints import steady_timer
from rhs_isac_ros.ros.parameters import ParameterError
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class UserNode(RoleNode[User]):
    """One or many users of the network."""

    def __init__(self, name: str = '', **node_options: Any) -> None:
        super().__init__('user', name, **node_options)
        values = self.values
        self.start(User(
            self._mobilities(), timeouts(values.step_timeout_s, values.beacon_timeout_s),
            self.instance))
        steady_timer(self, values.ground_truth_period_s, self._publish_ground_truth)

    def _mobilities(self) -> dict[int, mobility.Mobility]:
        """Return the mobility of each user by id."""
        values = self.values
        count = values.user_count
        starts = self._points('position_m')
        if len(starts) not in (0, count):
            one = 'one or none' if count == 1 else f'{count}, one for each user, or none'
            raise ParameterError(f'position_m: {len(starts)} points, expected {one}')
        if values.mobility == 'waypoints' and count > 1:
            raise ParameterError(f'user_count: {count}, expected 1 with mobility waypoints')
        users = {values.user_id + n: self._mobility(
            values.user_id + n, starts[n] if len(starts) else None) for n in range(count)}
        if channel := self.scenario.channel:
            return {user: mobility.Traced(path, channel) for user, path in users.items()}
        return users

    def _mobility(self, user: int, position: np.ndarray | None) -> mobility.Mobility:
        """Return the mobility of a user that starts at `position`; None: anywhere."""
        values = self.values
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
        role, now_s = self.role, self.now_s()
        self.publish(role.ground_truths(now_s) if len(role.users) > 1
                     else role.ground_truth(role.users[0], now_s))


main = entry('user', lambda: [UserNode()])


if __name__ == '__main__':
    sys.exit(main())
