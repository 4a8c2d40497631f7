"""Offsets from modes of the likelihood to the region of interest, and their cost."""

import numpy as np

from rhs_isac_ros.positioning.polar import to_polar, to_positions

# Alternating projections onto the region and onto a sphere, and the distance from the sphere that
# they may leave.
_N_PROJECTIONS = 4
_RANGE_TOLERANCE_M = 0.02


def is_inside(positions: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return whether positions, float64 [..., 3] [m], are in the region, bool [...].

    The bounds are those of `offset_to_roi`.
    """
    low, high = bounds
    inside = np.ones(positions.shape[:-1], bool)
    # A reduction over the coordinates takes several times as long.
    for axis in range(positions.shape[-1]):
        coordinate = positions[..., axis]
        inside &= coordinate >= low[axis]
        inside &= coordinate <= high[axis]
    return inside


def offset_to_roi(points: np.ndarray, curvature: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Compute the offsets from modes to the nearest points of the region of interest.

    The offset follows the sphere of the mode's range, the coordinate that the signals determine
    best. The range then changes with the direction so that the likelihood is highest.

    Parameters
    ----------
    points
        Modes (r [m], u, v), float64 [M, 3]; the offsets, 0 inside, have the same form.
    curvature
        Curvature of the log-likelihood at each mode, float64 [M, 3, 3].
    bounds
        Lower and upper corner of the region, float64 [2, 3] [m].
    """
    positions = to_positions(points)
    for _ in range(_N_PROJECTIONS):
        nearest = to_polar(np.clip(positions, *bounds))
        offset: np.ndarray = nearest - points
        nearest[:, 0] = points[:, 0]
        positions = to_positions(nearest)
    # The projections leave a small remainder; a larger one means that the sphere does not
    # intersect the region.
    excess = np.sign(offset[:, 0]) * np.maximum(np.abs(offset[:, 0]) - _RANGE_TOLERANCE_M, 0.0)
    coupling = np.einsum('mq,mq->m', curvature[:, 0, 1:], offset[:, 1:]) / curvature[:, 0, 0]
    offset[:, 0] = excess - coupling
    return offset


def likelihood_loss(offset: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Compute the decrease of the log-likelihood over offsets from modes, float64 [M].

    The arguments have the shapes of `offset_to_roi`.
    """
    loss: np.ndarray = np.einsum('mp,mpq,mq->m', offset, curvature, offset) / 2
    return loss
