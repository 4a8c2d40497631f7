"""Positions as range and direction cosines, in which the likelihood is nearly Gaussian.

A point q = (r, u, v) is the position r (w, u, v) with w = sqrt(1 - u^2 - v^2), in front of the
surface. The signals determine the range to a fraction of a wavelength, but the direction only to
a fraction of a beam. In Cartesian coordinates, the modes of the likelihood are therefore curved.
"""

import numpy as np


def to_positions(points: np.ndarray) -> np.ndarray:
    """Convert points (r [m], u, v), float64 [..., 3], to positions, float64 [..., 3] [m].

    Directions outside the unit circle have x = 0.
    """
    distance, u, v = points[..., 0], points[..., 1], points[..., 2]
    positions = np.empty_like(points, dtype=float)
    positions[..., 0] = np.sqrt(np.maximum(1 - u**2 - v**2, 0.0))
    positions[..., 1:] = points[..., 1:]
    positions *= distance[..., None]
    return positions


def to_polar(positions: np.ndarray) -> np.ndarray:
    """Convert positions with x > 0, float64 [..., 3] [m], to (r [m], u, v), float64 [..., 3]."""
    points = np.empty(positions.shape)
    points[..., 0] = np.sqrt(np.sum(positions**2, axis=-1))
    points[..., 1:] = positions[..., 1:] / points[..., :1]
    return points


def jacobian(points: np.ndarray) -> np.ndarray:
    """Compute dp/dq at points (r [m], u, v), float64 [N, 3].

    The result is float64 [N, 3, 3], with the coordinates of the position in rows.
    """
    distance, u, v = points.T
    w = np.sqrt(np.maximum(1 - u**2 - v**2, 1e-9))
    matrix = np.zeros((len(points), 3, 3))
    matrix[:, 0, 0], matrix[:, 1, 0], matrix[:, 2, 0] = w, u, v
    matrix[:, 0, 1], matrix[:, 0, 2] = -distance * u / w, -distance * v / w
    matrix[:, 1, 1] = matrix[:, 2, 2] = distance
    return matrix
