"""Confusion of ranges at which the signals have similar phases in all bands.

If two ranges differ by a lag r, the phases of a carrier f_i differ by 2 pi f_i r / v_0. The range
ambiguity function is the mismatch sum_i (1 - cos(2 pi f_i r / v_0)) over the bands. Its local
minima, apart from 0, are the lags that are hard to distinguish from 0. The function depends only
on the frequencies, so many band plans can be compared in little time.
"""

import numpy as np

from rhs_isac_ros.bounds.pairwise_error import best_phases
from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.arrays import blocks, checked_positions, mixture_weights
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.gaussian import step_to_maximum
from rhs_isac_ros.model.impairments import nuisance_of

# Number of grid points of the lag per shortest wavelength.
_LAGS_PER_WAVELENGTH = 24
# Number of draws of the noise at each position.
_DRAWS = 16
# Number of band plans evaluated at a time.
_BLOCK = 128


def range_confusion_error(
        frequencies_hz: np.ndarray, energies: np.ndarray, max_lag_m: float) -> np.ndarray:
    """Estimate the squared error from confused ranges for P band plans, float64 [P] [m^2].

    A minimum at a lag r of either sign has the weight ``w = (1 - |r| / r_max) Q(sqrt(q / 2))``,
    with q = 2 E sum_i (1 - cos(2 pi f_i r / v_0)) / N_B. The factor ``1 - |r| / r_max`` is the
    share of positions for which the lag stays inside the region. The estimate, averaged over the
    energies E, is sum w r^2 / (1/2 + sum w): the mean of r^2 over the confused ranges and the true
    one.

    Takes the centre frequencies of each plan, float64 [P, N_B] [Hz], the energies E of the
    whitened mean signals of all bands at some positions, float64 [N], and r_max [m].
    """
    # A slow import, not needed to load a codebook.
    from scipy.special import ndtr

    n_bands = frequencies_hz.shape[1]
    errors = np.zeros(len(frequencies_hz))
    lags = _lags(float(frequencies_hz.max()), max_lag_m)
    # The cosines of each distinct frequency are computed once.
    distinct, index = np.unique(frequencies_hz, return_inverse=True)
    cosines = np.cos(2 * np.pi / SPEED_OF_LIGHT_MPS * np.outer(distinct, lags))
    index = index.reshape(frequencies_hz.shape)
    for block in blocks(len(errors), _BLOCK):
        mismatch = n_bands - sum(cosines[index[block, i]] for i in range(n_bands))
        plan, lag = np.nonzero(_is_minimum(mismatch))
        ratio = np.sqrt(_refined(mismatch, plan, lag) / n_bands)
        share = 1 - lags[lag] / max_lag_m
        for energy in energies:
            # Twice the share, because lags have both signs.
            weights = 2 * share * ndtr(-ratio * np.sqrt(energy))
            total, confused = (np.bincount(plan, values, minlength=len(mismatch))
                               for values in (weights, weights * lags[lag]**2))
            errors[block] += confused / (0.5 + total) / len(energies)
    return errors


def range_confusion_error_of(
        model: MeasurementModel, positions: np.ndarray, rng: np.random.Generator) -> float:
    """Estimate the squared error from confused ranges for one codebook [m^2].

    This is the squared range error of the posterior mean over a true position and confused ones,
    averaged over N true positions, float64 [N, 3] [m]. Confused positions lie in the region, on
    the line of sight, at lags that are minima of the mismatch. A small displacement, to first
    order, and declared unknown phases make their signals as similar as possible to those of the
    true position. Noise is drawn several times for each position.
    """
    positions = checked_positions(positions)
    scenario = model.scenario
    low, high = scenario.roi_bounds_m
    frequencies = np.array(scenario.center_frequencies_hz)
    lags = _lags(float(frequencies.max()), float(np.linalg.norm(high - low)))
    mismatch = np.sum(
        1 - np.cos(2 * np.pi / SPEED_OF_LIGHT_MPS * np.outer(frequencies, lags)), axis=0)
    lags = lags[_is_minimum(mismatch[None])[0]]
    lags = np.concatenate([-lags, lags])
    means = model.mean(positions)
    error = 0.0
    for position, mean in zip(positions, means, strict=True):
        confused = position * (1 + lags[:, None] / np.linalg.norm(position))
        inside = ((confused >= low) & (confused <= high)).all(axis=1)
        if not inside.any():
            continue
        difference, penalties = _differences(model, mean, confused[inside])
        # The real and imaginary parts of the noise have variance 1/2 each.
        noise = rng.normal(scale=np.sqrt(0.5), size=(_DRAWS, difference.shape[1]))
        exponents = 2 * noise @ difference.T - np.sum(difference**2, axis=1) - penalties / 2
        # The true position, with the lag 0, has the exponent 0.
        weights, _ = mixture_weights(np.pad(exponents, ((0, 0), (0, 1))))
        error += float(np.mean((weights[:, :-1] @ lags[inside])**2))
    return error / len(positions)


def _differences(
        model: MeasurementModel, mean: np.ndarray, confused: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest whitened differences, real [n, 2 N_B R], and costs of the phases [n]."""
    means, jacobians = model.mean_and_jacobian(confused)
    means, jacobians, target = model.whiten(means), model.whiten(jacobians), model.whiten(mean)
    (scales, precision), penalties = (
        nuisance_of(model.scenario).scaled_phases, np.zeros(len(confused)))
    slopes = jacobians
    if scales.size:
        products = 2 * np.sum(np.conj(means) * target, axis=2)
        phases, penalties = best_phases(products, scales, precision)
        turns = np.exp(1j * phases)[..., None]
        means, jacobians = turns * means, turns[:, None] * jacobians
        # Displacements and phases can compensate for each other.
        turned = 1j * means[:, None] * scales.T[None, :, :, None]
        slopes = np.concatenate([jacobians, turned], axis=1)
    difference, directions = _real(means - target), _real(slopes)
    by_position = np.einsum('nur,nr->nu', directions, difference)
    information = np.einsum('nur,nvr->nuv', directions, directions)
    # `information` is half the curvature, to which the prior of the phases adds its own.
    information[:, 3:, 3:] += np.diag(precision) / 2
    displacement = step_to_maximum(information, by_position)
    return difference - np.einsum('nu,nur->nr', displacement, directions), penalties


def _lags(highest_hz: float, max_lag_m: float) -> np.ndarray:
    shortest = SPEED_OF_LIGHT_MPS / highest_hz
    return np.linspace(0, max_lag_m, 3 + int(max_lag_m / shortest * _LAGS_PER_WAVELENGTH))


def _is_minimum(mismatch: np.ndarray) -> np.ndarray:
    """Mark the local minima of each row, except at the ends of the row, bool [P, L]."""
    inside = mismatch[:, 1:-1]
    is_minimum = (inside <= mismatch[:, :-2]) & (inside < mismatch[:, 2:])
    return np.pad(is_minimum, ((0, 0), (1, 1)))


def _refined(mismatch: np.ndarray, plan: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """Return minima [n], at least 0, of parabolas through grid minima and their neighbours."""
    before, at, after = (mismatch[plan, lag + step] for step in (-1, 0, 1))
    lowest = at - (after - before)**2 / (8 * (before - 2 * at + after))
    return np.maximum(lowest, 0.0)


def _real(signals: np.ndarray) -> np.ndarray:
    """Return complex signals [..., N_B, R] as real vectors [..., 2 N_B R]."""
    flat = np.ascontiguousarray(signals).reshape(*signals.shape[:-2], -1)
    return flat.view(float)
