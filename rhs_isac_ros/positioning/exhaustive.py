"""The posterior as a weighted sum over the whole region: a slow reference for all estimators."""

from collections.abc import Callable

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.imperfections import SurfaceImperfection, has_element_errors
from rhs_isac_ros.model.nuisance import nuisance_parameters
from rhs_isac_ros.model.threads import one_blas_thread
from rhs_isac_ros.positioning.estimate import Estimate, checked_received, stack_parts
from rhs_isac_ros.positioning.exhaustive_errors import ElementErrorLikelihood
from rhs_isac_ros.positioning.exhaustive_nuisance import NuisanceLikelihood

_BLOCK = 4096


@one_blas_thread
def exhaustive_posterior(
        scenario: Scenario, codebook: Codebook, received: np.ndarray, log2_points: int = 22,
        progress: Callable[[float], None] | None = None, *,
        surface: SurfaceImperfection | None = None, seed: int = 0) -> Estimate:
    """Compute mean and covariance of the posterior from points all over the region of interest.

    The prior is uniform on the region. All phases share the 2^log2_points points of a Sobol
    sequence, scrambled with the seed; the default number takes minutes. `progress` is called with
    the completed share of the points. Signals are complex128 [N, N_B, N_SB F] for an estimate of
    N positions.

    Gains, phases and offsets that the scenario declares as unknown are integrated out at every
    point; see `NuisanceLikelihood`. Element errors are treated as Gaussian, with their covariance
    at every point, see `ElementErrorLikelihood`, unless `surface` contains them: no estimator
    without this knowledge has a lower mean squared error.

    Raises
    ------
    SignalError
        If the signals have another shape or are not finite.
    ValueError
        If the scenario declares a combination of deviations that is not supported.
    """
    from scipy.stats import qmc

    codebook.check(scenario)
    batch = checked_received(scenario, codebook, received)
    log_likelihood_at = _likelihood(scenario, codebook, batch, surface, 2**log2_points)
    low, high = scenario.roi_bounds_m
    center = (low + high) / 2
    n = len(batch)
    # Sums of the weights, of the weighted coordinates and of their products. Weights are relative
    # to the highest likelihood so far.
    highest, sums = np.full(n, -np.inf), np.zeros((n, 13))
    sequence, total = qmc.Sobol(3, seed=seed), 2**log2_points
    for done in range(0, total, _BLOCK):
        points = (sequence.random(min(_BLOCK, total - done)) - 0.5) * (high - low)
        log_likelihood = log_likelihood_at(points + center)
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


def _likelihood(scenario: Scenario, codebook: Codebook, received: np.ndarray,
                surface: SurfaceImperfection | None, n_points: int
                ) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of positions [P, 3] with the log-likelihood of each phase, [P, N]."""
    if nuisance_parameters(scenario):
        return NuisanceLikelihood(scenario, codebook, received)
    if has_element_errors(scenario) and surface is None:
        return ElementErrorLikelihood(scenario, codebook, received, n_points)
    model = MeasurementModel(scenario, codebook, surface).prepare()
    signals = stack_parts(model.whiten(received)).astype(np.float32).T

    def log_likelihood(positions: np.ndarray) -> np.ndarray:
        means = stack_parts(model.whiten(model.mean(positions))).astype(np.float32)
        values: np.ndarray = means @ (2 * signals)
        values -= np.sum(means**2, axis=1)[:, None]
        return values

    return log_likelihood
