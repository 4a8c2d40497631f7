"""The modes of the posterior: found on the table, refined with the exact near-field model."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import gap_to_region, loss
from rhs_isac_ros.positioning.table import LEAST_CURVATURE, TemplateTable, separate
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Modes to refine, and how far below the best one's log-likelihood they may lie: on the table,
# which is good to one Gauss-Newton step, and after the first exact step.
_MODES = 32
_DEPTHS = (10.0, 8.0)
# Modes closer than this in all of (r [m], u, v) have climbed to the same peak.
_MERGE = np.array([0.01, 0.02, 0.02])
_LONGEST_STEP = np.array([0.02, 0.05, 0.05])
# A mode whose last step was worth less log-likelihood than this stands still.
_SETTLED = 0.02
# Exact steps at most, and in a search that spares nothing.
_STEPS = 2
LONG_SEARCH = 12


class Modes(NamedTuple):
    """Local maxima of the likelihood in or near the region of interest.

    Attributes
    ----------
    points
        (r [m], u, v), float64 [M, 3].
    curvature
        Of the log-likelihood, by the points, float64 [M, 3, 3].
    value
        Log-likelihood, minus the square norm of the whitened residual, float64 [M].
    gap
        Way to the region of interest, as `gap_to_region` gives it, float64 [M, 3].
    """

    points: np.ndarray
    curvature: np.ndarray
    value: np.ndarray
    gap: np.ndarray

    @property
    def height(self) -> np.ndarray:
        """Log-likelihood that a mode still has where the region is nearest, float64 [M]."""
        return self.value - loss(self.gap, self.curvature)

    @property
    def inside(self) -> np.ndarray:
        """Where in the region a mode is highest, (r [m], u, v), float64 [M, 3]."""
        return self.points + self.gap

    def pick(self, chosen: np.ndarray) -> 'Modes':
        """Select modes.

        Parameters
        ----------
        chosen
            Indices or a mask.

        Returns
        -------
        Modes
            Those alone.
        """
        return Modes(*(field[chosen] for field in self))


def find_modes(
        model: WhitenedModel, table: TemplateTable, whitened: np.ndarray,
        n_steps: int = _STEPS) -> Modes:
    """Find the modes that carry weight in the posterior.

    Parameters
    ----------
    model
        The whitened model.
    table
        Its table.
    whitened
        Whitened signals of one positioning phase, complex128 [N_B, N_SB F].
    n_steps
        Exact steps at most.

    Returns
    -------
    Modes
        At least one, the highest first.
    """
    points = table.modes(whitened, _MODES, _DEPTHS[0])
    modes, gain = _climb(model, points, whitened)
    height = modes.height
    order = np.argsort(-height)
    order = order[height[order] >= height[order[0]] - _DEPTHS[1]]
    chosen = order[separate(modes.points[order] / _MERGE, _MODES)]
    modes, gain = modes.pick(chosen), gain[chosen]
    for _ in range(n_steps - 1):
        (moving,) = np.nonzero(gain > _SETTLED)
        if not len(moving):
            break
        further, gain[moving] = _climb(model, modes.inside[moving], whitened)
        for field, new in zip(modes, further, strict=True):
            field[moving] = new
    order = np.argsort(-modes.height)
    return modes.pick(order[separate(modes.inside[order] / _MERGE, _MODES)])


def _climb(
        model: WhitenedModel, points: np.ndarray, whitened: np.ndarray
) -> tuple[Modes, np.ndarray]:
    """One Gauss-Newton step: where it leads, and what it gains within the region [M]."""
    curvature, slope, value = _local(model, points, whitened)
    step = np.linalg.solve(curvature, slope[..., None])[..., 0]
    step = np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
    expected = value + np.sum(slope * step, axis=1) - loss(step, curvature)
    points = points + step
    gap = gap_to_region(points, curvature, model.scenario.roi_bounds_m)
    modes = Modes(points, curvature, expected, gap)
    return modes, modes.height - value


def _local(
        model: WhitenedModel, points: np.ndarray, whitened: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Curvature [M, 3, 3], slope [M, 3] and value [M] of the log-likelihood, polar."""
    n = len(points)
    mean, by_position = model.mean_and_jacobian(to_positions(points))
    # Re(a^H b) is the inner product of real and imaginary parts.
    residual = (whitened - mean).reshape(n, -1).view(float)
    slopes = by_position.reshape(n, 3, -1).view(float)
    slopes = np.matmul(np.swapaxes(jacobian(points), 1, 2), slopes)
    curvature = quadratic_form(slopes.view(complex)) + np.diag(LEAST_CURVATURE)
    slope = 2 * np.matmul(slopes, residual[..., None])[..., 0]
    return curvature, slope, -np.sum(residual**2, axis=1)
