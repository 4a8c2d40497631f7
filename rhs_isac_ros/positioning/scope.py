"""Where modes are searched for: the region, or the part of it that a prior covers; and how."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.alternatives import Alternative
from rhs_isac_ros.positioning.grid import Draw, Starts, TemplateTable
from rhs_isac_ros.positioning.lattice import Grid
from rhs_isac_ros.positioning.likelihood import Likelihood, Signals
from rhs_isac_ros.positioning.moving import MovingTable
from rhs_isac_ros.positioning.offsets import Alignment
from rhs_isac_ros.positioning.search import GRID_MARGIN, Modes, modes_from
from rhs_isac_ros.positioning.segments import Segments, concatenate, select

# Growth of errors on the grid, see `NuisancePrior.growth`, above which it is searched again.
_NOISIER = 8.0
# How often the grid may be searched again with other offsets of carrier and timing.
_REALIGNMENTS = 3


class SearchScope(NamedTuple):
    """Where modes are searched for, and what depends on the templates there."""

    table: TemplateTable
    alignment: Alignment
    alternatives: Sequence[Alternative]
    #: Cells in which less likely modes are kept as well, bool [C] or [1].
    favoured: np.ndarray
    drawn: Draw | None = None

    @classmethod
    def of(cls, likelihood: Likelihood, arrays: Mapping[str, np.ndarray], grid: Grid,
           alternatives: Sequence[Alternative]) -> 'SearchScope':
        """Take the templates of a grid, which may be part of the region's."""
        scenario = likelihood.scenario
        kind = MovingTable if scenario.user_speed_std_mps else TemplateTable
        table = kind(scenario, arrays, grid=grid)
        return cls(table, Alignment(likelihood, table.spread), alternatives, np.zeros(1, bool))


class ModeSearch(NamedTuple):
    """The search for the modes of N shots in a scope, repeated where the first one is too coarse.

    `margin`, for each cell, admits modes that are less likely than usual. Unless `is_last`, a
    refinement continues from the modes.
    """

    scope: SearchScope
    likelihood: Likelihood
    signals: Signals
    margin: np.ndarray
    is_last: bool

    def modes(self, starts: Starts, aligned: np.ndarray, whitened: np.ndarray) -> Modes:
        """Return the modes near the starts, or those of further searches.

        `aligned`, float64 [N, Q], are the parameters of `Alignment`, and `whitened`, complex128
        [N, N_B, N_SB F], are the signals without them.
        """
        modes = self._ascend(starts, self.signals, aligned)
        if not len(self.likelihood.nuisance):
            return modes
        energies = np.sum(np.abs(whitened)**2, axis=(1, 2))
        return self._in_noise(*self._realigned(modes, aligned, energies))

    def _ascend(self, starts: Starts, signals: Signals, aligned: np.ndarray) -> Modes:
        return modes_from(starts, self.likelihood, signals, aligned, float(self.margin.max()),
                          self.is_last)

    def _repeated(self, modes: Modes, shots: np.ndarray, aligned: np.ndarray, growth: float = 1.0
                  ) -> Modes:
        """Replace the modes of some shots by those of a search with a wider margin."""
        signals, aligned = select(self.signals, shots), aligned[shots]
        found = self._ascend(self.scope.table.starts(
            self.likelihood.whitened(aligned, signals), self.likelihood.nuisance,
            growth * GRID_MARGIN + self.scope.alignment.margin + self.margin), signals, aligned)
        modes = concatenate(select(modes, ~np.isin(modes.shots, shots)),
                            found._replace(shots=shots[found.shots]))
        return select(modes, np.argsort(modes.shots, kind='stable'))

    def _realigned(self, modes: Modes, aligned: np.ndarray, energies: np.ndarray
                   ) -> tuple[Modes, np.ndarray]:
        """Search again where offsets of carrier and timing are far from those at the best mode.

        The margin only covers usual errors of their first estimates. Also returns the new ones.
        """
        moves, aligned = self.likelihood.nuisance.moves_multipath, aligned.copy()
        for _ in range(_REALIGNMENTS * moves.any()):
            best = select(modes, Segments.of_keys(modes.shots).starts)
            wrong = self.scope.alignment.is_wrong(
                best.values - aligned[best.shots], energies[best.shots] - best.residual)
            if not wrong.any():
                break
            again = best.shots[wrong]
            aligned[np.ix_(again, moves)] = best.values[np.ix_(wrong, moves)]
            modes = self._repeated(modes, again, aligned)
        return modes, aligned

    def _in_noise(self, modes: Modes, aligned: np.ndarray) -> Modes:
        """Search again, with a wider margin, for the modes of shots with a low gain."""
        prior = self.likelihood.nuisance
        # The margin of users who move does not depend on the scope.
        if not prior.has_gain or prior.velocity.size:
            return modes
        best = select(modes, Segments.of_keys(modes.shots).starts)
        growth = prior.growth(best.values @ prior.gain)
        for shot, factor in zip(best.shots.tolist(), growth.tolist(), strict=True):
            if factor > _NOISIER:
                modes = self._repeated(modes, np.array([shot]), aligned, factor)
        return modes
