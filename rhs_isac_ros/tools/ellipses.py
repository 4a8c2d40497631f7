"""Ellipses of covariances, as pictures draw them."""

import math

import numpy as np

# Quantile of the squared distance that holds 95 % of a Gaussian in two dimensions.
_CHI_SQUARE_95 = -2 * math.log(0.05)


def ellipse_95(covariance_m2: np.ndarray) -> tuple[float, float, float]:
    """Return the ellipse that holds 95 % of a Gaussian in a plane.

    Parameters
    ----------
    covariance_m2
        Covariance, float64 [2, 2] [m^2].

    Returns
    -------
    tuple of float
        Width and height [m], and the angle from the first axis to the width [deg].
    """
    variances, directions = np.linalg.eigh(covariance_m2)
    width, height = (2 * np.sqrt(_CHI_SQUARE_95 * np.maximum(variances, 0))).tolist()
    return width, height, math.degrees(math.atan2(directions[1, 0], directions[0, 0]))
