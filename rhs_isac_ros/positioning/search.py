"""The modes of the posterior: found on the grid, refined by Gauss-Newton steps.

Each step moves the position and the nuisance parameters together. Around a mode, the posterior is
treated as Gaussian (Laplace's method). The information about the position is then a Schur
complement, and the mass of the mode contains the determinant of the parameters' information.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.gaussian import Marginal, marginalise, step_to_maximum
from rhs_isac_ros.positioning.coordinates import likelihood_loss, offset_to_roi, select
from rhs_isac_ros.positioning.grid import (
    Query,
    Starts,
    TemplateTable,
    first_of_each,
    heaviest,
    separate,
)
from rhs_isac_ros.positioning.likelihood import Conditional, Likelihood, Local, Signals

# Negative logarithms of the share of the posterior that discarded modes may have: on the grid,
# which is accurate to one Gauss-Newton step, and after exact steps.
GRID_MARGIN = 8.0
EXACT_MARGIN = 7.0
# A mode has converged when its last step gained less log-likelihood than this.
_MIN_GAIN = 0.05
# Maximum number of exact steps. Few modes need more than two, unless signals are strong. At the
# border of the region, small gains may alternate.
MAX_STEPS = 8


class Modes(NamedTuple):
    """Local maxima of the posterior in or near the region of interest (ROI)."""

    # Positioning phase of each mode, int [M], ascending; the most likely mode of a phase is first.
    phases: np.ndarray
    points: np.ndarray  # (r [m], u, v), float64 [M, 3].
    curvature: np.ndarray  # Curvature of the marginal log-likelihood there, float64 [M, 3, 3].
    # Marginal log-likelihood, up to a constant, float64 [M]. Without nuisance parameters and
    # errors of the elements, it is minus the energy of the whitened residual at `points`.
    log_likelihood: np.ndarray
    roi_offset: np.ndarray  # Offset to the region, from `offset_to_roi`, float64 [M, 3].
    values: np.ndarray  # Nuisance parameters, float64 [M, Q].
    residual: np.ndarray  # Energy of the whitened residual at `roi_points`, float64 [M].
    state: np.ndarray  # Number of the state of the surface, int [M]; 0 if there is only one.

    @property
    def roi_log_likelihood(self) -> np.ndarray:
        """Log-likelihood at `roi_points`, float64 [M]."""
        return self.log_likelihood - likelihood_loss(self.roi_offset, self.curvature)

    @property
    def roi_points(self) -> np.ndarray:
        """For each mode, its most likely point inside the region, (r [m], u, v), [M, 3]."""
        return self.points + self.roi_offset

    def starts(self) -> Starts:
        """Return the most likely points inside the region, to start another search from them."""
        return Starts(self.phases, self.roi_points, self.values)

    def replace(self, rows: np.ndarray, others: 'Modes') -> None:
        """Overwrite the modes in `rows` with other modes."""
        for field, new in zip(self, others, strict=True):
            field[rows] = new

    def of_phase(self, phase: int) -> 'Modes':
        """Return the modes of one phase."""
        return select(self, slice(*np.searchsorted(self.phases, (phase, phase + 1))))


def find_modes(likelihood: Likelihood, grid: TemplateTable, signals: Signals,
               aligned: np.ndarray, extra_margin: float = 0.0,
               draw: Callable[[Query, int], bool] | None = None) -> Modes | None:
    """Find the modes with a substantial weight in the posterior of each of N phases.

    The most likely mode of each phase comes first. `aligned`, float64 [N, Q], contains the
    parameters that follow from the signals alone, and 0 for the others. `extra_margin` admits
    modes that are less likely than usual. With `draw`, a phase may have no modes, as
    `TemplateTable.starts` describes; the result is None if no phase has any.
    """
    starts = grid.starts(likelihood.whitened(aligned, signals), likelihood.nuisance,
                         GRID_MARGIN + extra_margin, draw)
    if not len(starts.phases):
        return None
    starts = starts._replace(values=starts.values + aligned[starts.phases])
    return ascend(likelihood, likelihood, starts, signals, MAX_STEPS, EXACT_MARGIN + extra_margin)


def ascend(conditional: Conditional, likelihood: Likelihood, starts: Starts, signals: Signals,
           n_steps: int, margin: float = EXACT_MARGIN, state: int = 0) -> Modes:
    """Take up to `n_steps` Gauss-Newton steps from the starts to the modes of the posterior.

    `conditional` is the likelihood for the state of the surface with the number `state`. `margin`
    is the negative logarithm of the share of the posterior that discarded modes may have.
    """
    def step(starts: Starts, moves: bool = True) -> tuple[Modes, np.ndarray]:
        return _step(conditional, likelihood, starts, select(signals, starts.phases), state,
                     moves)

    modes, gain = step(starts)
    for number in range(n_steps):
        chosen = _prune(likelihood, modes, gain, margin)
        modes, gain = select(modes, chosen), gain[chosen]
        (moving,) = np.nonzero(gain > _MIN_GAIN)
        if not len(moving) or number == n_steps - 1:
            break
        moved, gain[moving] = step(select(modes, moving).starts())
        modes.replace(moving, moved)
    # Before convergence, the predicted likelihood may be arbitrarily wrong.
    (moving,) = np.nonzero((gain > _MIN_GAIN) | (len(likelihood.nuisance) > 0))
    if len(moving):
        again = Starts(modes.phases[moving], modes.points[moving], modes.values[moving])
        modes.replace(moving, step(again, moves=False)[0])
        gain[moving] = 0.0
        modes = select(modes, _prune(likelihood, modes, gain, margin))
    return modes


def marginal_at(conditional: Conditional, likelihood: Likelihood, points: np.ndarray,
                values: np.ndarray, signals: Signals) -> tuple[np.ndarray, np.ndarray]:
    """Compute the marginal log-likelihood at M points, [M], and the best parameters, [M, Q].

    Newton steps start from the approximate parameters `values`, [M, Q].
    """
    values = likelihood.settle(points, values, signals)
    for _ in range(2 if values.shape[1] else 1):
        local = conditional.local(points, values, signals)
        marginal = marginalise(local.information, local.gradient)
        values = values + marginal.offset
    rise = np.sum(local.gradient[:, 3:] * marginal.offset, axis=1) / 2
    return local.value + rise + marginal.log_volume, values


def _step(conditional: Conditional, likelihood: Likelihood, starts: Starts, signals: Signals,
          state: int, moves: bool = True) -> tuple[Modes, np.ndarray]:
    """Take a Gauss-Newton step, or none without `moves`; return the modes and gains, [M]."""
    points = starts.points
    values = likelihood.settle(points, starts.values, signals)
    local = conditional.local(points, values, signals)
    marginal, whole, rise = _newton(local, likelihood)
    if not moves:
        whole, rise = np.zeros_like(whole), np.zeros_like(rise)
    step, values = whole[:, :3], values + whole[:, 3:]
    evidence = local.value + marginal.log_volume
    points = points + step
    offset = offset_to_roi(points, marginal.information, likelihood.resolution.bounds_m,
                           likelihood.resolution.tolerance_m)
    gain = rise - likelihood_loss(offset, marginal.information)
    modes = Modes(
        starts.phases, points, marginal.information, evidence + rise, offset, values,
        local.residual - gain, np.full(len(points), state))
    return modes, gain


def predict(local: Local, likelihood: Likelihood) -> np.ndarray:
    """Predict the marginal log-likelihood after a Gauss-Newton step, float64 [M]."""
    marginal, _, rise = _newton(local, likelihood)
    return local.value + marginal.log_volume + rise


def _newton(local: Local, likelihood: Likelihood) -> tuple[Marginal, np.ndarray, np.ndarray]:
    """Return the marginal, the limited step [M, 3 + Q], and the log-likelihood that it gains."""
    marginal = marginalise(local.information, local.gradient)
    limits = likelihood.resolution.step_limits(likelihood.nuisance.is_coarse)
    whole = np.clip(
        step_to_maximum(marginal.information, marginal.gradient), -limits, limits)
    if len(likelihood.nuisance):
        whole = np.hstack([whole, marginal.offset + np.einsum(
            'mqp,mp->mq', marginal.regression, whole)])
    rise = np.sum(local.gradient * whole, axis=1) - likelihood_loss(whole, local.information)
    return marginal, whole, rise


def _prune(likelihood: Likelihood, modes: Modes, gain: np.ndarray, margin: float) -> np.ndarray:
    """Return indices of the probable, separate modes of each phase, the most likely first."""
    # The likelihood of a mode is a prediction, and may be arbitrarily wrong before convergence.
    # The likelihood before the last step is known, and its maximum limits the best prediction.
    value = modes.roi_log_likelihood + np.maximum(gain, 0)
    order = np.lexsort((-modes.roi_log_likelihood, modes.phases))
    phases = modes.phases[order]
    firsts = first_of_each(phases)
    known = (modes.roi_log_likelihood - gain)[order]
    best = np.minimum(modes.roi_log_likelihood[order[firsts]], np.maximum.reduceat(known, firsts))
    relative = value[order] - np.repeat(best, np.diff(firsts, append=len(order)))
    order = order[heaviest(phases, np.minimum(relative, 0.0), margin)]
    phases = modes.phases[order]
    radii = likelihood.resolution.separation(likelihood.nuisance.is_coarse)
    return order[separate(phases, modes.roi_points[order], radii, modes.curvature[order])]
