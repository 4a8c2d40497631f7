"""Movement of the users."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from rhs_isac_ros.model.arrays import checked_position, checked_positions, numbers
from rhs_isac_ros.model.hall import PathChannel
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.fields import finite

KINDS = ('static', 'waypoints', 'random_walk')
# Duration of a leg without length.
_STAND_S = 1.0
# After a longer time without a call, legs in between are skipped: a simulated clock may jump from
# 0 to the date of a recording.
_MAX_GAP_S = 3600.0


@runtime_checkable
class Mobility(Protocol):
    """Path of a user: position and velocity as functions of time."""

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the position, float64 [3] [m], and velocity, float64 [3] [m/s].

        The times of successive calls must not decrease. Raises ValueError if one is not finite.
        """
        ...


class Leg(NamedTuple):
    """Straight part of a path between two times: first position [3] [m], velocity [3] [m/s]."""

    origin: np.ndarray
    velocity: np.ndarray
    departure_s: float
    end_s: float


@runtime_checkable
class StraightMobility(Mobility, Protocol):
    """Path of straight legs; a subclass only needs to define `leg`."""

    def leg(self, now_s: float) -> Leg:
        """Return the leg at a time; the times of successive calls must not decrease."""
        ...

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the position [3] [m] and velocity [3] [m/s] on the current leg."""
        leg = self.leg(now_s)
        return leg.origin + leg.velocity * (now_s - leg.departure_s), leg.velocity.copy()


def state_of(mobility: Mobility, now_s: float) -> np.ndarray:
    """Return position and velocity at a time, float64 [2, 3]; see `Mobility.state`.

    Raises PluginError if the mobility returns anything else.
    """
    finite('now_s', now_s)
    with plugins.calling(place := f'{type(mobility).__name__}.state'):
        found = mobility.state(now_s)
    return _vectors(place, found)


def _vectors(place: str, found: Any) -> np.ndarray:
    return numbers(place, found, error=plugins.PluginError, shapes=[(2, 3)])


class Crowd:
    """The paths of many users; all straight legs are evaluated in one array operation."""

    def __init__(self, mobilities: Sequence[Mobility]) -> None:
        self._mobilities = mobilities
        straight = [isinstance(mobility, StraightMobility) for mobility in mobilities]
        self._others = np.flatnonzero(~np.array(straight, bool))
        n = len(mobilities)
        self._origin, self._velocity = np.zeros((n, 3)), np.zeros((n, 3))
        # No leg has begun yet.
        self._departure_s, self._end_s = np.zeros(n), np.where(straight, -math.inf, math.inf)

    def states(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions, float64 [N, 3] [m], and velocities, float64 [N, 3] [m/s].

        The times of successive calls must not decrease. Raises ValueError if one is not finite,
        and PluginError if a mobility of a plug-in fails or returns no valid leg.
        """
        now_s = finite('now_s', now_s)
        for user in np.flatnonzero(now_s >= self._end_s).tolist():
            mobility = self._mobilities[user]
            if isinstance(mobility, StraightMobility):
                with plugins.calling(place := f'{type(mobility).__name__}.leg'):
                    leg = mobility.leg(now_s)
                # A plug-in may return a plain tuple.
                if not isinstance(leg, tuple) or len(leg) != 4 or not leg[2] <= now_s < leg[3]:
                    raise plugins.PluginError(f'{place}: {leg!r}, expected a Leg at {now_s} s')
                self._origin[user], self._velocity[user] = _vectors(place, leg[:2])
                self._departure_s[user], self._end_s[user] = leg[2:]
        velocity = self._velocity.copy()
        position = self._origin + velocity * (now_s - self._departure_s)[:, None]
        for user in self._others.tolist():
            position[user], velocity[user] = state_of(self._mobilities[user], now_s)
        return position, velocity


class Static(StraightMobility):
    """A user that stands still at a position, float64 [3] [m]."""

    def __init__(self, position: ArrayLike) -> None:
        self._position = checked_position(position)

    def leg(self, now_s: float) -> Leg:
        """Return a leg that never ends."""
        return Leg(self._position, np.zeros(3), finite('now_s', now_s), math.inf)


class Walk(StraightMobility):
    """A user that walks straight from each position of a sequence, float64 [3] [m], to the next.

    The speed is constant. Where a position follows itself, the user stands for `_STAND_S`. Legs
    that would have ended more than `_MAX_GAP_S` before a call are skipped.
    """

    def __init__(self, positions: Iterator[np.ndarray], speed_mps: float) -> None:
        self._speed_mps = finite('speed_mps', speed_mps, 0.0)
        self._positions, self._target = positions, next(positions)
        self._leg: Leg | None = None

    def leg(self, now_s: float) -> Leg:
        """Return the current leg; the next one begins when it ends."""
        now_s = finite('now_s', now_s)
        if self._leg is None:
            self._leg = self._next(now_s)
        while now_s >= self._leg.end_s:
            self._leg = self._next(max(self._leg.end_s, now_s - _MAX_GAP_S))
        return self._leg

    def _next(self, departure_s: float) -> Leg:
        """Return the leg from the last target to the next one."""
        origin, self._target = self._target, next(self._positions)
        way = self._target - origin
        length = float(np.linalg.norm(way))
        if length == 0:
            return Leg(origin, way, departure_s, departure_s + _STAND_S)
        duration_s = length / self._speed_mps if self._speed_mps else math.inf
        return Leg(origin, way / length * self._speed_mps, departure_s, departure_s + duration_s)


class Waypoints(Walk):
    """A user that follows a closed polygon of waypoints, float64 [N, 3] [m]."""

    def __init__(self, waypoints: ArrayLike, speed_mps: float) -> None:
        super().__init__(itertools.cycle(checked_positions(waypoints)), speed_mps)


class RandomWalk(Walk):
    """A user that walks between random positions from `Scenario.sample_positions`.

    The first position is also random, unless it is given as `start`, float64 [3] [m].
    """

    def __init__(
            self, scenario: Scenario, speed_mps: float, rng: np.random.Generator,
            start: ArrayLike | None = None) -> None:
        first = [] if start is None else [checked_position(start, 'start')]
        drawn = (scenario.sample_positions(1, rng)[0] for _ in itertools.count())
        super().__init__(itertools.chain(first, drawn), speed_mps)


class Traced:
    """Path of another mobility with its positions moved to the nearest users of a channel file."""

    def __init__(self, mobility: Mobility, channel: PathChannel) -> None:
        self._mobility, self._channel = mobility, channel

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the moved position [3] [m], and the velocity [3] [m/s] of the other mobility."""
        position, velocity = state_of(self._mobility, now_s)
        return self._channel.users[self._channel.nearest(position[None])[0]].copy(), velocity


def make_plugin(
        name: Any, scenario: Scenario, speed_mps: float, rng: np.random.Generator,
        start: Sequence[float] | None = None) -> Mobility:
    """Create a mobility from a plug-in of the group `plugins.MOBILITIES`.

    `name` is that of an entry point, ``module:name``, or the class or callable itself. The plug-in
    is called with the arguments of `RandomWalk`. If `start` is None, the plug-in chooses the first
    position. Raises PluginError if there is no such plug-in, it fails, or it does not return a
    mobility.
    """
    return plugins.make(
        plugins.MOBILITIES, name, Mobility, scenario, speed_mps, rng, start)
