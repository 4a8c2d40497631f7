"""The ratio of the mean squared error of an estimator to that of the exhaustive posterior."""

from typing import Any

import numpy as np
from parts.exhaustive_posterior import exhaustive_posterior, posterior_with_truth

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments.resampling import replicate
from rhs_isac_ros.model import ElementErrors, Scenario
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.positioning.failures import can_enumerate


def reference_means(
        scenario: Scenario, codebook: Codebook, positions: np.ndarray, received: np.ndarray,
        surfaces: list[ElementErrors | None], log2_points: int) -> np.ndarray:
    """Compute the means of the reference from two sets of points, float64 [2, N, 3] [m]."""
    known = [surface for surface in surfaces if surface]
    if can_enumerate(scenario):
        return np.tile(
            posterior_with_truth(scenario, codebook, received, known, positions).mean, (2, 1, 1))
    return np.stack([
        exhaustive_posterior(scenario, codebook, received, log2_points, seed=seed).mean
        for seed in range(2)])


def ratio_to_reference(
        reference: np.ndarray, estimate: Estimate, positions: np.ndarray, surface: np.ndarray
) -> dict[str, Any]:
    """Compare the squared errors of fixes with those of the exhaustive posterior.

    The mean of finitely many points has an additional error. It is independent between the two
    sets of points, so that the product of their errors has the expectation without it. The
    interval resamples surfaces, because the errors at positions that share a surface, given by its
    number, int [N], are not independent.
    """
    n = len(positions)
    fix = estimate.fix[:n]
    own = np.sum((estimate.mean[:n] - positions)[fix]**2, axis=1)
    best = np.sum(np.prod(reference - positions, axis=0)[fix], axis=1)
    found, exact = (replicate(np.bincount(surface[:n][fix], errors)[None], 0)[0]
                    for errors in (own, best))
    value, low, high = found.reduction_from(exact)
    return {'mse_to_reference': (1 - value / 100, 1 - high / 100, 1 - low / 100),
            'reference_positions': n}
