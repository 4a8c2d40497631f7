"""Shapes and colours of a scene that several views share."""

import colorsys

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from rhs_isac_ros.link import BeamPattern

# Level relative to the maximum of a beam at which a lobe has zero length.
MIN_LEVEL_DB = -20.0
# Quantile of the squared distance that contains 95 % of a three-dimensional Gaussian.
_CHI_SQUARE_95 = float(chdtri(3, 0.05))
# The hues of consecutive users differ by the golden ratio.
_HUE_STEP = 0.618034


def user_colour(user: int) -> tuple[float, float, float]:
    """Return the colour of a user: red, green and blue from 0 to 1."""
    return colorsys.hsv_to_rgb(_HUE_STEP * user % 1.0, 0.8, 0.9)


def ellipsoid_95(covariance_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ellipsoid that contains 95 % of a Gaussian.

    Parameters
    ----------
    covariance_m2
        Covariance of the Gaussian, float64 [3, 3] [m^2].

    Returns
    -------
    tuple of numpy.ndarray
        Half the lengths of the axes, float64 [3] [m], and the rotation from the coordinate axes
        to them as a unit quaternion, float64 [4] (x, y, z, w).
    """
    variances_m2, axes = np.linalg.eigh(covariance_m2)
    # The eigenvectors may form a reflection; a quaternion needs a rotation.
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    half_m: np.ndarray = np.sqrt(_CHI_SQUARE_95 * np.maximum(variances_m2, 0.0))
    return half_m, Rotation.from_matrix(axes).as_quat()


def lobe_m(pattern: BeamPattern) -> np.ndarray:
    """Return a beam pattern as a surface whose radius is proportional to the level in decibels.

    Returns
    -------
    numpy.ndarray
        Points of the surface, float64 [n_el, n_az, 3] [m].
    """
    floor = 10**(MIN_LEVEL_DB / 10)
    level_db = 10 * np.log10(np.maximum(pattern.relative, floor))
    radius_m: np.ndarray = pattern.distance_m * (1 - level_db / MIN_LEVEL_DB)
    points_m: np.ndarray = radius_m[..., None] * pattern.directions
    return points_m
