"""Ellipses that represent covariances in pictures."""

import math
from collections.abc import Sequence

import numpy as np

# Quantile of the chi-square distribution with two degrees of freedom at 95 %.
_CHI_SQUARE_95 = -2 * math.log(0.05)


def ellipse_95(covariance_m2: np.ndarray) -> tuple[float, float, float]:
    """Return the ellipse that contains 95 % of a Gaussian distribution in a plane.

    Parameters
    ----------
    covariance_m2
        Covariance, float64 [2, 2] [m^2].

    Returns
    -------
    tuple of float
        Lengths of the two axes, called width and height [m], and the angle from the first
        coordinate axis to the axis of the width [deg].
    """
    variances, directions = np.linalg.eigh(covariance_m2)
    width, height = (2 * np.sqrt(_CHI_SQUARE_95 * np.maximum(variances, 0))).tolist()
    return width, height, math.degrees(math.atan2(directions[1, 0], directions[0, 0]))


def limits_with_ellipses(
        limits_m: np.ndarray, bounds_m: np.ndarray, means_m: Sequence[np.ndarray],
        covariances_m2: Sequence[np.ndarray]) -> np.ndarray:
    """Extend the limits of a view so that it contains the ellipses of `ellipse_95`.

    Parameters
    ----------
    limits_m
        Lower and upper corner, float64 [2, n] [m].
    bounds_m
        Corners that an ellipse does not extend the view beyond, float64 [2, n] [m].
    means_m, covariances_m2
        Centres of the ellipses, float64 [n] [m] each, and covariances, float64 [n, n] [m^2] each.

    Returns
    -------
    np.ndarray
        Extended limits, float64 [2, n] [m].
    """
    n = limits_m.shape[1]
    means = np.reshape(means_m, (-1, n))
    variances = np.reshape([covariance.diagonal() for covariance in covariances_m2], (-1, n))
    # Half the extent of an ellipse depends on the variance along the axis alone.
    halves = np.sqrt(_CHI_SQUARE_95 * np.maximum(variances, 0))
    low = np.maximum((means - halves).min(axis=0, initial=np.inf), bounds_m[0])
    high = np.minimum((means + halves).max(axis=0, initial=-np.inf), bounds_m[1])
    return np.stack([np.minimum(limits_m[0], low), np.maximum(limits_m[1], high)])
