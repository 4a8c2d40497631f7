"""What is constant over a walk: errors that are the same in all phases, and are counted once.

A track multiplies the likelihoods of phases, whose errors would have to be independent. Errors of
elements are not: they turn the same signals in each phase. Their share of the variance of a
position is known, because the signals are linear in them. A track is therefore that of a position
with these errors, which nearly move along with the user while the track remembers; their
covariance is added to its result. Between modes, the evidence of phases with the same error grows
more slowly than their number. Errors of poses are treated in the same way by `fusion`.
"""

import numpy as np

from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.gaussian import quadratic_form
from rhs_isac_ros.model.geometry import jacobian, region_information, to_polar
from rhs_isac_ros.model.impairments import nuisance_of

# Base-2 logarithm of the number of positions over which shares are averaged, and largest share.
_LOG2_NODES = 5
_MOST = 0.98


def constant_shares(model: MeasurementModel) -> np.ndarray:
    """Return the shares of the variances of (r, u, v) that errors of elements cause, float64 [3].

    They are averages over the region of interest.
    """
    if model.elements.is_exact:
        return np.zeros(3)
    from scipy.stats import qmc

    scenario, (low, high) = model.scenario, model.scenario.roi_bounds_m
    positions = low + qmc.Sobol(3, seed=0).random(2**_LOG2_NODES) * (high - low)
    by_point = jacobian(to_polar(positions))
    mean, slopes = model.mean_and_jacobian(positions, by_point)
    nuisance = nuisance_of(scenario)
    slopes = model.whiten(np.concatenate(
        [slopes, nuisance.scaled_patterns * mean[:, None]], axis=1))
    prior = np.eye(slopes.shape[1])
    prior[3:, 3:] *= nuisance.precision
    information = quadratic_form(slopes.reshape(*slopes.shape[:2], -1)) + prior
    information[:, :3, :3] += (
        np.swapaxes(by_point, 1, 2) @ region_information(scenario) @ by_point) - np.eye(3)
    pulls = np.zeros_like(information)
    _, direct = model.elements.errors(scenario, model.beams)
    for band, whitener in enumerate(model.whitener):
        pulls += quadratic_form(slopes[:, :, band].conj() @ (whitener @ direct(band, positions)))
    variances = np.linalg.inv(information)
    constant = variances @ pulls @ variances
    shares = np.diagonal(constant, axis1=1, axis2=2) / np.diagonal(variances, axis1=1, axis2=2)
    return np.minimum(shares[:, :3].mean(axis=0), _MOST)
