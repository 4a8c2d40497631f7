"""The modes of the posterior: found on the table, refined with the exact near-field model."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import likelihood_loss, offset_to_roi
from rhs_isac_ros.positioning.separation import separate, separate_each
from rhs_isac_ros.positioning.table import MIN_CURVATURE, TemplateTable
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Largest number of modes.
MAX_MODES = 32
# Maximum difference between the best log-likelihood and that of a mode: on the table, which is
# accurate to one Gauss-Newton step, and after the first exact step.
TABLE_MARGIN = 10.0
EXACT_MARGIN = 8.0
# Modes closer than this in all of (r [m], u, v) have converged to the same maximum.
_MIN_SEPARATION = np.array([0.01, 0.02, 0.02])
# The linear model of a step in (r [m], u, v) does not hold beyond these.
STEP_LIMITS = np.array([0.02, 0.05, 0.05])
# A mode has converged when its last step gained less log-likelihood than this.
MIN_GAIN = 0.02
# Maximum number of exact steps, in a short and in a long search.
_SHORT_SEARCH_STEPS = 2
LONG_SEARCH_STEPS = 12


class Modes(NamedTuple):
    """Local maxima of the likelihood in or near the region of interest (ROI).

    Attributes
    ----------
    points
        (r [m], u, v), float64 [M, 3].
    curvature
        Curvature of the log-likelihood in these coordinates, float64 [M, 3, 3].
    log_likelihood
        Minus the squared norm of the whitened residual, float64 [M].
    roi_offset
        Offset to the region of interest, from `offset_to_roi`, float64 [M, 3].
    """

    points: np.ndarray
    curvature: np.ndarray
    log_likelihood: np.ndarray
    roi_offset: np.ndarray

    @property
    def roi_log_likelihood(self) -> np.ndarray:
        """Log-likelihood at `roi_points`, float64 [M]."""
        value: np.ndarray = (
            self.log_likelihood - likelihood_loss(self.roi_offset, self.curvature))
        return value

    @property
    def roi_points(self) -> np.ndarray:
        """For each mode, its most likely point inside the region, (r [m], u, v), [M, 3]."""
        points: np.ndarray = self.points + self.roi_offset
        return points

    def select(self, chosen: np.ndarray | slice) -> 'Modes':
        """Return the modes with the given indices or mask."""
        return Modes(*(field[chosen] for field in self))


def find_modes(
        model: WhitenedModel, table: TemplateTable, whitened: np.ndarray,
        max_steps: int = _SHORT_SEARCH_STEPS, extra_margin: float = 0.0) -> Modes:
    """Find the modes with a substantial weight in the posterior.

    The whitened signals of one positioning phase, complex128 [N_B, N_SB F], give at least one
    mode. The most likely in the region comes first. At least one exact step is taken. Modes may
    be less likely than the best by `extra_margin` more than usual.
    """
    return find_modes_of_each(model, table, whitened[None], max_steps, extra_margin)[0]


def find_modes_of_each(
        model: WhitenedModel, table: TemplateTable, whitened: np.ndarray,
        max_steps: int = _SHORT_SEARCH_STEPS, extra_margin: float = 0.0) -> list[Modes]:
    """Apply `find_modes` to each of many phases, complex128 [N, N_B, N_SB F], at once."""
    phases, points = table.modes_of_each(whitened, MAX_MODES, TABLE_MARGIN + extra_margin)
    modes, gain = _gauss_newton_step(model, points, whitened[phases])
    chosen = _choose(phases, modes, modes.points, EXACT_MARGIN + extra_margin)
    phases, modes, gain = phases[chosen], modes.select(chosen), gain[chosen]
    for _ in range(max_steps - 1):
        (moving,) = np.nonzero(gain > MIN_GAIN)
        if not len(moving):
            break
        moved, gain[moving] = _gauss_newton_step(
            model, modes.roi_points[moving], whitened[phases[moving]])
        for field, new in zip(modes, moved, strict=True):
            field[moving] = new
    chosen = _choose(phases, modes, modes.roi_points)
    modes = modes.select(chosen)
    ends = np.searchsorted(phases[chosen], np.arange(len(whitened) + 1))
    return [modes.select(slice(*pair)) for pair in zip(ends[:-1], ends[1:], strict=True)]


def _choose(phases: np.ndarray, modes: Modes, points: np.ndarray,
            margin: float = np.inf) -> np.ndarray:
    """Choose the separate modes of each phase within a margin, the most likely first.

    Takes the phase of each mode, int [M], ascending; returns indices in the same order of phases.
    """
    value = modes.roi_log_likelihood
    if phases[0] == phases[-1]:
        order = np.argsort(-value)
        order = order[value[order] >= value[order[0]] - margin]
        kept: np.ndarray = order[separate(points[order] / _MIN_SEPARATION, MAX_MODES)]
        return kept
    order = np.lexsort((-value, phases))
    first = np.searchsorted(phases, phases)
    # Modes of one phase are adjacent before and after sorting.
    best = value[order][first]
    place = np.arange(len(phases)) - first
    lists = np.unique(phases, return_inverse=True)[1]
    n_lists, n_places = lists[-1] + 1, place.max() + 1
    index = np.zeros((n_lists, n_places), int)
    valid = np.zeros((n_lists, n_places), bool)
    index[lists, place] = order
    valid[lists, place] = value[order] >= best - margin
    rows, columns = separate_each(points[index] / _MIN_SEPARATION, valid, MAX_MODES)
    chosen: np.ndarray = index[rows, columns]
    return chosen


def _gauss_newton_step(
        model: WhitenedModel, points: np.ndarray, whitened: np.ndarray
) -> tuple[Modes, np.ndarray]:
    """Return the modes after one step, and the gain of log-likelihood in the region, [M]."""
    curvature, gradient, value = local_model(model, points, whitened)
    step = np.linalg.solve(curvature, gradient[..., None])[..., 0]
    step = np.clip(step, -STEP_LIMITS, STEP_LIMITS)
    predicted = value + np.sum(gradient * step, axis=1) - likelihood_loss(step, curvature)
    points = points + step
    roi_offset = offset_to_roi(points, curvature, model.scenario.roi_bounds_m)
    modes = Modes(points, curvature, predicted, roi_offset)
    return modes, modes.roi_log_likelihood - value


def local_model(
        model: WhitenedModel, points: np.ndarray, whitened: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute curvature, gradient and value of the log-likelihood in (r [m], u, v).

    Takes points, float64 [M, 3], and whitened signals, complex128 [N_B, N_SB F], or those of each
    point, [M, N_B, N_SB F]; returns float64 [M, 3, 3], [M, 3] and [M].
    """
    n = len(points)
    mean, slopes = model.mean_and_jacobian(to_positions(points), jacobian(points))
    # Re(a^H b) is the inner product of real and imaginary parts.
    residual = (whitened - mean).reshape(n, -1).view(float)
    derivative = slopes.reshape(n, 3, -1)
    curvature = quadratic_form(derivative) + np.diag(MIN_CURVATURE)
    gradient = 2 * np.matmul(derivative.view(float), residual[..., None])[..., 0]
    return curvature, gradient, -np.sum(residual**2, axis=1)
