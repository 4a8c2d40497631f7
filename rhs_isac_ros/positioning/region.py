"""How far modes of the likelihood lie outside the region of interest."""

import numpy as np

from rhs_isac_ros.positioning.polar import to_polar, to_positions

# Projections onto region and sphere in turn, and what they may leave of the way to the sphere.
_PROJECTIONS = 4
_RANGE_SLACK_M = 0.02


def gap_to_region(points: np.ndarray, curvature: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return the way from modes to the nearest place of the region of interest.

    The way leads along the sphere of the mode's range, which is known best, while the range
    follows the direction as the likelihood has it.

    Parameters
    ----------
    points
        Modes (r [m], u, v), float64 [M, 3].
    curvature
        Curvature of the log-likelihood at each of them, float64 [M, 3, 3].
    bounds
        Lower and upper corner of the region, float64 [2, 3] [m].

    Returns
    -------
    numpy.ndarray
        Steps in (r [m], u, v), float64 [M, 3]; 0 inside.
    """
    positions = to_positions(points)
    for _ in range(_PROJECTIONS):
        nearest = to_polar(np.clip(positions, *bounds))
        gap = nearest - points
        nearest[:, 0] = points[:, 0]
        positions = to_positions(nearest)
    # What the projections leave over does not count; more means that the sphere misses the region.
    off = np.sign(gap[:, 0]) * np.maximum(np.abs(gap[:, 0]) - _RANGE_SLACK_M, 0.0)
    follow = np.einsum('mq,mq->m', curvature[:, 0, 1:], gap[:, 1:]) / curvature[:, 0, 0]
    gap[:, 0] = off - follow
    return gap


def loss(gap: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Return what modes lose of their log-likelihood over such a gap.

    Parameters
    ----------
    gap
        Steps in (r [m], u, v), float64 [M, 3].
    curvature
        Curvature of the log-likelihood, float64 [M, 3, 3].

    Returns
    -------
    numpy.ndarray
        Float64 [M], not negative.
    """
    return np.einsum('mp,mpq,mq->m', gap, curvature, gap) / 2
