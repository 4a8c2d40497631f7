"""What a beam carries at the true position, and what a perfect position would add."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.link.capacity import Beam, capacity
from rhs_isac_ros.link.choice import choose_beam
from rhs_isac_ros.model import Scenario


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Capacities at a true position.

    Attributes
    ----------
    actual_bps
        Capacity of the beam that is in use [bit/s].
    perfect_bps
        Capacity of the beam that is chosen with the true position [bit/s].
    """

    actual_bps: float
    perfect_bps: float

    @property
    def loss_bps(self) -> float:
        """What the error of the position costs [bit/s]."""
        return self.perfect_bps - self.actual_bps

    @property
    def loss_percent(self) -> float:
        """The same in per cent of the capacity with a perfect position; NaN if that is 0."""
        return 100 * self.loss_bps / self.perfect_bps if self.perfect_bps else math.nan


def outcome(
        scenario: Scenario, beam: Beam, position: np.ndarray,
        bands: Sequence[int] | None = None) -> Outcome:
    """Compare a beam with the one that is chosen with the true position.

    Parameters
    ----------
    scenario
        The scenario.
    beam
        The beam in use.
    position
        True position of the user, float64 [3] [m].
    bands
        Indices of the bands that the beam was chosen from, from 0; none: all.

    Returns
    -------
    Outcome
        The capacities. As the search for a beam ends a little below the best, the loss of a good
        estimate may be negative, by a few hundredths of a per cent at most.

    Raises
    ------
    ValueError
        If the position is not a finite [3] array, or the beam does not fit the scenario.
    """
    perfect = choose_beam(scenario, position, bands=bands)
    actual = capacity(scenario, beam, np.asarray(position, dtype=float)[None])[0]
    return Outcome(float(actual), perfect.expected_bps)
