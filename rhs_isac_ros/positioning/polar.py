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
    distance, u, v = points[..., 0], points[..., 1], points[..., 2]
    positions = np.empty(points.shape)
    positions[..., 0] = np.sqrt(np.maximum(1 - u**2 - v**2, 0.0))
    positions[..., 1:] = points[..., 1:]
    positions *= distance[..., None]
    return positions


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
    points = np.empty(positions.shape)
    points[..., 0] = np.sqrt(np.sum(positions**2, axis=-1))
    points[..., 1:] = positions[..., 1:] / points[..., :1]
    return points


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
    matrix[:, 0, 0], matrix[:, 1, 0], matrix[:, 2, 0] = w, u, v
    matrix[:, 0, 1], matrix[:, 0, 2] = -distance * u / w, -distance * v / w
    matrix[:, 1, 1] = matrix[:, 2, 2] = distance
    return matrix
