"""How users move."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from rhs_isac_ros.model import plugins
from rhs_isac_ros.model.los import checked_positions
from rhs_isac_ros.model.scenario import Scenario

KINDS = ('static', 'waypoints', 'random_walk')


class Mobility(Protocol):
    """Where a user is."""

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity; the times of successive calls never go back.

        Parameters
        ----------
        now_s
            The time [s].

        Returns
        -------
        tuple of numpy.ndarray
            Position, float64 [3] [m], and velocity, float64 [3] [m/s].
        """
        ...


class Static:
    """A user that stands still.

    Parameters
    ----------
    position
        Where, float64 [3] [m].
    """

    def __init__(self, position: Sequence[float]) -> None:
        self._position = checked_positions([position])[0]

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position [3] [m] and velocity [3] [m/s].

        Parameters
        ----------
        now_s
            The time [s].

        Returns
        -------
        tuple of numpy.ndarray
            Position and velocity.
        """
        return self._position.copy(), np.zeros(3)


class Waypoints:
    """A user that goes round a closed line of waypoints at a steady speed.

    Parameters
    ----------
    waypoints
        Float64 [N, 3] [m].
    speed_mps
        Speed [m/s].
    """

    def __init__(self, waypoints: Sequence[Sequence[float]], speed_mps: float) -> None:
        self._points = checked_positions(waypoints)
        self._speed_mps = speed_mps
        legs = np.roll(self._points, -1, axis=0) - self._points
        self._lengths = np.linalg.norm(legs, axis=1)
        self._directions = legs / np.maximum(self._lengths, 1e-12)[:, None]
        self._start_s: float | None = None

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position [3] [m] and velocity [3] [m/s]; the first call is at the first waypoint.

        Parameters
        ----------
        now_s
            The time [s].

        Returns
        -------
        tuple of numpy.ndarray
            Position and velocity.
        """
        if self._start_s is None:
            self._start_s = now_s
        total = self._lengths.sum()
        if total == 0 or self._speed_mps == 0:
            return self._points[0].copy(), np.zeros(3)
        way = (now_s - self._start_s) * self._speed_mps % total
        ends = np.cumsum(self._lengths)
        leg = min(int(np.searchsorted(ends, way, side='right')), len(ends) - 1)
        along = way - (ends[leg] - self._lengths[leg])
        return (self._points[leg] + along * self._directions[leg],
                self._speed_mps * self._directions[leg])


class RandomWalk:
    """A user that walks from one random place of the region of interest to the next.

    Parameters
    ----------
    scenario
        The scenario, for its region.
    speed_mps
        Speed [m/s].
    rng
        Source of randomness.
    start
        First place, float64 [3] [m]; by default a random one.
    """

    def __init__(
            self, scenario: Scenario, speed_mps: float, rng: np.random.Generator,
            start: Sequence[float] | None = None) -> None:
        self._scenario, self._speed_mps, self._rng = scenario, speed_mps, rng
        self._from = self._draw() if start is None else checked_positions([start])[0]
        self._to = self._draw()
        self._since_s: float | None = None

    def state(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position [3] [m] and velocity [3] [m/s].

        Parameters
        ----------
        now_s
            The time [s].

        Returns
        -------
        tuple of numpy.ndarray
            Position and velocity.
        """
        if self._since_s is None:
            self._since_s = now_s
        if self._speed_mps == 0:
            return self._from.copy(), np.zeros(3)
        length = np.linalg.norm(self._to - self._from)
        while now_s - self._since_s >= length / self._speed_mps:
            self._since_s += length / self._speed_mps
            self._from, self._to = self._to, self._draw()
            length = np.linalg.norm(self._to - self._from)
        velocity = (self._to - self._from) / length * self._speed_mps
        return self._from + velocity * (now_s - self._since_s), velocity

    def _draw(self) -> np.ndarray:
        return self._scenario.sample_positions(1, self._rng)[0]


def make_plugin(
        name: str, scenario: Scenario, speed_mps: float, rng: np.random.Generator,
        start: Sequence[float] | None = None) -> Mobility:
    """Make a mobility of another package: an entry point of the group `plugins.MOBILITIES`.

    Parameters
    ----------
    name
        Name of the entry point. Its object takes the other arguments, as `RandomWalk` does.
    scenario
        The scenario.
    speed_mps
        Speed [m/s].
    rng
        Source of randomness.
    start
        First place, float64 [3] [m]; None: of its own choice.

    Returns
    -------
    Mobility
        What it returns.

    Raises
    ------
    PluginError
        If there is none of that name, it cannot be loaded, fails, or makes no mobility.
    """
    made = plugins.make(plugins.MOBILITIES, name, scenario, speed_mps, rng, start)
    if not callable(getattr(made, 'state', None)):
        raise plugins.PluginError(
            f'{plugins.describe(plugins.MOBILITIES, name)}: made {made!r}, expected a mobility, '
            'with a method state')
    return made
