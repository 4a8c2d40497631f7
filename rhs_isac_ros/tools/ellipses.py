"""Ellipses that represent covariances in pictures."""

import math

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
