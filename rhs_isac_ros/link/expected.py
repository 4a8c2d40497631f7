"""Expected capacity while the user's position is known by mean and covariance only."""

import functools
import itertools

import numpy as np

from rhs_isac_ros.link.capacity import Beam, capacity
from rhs_isac_ros.model import Scenario

# Nodes of the quadrature along each principal axis of the covariance.
_NODES = 3
# Standard deviations and coordinates beyond this are none that a user has [m].
_FARTHEST_M = 1e6


def expected_capacity(
        scenario: Scenario, beam: Beam, mean: np.ndarray, covariance: np.ndarray) -> float:
    """Mean of Eq. (10) over a Gaussian posterior of the user's position.

    Parameters
    ----------
    scenario
        The scenario.
    beam
        The beam.
    mean
        Mean of the position, float64 [3] [m].
    covariance
        Its covariance, float64 [3, 3] [m^2].

    Returns
    -------
    float
        The expected capacity [bit/s].

    Raises
    ------
    ValueError
        If mean or covariance have another shape or are not finite, or the beam does not fit the
        scenario.
    """
    points, weights = posterior_points(scenario, mean, covariance)
    return float(weights @ capacity(scenario, beam, points))


def posterior_points(
        scenario: Scenario, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights that stand for a Gaussian posterior, always the same for the same one.

    A product of Gauss-Hermite rules along the principal axes of the covariance: exact for
    polynomials up to the fifth degree in each. All weights are positive, so that a mean of
    capacities is between the least and the greatest of them. An axis without variance has one
    node. A point nearer to the surface than the region of interest begins, or than the mean if
    that is nearer still, is moved out to there: a user is in front of the surface, and the
    tail of a Gaussian behind it or among the elements would count capacities that nobody has.

    Parameters
    ----------
    scenario
        The scenario.
    mean
        Mean of the position, float64 [3] [m].
    covariance
        Its covariance, float64 [3, 3] [m^2]; its symmetric part counts, negative variances as 0.

    Returns
    -------
    tuple of numpy.ndarray
        Positions, float64 [n, 3] [m], and weights with the sum 1, float64 [n].

    Raises
    ------
    ValueError
        If mean or covariance have another shape or are not finite.
    """
    for name, value, shape in (('mean', mean, (3,)), ('covariance', covariance, (3, 3))):
        if np.shape(value) != shape or not np.isfinite(value).all():
            raise ValueError(f'{name}: {value}, expected {list(shape)} finite numbers')
    # Halved first: the sum of two numbers near the largest is infinite.
    variances, axes = np.linalg.eigh(np.divide(covariance, 2) + np.divide(covariance, 2).T)
    spreads = np.minimum(np.sqrt(np.maximum(variances, 0)), _FARTHEST_M)
    nodes, weights = _rule(tuple(bool(spread > 0) for spread in spreads))
    points = mean + nodes * spreads @ axes.T
    points[:, 0] = np.maximum(points[:, 0], min(mean[0], scenario.roi_bounds_m[0][0]))
    return points, weights


@functools.lru_cache(maxsize=8)
def _rule(varies: tuple[bool, bool, bool]) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [n, 3] and weights [n] for a standard Gaussian in the axes that vary."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    weights = weights / weights.sum()
    axes = [list(zip(nodes, weights, strict=True)) if moves else [(0.0, 1.0)] for moves in varies]
    product = np.array(list(itertools.product(*axes)))
    return product[..., 0], product[..., 1].prod(axis=1)
