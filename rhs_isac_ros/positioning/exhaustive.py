"""The posterior by weighing points everywhere: minutes long, and the measure of all estimators."""

from collections.abc import Callable

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.estimate import Estimate, checked_received
from rhs_isac_ros.positioning.whitened import WhitenedModel

_BLOCK = 4096


def exhaustive_posterior(
        scenario: Scenario, codebook: Codebook, received: np.ndarray, log2_points: int = 22,
        progress: Callable[[float], None] | None = None) -> Estimate:
    """Mean and covariance of the posterior as sums over even points of the region of interest.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook.
    received
        Complex128 [N, N_B, N_SB F]; all phases share the points.
    log2_points
        Binary logarithm of the number of points, a scrambled Sobol sequence.
    progress
        Called with the share of the points that is done.

    Returns
    -------
    Estimate
        Of N positions; the prior is uniform on the region.

    Raises
    ------
    SignalError
        If the shape is another one or a value is not finite.
    """
    from scipy.stats import qmc

    model = WhitenedModel(scenario, codebook)
    batch = checked_received(scenario, codebook, received)
    signals = _parts(model.whiten(batch)).T
    low, high = scenario.roi_bounds_m
    center = (low + high) / 2
    n = signals.shape[1]
    # Sums of weight, weighted coordinates and their products, relative to the highest so far.
    highest, sums = np.full(n, -np.inf), np.zeros((n, 13))
    sequence, total = qmc.Sobol(3, seed=0), 2**log2_points
    for done in range(0, total, _BLOCK):
        points = (sequence.random(min(_BLOCK, total - done)) - 0.5) * (high - low)
        templates = _parts(model.mean(points + center))
        logarithm = templates @ (2 * signals)
        logarithm -= np.sum(templates**2, axis=1)[:, None]
        risen = np.maximum(highest, logarithm.max(axis=0))
        sums *= np.exp(highest - risen)[:, None]
        highest = risen
        logarithm -= highest.astype(np.float32)
        weights = np.exp(logarithm, out=logarithm)
        products = (points[:, :, None] * points[:, None, :]).reshape(-1, 9)
        sums += weights.T @ np.hstack([np.ones((len(points), 1)), points, products])
        if progress:
            progress((done + len(points)) / total)
    sums /= sums[:, :1]
    mean = sums[:, 1:4]
    covariance = sums[:, 4:].reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    return Estimate(mean + center, covariance)


def _parts(signals: np.ndarray) -> np.ndarray:
    """Real and imaginary parts side by side, float32 [N, 2 N_B N_SB F]."""
    flat = signals.reshape(len(signals), -1)
    return np.hstack([flat.real, flat.imag]).astype(np.float32)
