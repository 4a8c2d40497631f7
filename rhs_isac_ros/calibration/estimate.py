"""Estimation of the surface from pilots of a reference user at known positions.

The mean signals are linear in gains and offsets of the elements, and in a band's gain. Multipath
and noise are the noise of this linear model; their covariance contains the multipath that leaks
through the errors of the elements. With better estimates less of it leaks, and the nulls
of the beams, in which the errors are visible, gain weight: the estimation alternates between the
posterior for a covariance, and the covariance for a posterior.
"""

from collections.abc import Callable, Sequence

import numpy as np

from rhs_isac_ros.calibration.mixture import (
    Posterior,
    SurfacePrior,
    surface_posterior,
    without_data,
)
from rhs_isac_ros.calibration.pilots import Pilots, PilotStatistics
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface_estimate import SurfaceEstimate
from rhs_isac_ros.model.threads import one_blas_thread

# Prior of scenarios that declare no errors or failures.
DEFAULT_ERROR_RMS = 0.05
DEFAULT_FAILED_SHARE = 0.01
_MAX_ROUNDS = 30
# The estimation has converged when no parameter moves by more than this share of its deviation.
TOLERANCE = 0.02
# Standard deviation from which a wrapped phase is treated as uniform [rad].
_UNIFORM_STD_RAD = 2.0
# Share of the largest variance below which a direction of the covariance is dropped.
_MIN_VARIANCE = 1e-12


def prior_of(scenario: Scenario) -> SurfacePrior:
    """Return the prior that a scenario declares, with defaults for what it leaves at zero."""
    return SurfacePrior(scenario.element_error_rms or DEFAULT_ERROR_RMS,
                        scenario.failed_element_share or DEFAULT_FAILED_SHARE)


@one_blas_thread
def estimate_surface(
        scenario: Scenario, pilots: Sequence[Pilots], prior: SurfacePrior | None = None,
        progress: Callable[[int, float], None] | None = None) -> SurfaceEstimate:
    """Estimate a surface from pilots.

    Parameters
    ----------
    pilots
        Pilots of one or several codebooks; without any, the result is the prior.
    prior
        By default that of `prior_of`.
    progress
        Called after each round with its number and the largest change of a parameter, in
        standard deviations.

    Raises
    ------
    ValueError
        If the beamforming of pilots does not have the sizes of the scenario.
    """
    prior = prior or prior_of(scenario)
    statistics = PilotStatistics(scenario, pilots)
    n_bands, n = scenario.n_bands, 2 * scenario.n_elements
    band_rms = _band_rms(scenario, prior)
    gains, posterior = np.ones(n_bands, complex), without_data(prior, band_rms, n // 2)
    if not any(len(group.positions) for group in pilots):
        return _result(posterior, gains)
    for count in range(1, _MAX_ROUNDS + 1):
        information, shift = statistics.evaluate(
            gains, posterior.complex_mean()[:n], posterior.complex_covariance()[:n, :n])
        before, posterior = posterior, surface_posterior(
            information, shift, prior, band_rms, posterior.failed)
        gains = gains * (1 + posterior.complex_mean()[n:])
        change = _change(before, posterior, n_bands)
        if progress:
            progress(count, change)
        if change < TOLERANCE:
            break
    return _result(posterior, gains)


def _band_rms(scenario: Scenario, prior: SurfacePrior) -> np.ndarray:
    """RMS of real and imaginary parts of the bands' relative errors in a round [2, N_B].

    A gain or phase that users or cycles draw at random cannot be distinguished from that of
    the bands, which is then fixed: pilots of one user reveal the sum only.
    """
    rms = np.full((2, scenario.n_bands), prior.band_gain_rms / np.sqrt(2))
    if scenario.user_gain_std_db > 0:
        rms[0, 0] = 0.0
    if scenario.band_phase_std_rad > _UNIFORM_STD_RAD:
        rms[1] = 0.0
    elif scenario.phase_std_rad > _UNIFORM_STD_RAD:
        rms[1, 0] = 0.0
    return rms


def _change(before: Posterior, after: Posterior, n_bands: int) -> float:
    """Largest change of a parameter, in standard deviations; the bands' are changes already."""
    moved = np.abs(after.complex_mean() - before.complex_mean())
    moved[-n_bands:] = np.abs(after.complex_mean()[-n_bands:])
    std = np.sqrt(np.maximum(np.diagonal(after.complex_covariance()).real, 1e-300))
    return float(np.max(moved / np.maximum(std, 1e-9)))


def _result(posterior: Posterior, band_gains: np.ndarray) -> SurfaceEstimate:
    mean = posterior.complex_mean()
    n = len(posterior.failed)
    values, vectors = np.linalg.eigh(posterior.complex_covariance())
    kept = values > _MIN_VARIANCE * max(values[-1], 0.0)
    return SurfaceEstimate(
        mean[:n], mean[n:2 * n], band_gains, vectors[:, kept] * np.sqrt(values[kept]),
        posterior.failed_probability)
