"""Positions as range and direction cosines, in which the likelihood is nearly Gaussian.

A point q = (r, u, v) is the position r (w, u, v) with w = sqrt(1 - u^2 - v^2), in front of the
surface. The range is known to a fraction of a wavelength and the direction to a fraction of a
beam; in Cartesian coordinates the one bends the other.
"""

import numpy as np


def to_positions(points: np.ndarray) -> np.ndarray:
    """Positions of polar points.

    Parameters
    ----------
    points
        (r [m], u, v), float64 [..., 3]; directions outside the unit circle are drawn onto it.

    Returns
    -------
    numpy.ndarray
        Float64 [..., 3] [m].
    """
    distance, u, v = np.moveaxis(points, -1, 0)
    w = np.sqrt(np.maximum(1 - u**2 - v**2, 0.0))
    return distance[..., None] * np.stack([w, u, v], axis=-1)


def to_polar(positions: np.ndarray) -> np.ndarray:
    """Polar points of positions.

    Parameters
    ----------
    positions
        Float64 [..., 3] [m], with x > 0.

    Returns
    -------
    numpy.ndarray
        (r [m], u, v), float64 [..., 3].
    """
    distance = np.linalg.norm(positions, axis=-1)
    return np.stack(
        [distance, positions[..., 1] / distance, positions[..., 2] / distance], axis=-1)


def jacobian(points: np.ndarray) -> np.ndarray:
    """Derivative of the positions by the polar points.

    Parameters
    ----------
    points
        (r [m], u, v), float64 [N, 3].

    Returns
    -------
    numpy.ndarray
        dp/dq, float64 [N, 3, 3], row by coordinate of the position.
    """
    distance, u, v = points.T
    w = np.sqrt(np.maximum(1 - u**2 - v**2, 1e-9))
    matrix = np.zeros((len(points), 3, 3))
    matrix[:, :, 0] = np.stack([w, u, v], axis=1)
    matrix[:, :, 1] = distance[:, None] * np.stack([-u / w, np.ones_like(u), 0 * u], axis=1)
    matrix[:, :, 2] = distance[:, None] * np.stack([-v / w, 0 * v, np.ones_like(v)], axis=1)
    return matrix
