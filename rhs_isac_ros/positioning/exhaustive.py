"""The posterior as a weighted sum over the whole region: a slow reference for all estimators."""

from collections.abc import Callable

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.estimate import Estimate, checked_received, stack_parts
from rhs_isac_ros.positioning.whitened import WhitenedModel

_BLOCK = 4096


def exhaustive_posterior(
        scenario: Scenario, codebook: Codebook, received: np.ndarray, log2_points: int = 22,
        progress: Callable[[float], None] | None = None) -> Estimate:
    """Compute mean and covariance of the posterior from points all over the region of interest.

    The prior is uniform on the region. All phases share the 2^log2_points points of a scrambled
    Sobol sequence; the default number takes minutes. `progress` is called with the completed
    share of the points. Signals are complex128 [N, N_B, N_SB F] for an estimate of N positions.

    Raises
    ------
    SignalError
        If the signals have another shape or are not finite.
    """
    from scipy.stats import qmc

    model = WhitenedModel(scenario, codebook)
    batch = checked_received(scenario, codebook, received)
    signals = stack_parts(model.whiten(batch)).astype(np.float32).T
    low, high = scenario.roi_bounds_m
    center = (low + high) / 2
    n = signals.shape[1]
    # Sums of the weights, of the weighted coordinates and of their products. Weights are relative
    # to the highest likelihood so far.
    highest, sums = np.full(n, -np.inf), np.zeros((n, 13))
    sequence, total = qmc.Sobol(3, seed=0), 2**log2_points
    for done in range(0, total, _BLOCK):
        points = (sequence.random(min(_BLOCK, total - done)) - 0.5) * (high - low)
        means = stack_parts(model.mean(points + center)).astype(np.float32)
        log_likelihood = means @ (2 * signals)
        log_likelihood -= np.sum(means**2, axis=1)[:, None]
        previous, highest = highest, np.maximum(highest, log_likelihood.max(axis=0))
        sums *= np.exp(previous - highest)[:, None]
        log_likelihood -= highest.astype(np.float32)
        weights = np.exp(log_likelihood, out=log_likelihood)
        products = (points[:, :, None] * points[:, None, :]).reshape(-1, 9)
        sums += weights.T @ np.hstack([np.ones((len(points), 1)), points, products])
        if progress:
            progress((done + len(points)) / total)
    sums /= sums[:, :1]
    mean = sums[:, 1:4]
    covariance = sums[:, 4:].reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    return Estimate(mean + center, covariance)
