"""Multipath of the users, correlated over their cycles."""

import numpy as np

from rhs_isac_ros.model import Scenario, streams
from rhs_isac_ros.model.multipath import draw_multipath, time_correlation
from rhs_isac_ros.protocol.newest import NewestDict

# Number of users whose multipath is kept. With more, the time between two cycles of a user is far
# longer than the coherence time.
_MAX_USERS = 32


class Fading:
    """Source of multipath gains that depend on the seed and on the times of a user's cycles.

    The gains of a cycle are rho h + sqrt(1 - rho^2) w, where h are the gains of the user's
    previous cycle, rho is Eq. (4) for the time between them, and w is a new draw that depends on
    the seed, the user, the cycle and the band alone. Every cycle has the distribution of Eq. (2)
    to (4), and consecutive cycles have the correlation of Eq. (4); it is negative for some times.
    Over several cycles the correlation is the product of these, not Eq. (4): the exact
    conditional distribution would need all earlier cycles.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        # The first draw factorises covariances. Draw once now, so that it does not delay the first
        # cycle.
        draw_multipath(scenario, 0, 1, np.random.default_rng(0))
        # Time [s] and gains of the latest cycle of each user.
        self._latest: NewestDict[int, tuple[float, list[np.ndarray]]] = NewestDict(_MAX_USERS)

    def gains(self, user: int, cycle_id: int, now_s: float, *, memory: bool) -> list[np.ndarray]:
        """Return the gains of a cycle for each band, complex128 [N_SB, F, N_E].

        Without memory, they are independent of the previous cycle.
        """
        scenario = self._scenario
        gains = [
            draw_multipath(
                scenario, band, 1,
                streams.generator(self._seed, streams.CHANNEL, user, cycle_id, band)
            ).reshape(scenario.n_subbands, scenario.n_frames, scenario.n_elements)
            for band in range(scenario.n_bands)]
        if memory and user in self._latest:
            before_s, previous = self._latest[user]
            lag = np.array((now_s - before_s) / scenario.frame_duration_s)
            for band, earlier in enumerate(previous):
                rho = float(time_correlation(scenario, band, lag, np.array(0.0)))
                gains[band] = rho * earlier + np.sqrt(1 - rho**2) * gains[band]
        self._latest.put(user, (now_s, gains))
        return gains
