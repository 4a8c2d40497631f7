"""Positions as range and direction cosines, in which likelihood modes are nearly Gaussian.

The signals determine the range to a fraction of a wavelength, but the direction only to a fraction
of a beam. In Cartesian coordinates, the modes of the likelihood are therefore curved.
"""

from typing import Any, TypeVar

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.model.geometry import jacobian as jacobian
from rhs_isac_ros.model.geometry import to_polar as to_polar
from rhs_isac_ros.model.geometry import to_positions as to_positions

# Number of alternating projections onto the region and onto a sphere.
_N_PROJECTIONS = 4
# A named tuple of arrays with equal first dimensions.
_Rows = TypeVar('_Rows', bound=tuple[np.ndarray, ...])


def carrier_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Return the wavenumbers k_i at the bands' centres, float64 [N_B] [1/m]."""
    return 2 * np.pi * np.array(scenario.center_frequencies_hz) / SPEED_OF_LIGHT_MPS


def is_inside(positions: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Mark the positions, [..., 3] [m], between the bounds [2, 3] of the region, bool [...]."""
    low, high = bounds
    inside: np.ndarray = ((positions >= low) & (positions <= high)).all(axis=-1)
    return inside


def offset_to_roi(points: np.ndarray, curvature: np.ndarray, bounds: np.ndarray,
                  tolerance_m: float) -> np.ndarray:
    """Compute the offsets, [M, 3], from modes into the region of interest; 0 for modes inside it.

    The direction is chosen first, at the range of the mode, which the signals determine best. The
    range is then adjusted to the new direction so that the likelihood is as high as possible.
    Takes modes (r [m], u, v), float64 [M, 3], the curvature of the log-likelihood there, the
    bounds of the region, float64 [2, 3], and the largest distance from the sphere that counts as
    zero.
    """
    positions = to_positions(points)
    result = np.zeros_like(points)
    outside = np.flatnonzero(~is_inside(positions, bounds))
    if not len(outside):
        return result
    points, positions, curvature = points[outside], positions[outside], curvature[outside]
    for _ in range(_N_PROJECTIONS):
        nearest = to_polar(np.clip(positions, *bounds))
        offset: np.ndarray = nearest - points
        nearest[:, 0] = points[:, 0]
        positions = to_positions(nearest)
    # The projections leave a small remainder, or a large one if the sphere misses the region.
    excess = np.sign(offset[:, 0]) * np.maximum(np.abs(offset[:, 0]) - tolerance_m, 0.0)
    coupling = np.einsum('mq,mq->m', curvature[:, 0, 1:], offset[:, 1:]) / curvature[:, 0, 0]
    offset[:, 0] = excess - coupling
    result[outside] = offset
    return result


def likelihood_loss(offset: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Compute the decrease of the log-likelihood over offsets [M, n] from modes, float64 [M]."""
    return np.einsum('mp,mpq,mq->m', offset, curvature, offset) / 2


def log_sum(values: np.ndarray) -> float:
    """Return the logarithm of the sum of exponentials."""
    highest = float(values.max())
    if np.isneginf(highest):
        return highest
    return highest + float(np.log(np.sum(np.exp(values - highest))))


def moments(weights: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean [..., n] and covariance [..., n, n] of points [..., S, n]; weights add to 1."""
    mean = np.matmul(weights[..., None, :], points)
    offsets = points - mean
    return mean[..., 0, :], np.matmul(np.swapaxes(offsets * weights[..., None], -1, -2), offsets)


def symmetric(covariances: np.ndarray) -> np.ndarray:
    """Return matrices [..., n, n] without the asymmetry that rounding causes."""
    return (covariances + np.swapaxes(covariances, -1, -2)) / 2


def select(rows: _Rows, chosen: Any) -> _Rows:
    """Select rows of a named tuple of arrays by their indices or by a mask."""
    kind: Any = type(rows)
    return kind(*(field[chosen] for field in rows))


def concatenate(*parts: _Rows) -> _Rows:
    """Concatenate the fields of named tuples of arrays."""
    kind: Any = type(parts[0])
    return kind(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))
