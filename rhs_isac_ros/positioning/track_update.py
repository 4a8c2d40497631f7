"""The update of a predicted mixture with the modes of a positioning phase."""

import numpy as np

from rhs_isac_ros.positioning.mixture import Mixture, concatenate
from rhs_isac_ros.positioning.modes import EXACT_MARGIN, Modes, local_model
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Maximum number of pairs of a component and a mode, and smallest weight of one relative to the
# heaviest.
_MAX_PAIRS = 160
_PAIR_MARGIN = 18.0
# Pairs whose likelihood the exact model evaluates. The Gaussian of a mode alone has errors that
# accumulate over the phases and prefer wrong modes.
_N_EXACT = 16
# Squared Mahalanobis distance below which two updates of a component are the same maximum.
_SAME_MAXIMUM = 1.0
# Log-likelihood, relative to that of the best mode, of a mode that the search has missed: it finds
# those above.
_FLOOR = -EXACT_MARGIN


def update(
        predicted: Mixture, modes: Modes, share: float, model: WhitenedModel | None,
        whitened: np.ndarray) -> Mixture:
    """Return the product of a predicted mixture and the likelihood of a phase, not normalised.

    Every mode updates every component. Components also remain without an update, as if a mode with
    a low likelihood, as wide as the best one, had been missed at an unknown place inside them.

    Parameters
    ----------
    modes
        Modes of the likelihood.
    share
        Exponent of the likelihood, from 0 to 1; below 1 for signals whose multipath was in part
        received before.
    model
        Model with which the likelihood of the heaviest pairs is evaluated; None to use the
        Gaussians of the modes.
    whitened
        Whitened signals of the phase, complex128 [N_B, N_SB F].
    """
    spread = np.linalg.inv(modes.curvature) / share
    offsets = modes.points[:, None] - predicted.means[:, :3]
    log_weights, precision = _evidence(
        offsets, predicted.covariances[:, :3, :3], spread[:, None])
    log_weights += share * modes.log_likelihood[:, None] + predicted.log_weights
    flat = log_weights.ravel()
    order = np.argsort(-flat)[:_MAX_PAIRS]
    order = order[flat[order] >= flat[order[0]] - _PAIR_MARGIN]
    mode, component = np.unravel_index(order, log_weights.shape)
    updated = _shifted(predicted.select(component)._replace(log_weights=flat[order]),
                       precision[mode, component], offsets[mode, component])
    if model is not None:
        # The pairs are in the order of their weights.
        head = np.arange(min(_N_EXACT, len(order)))
        exact = _exact_update(
            predicted.select(component[head]), updated.means[head, :3], share, model, whitened)
        exact = exact.select(_is_first(exact, component[head]))
        updated = concatenate(exact, updated.select(np.arange(len(head), len(order))))
    best = int(np.argmax(modes.roi_log_likelihood))
    floor, _ = _evidence(np.zeros(3), predicted.covariances[:, :3, :3], spread[best])
    floor += share * (modes.roi_log_likelihood[best] + _FLOOR)
    return concatenate(
        updated, predicted._replace(log_weights=predicted.log_weights + floor))


def _exact_update(
        predicted: Mixture, points: np.ndarray, share: float, model: WhitenedModel,
        whitened: np.ndarray) -> Mixture:
    """Update every component with the likelihood expanded at a point (r, u, v), [C, 3]."""
    curvature, gradient, value = local_model(model, points, whitened)
    step = np.linalg.solve(curvature, gradient[..., None])[..., 0]
    offsets = points + step - predicted.means[:, :3]
    log_weights, precision = _evidence(
        offsets, predicted.covariances[:, :3, :3], np.linalg.inv(curvature) / share)
    log_weights += share * (value + np.sum(gradient * step, axis=1) / 2)
    log_weights += predicted.log_weights
    return _shifted(predicted._replace(log_weights=log_weights), precision, offsets)


def _is_first(updated: Mixture, component: np.ndarray) -> np.ndarray:
    """Return which components are not equal to an earlier one, bool [C].

    Modes that have not converged may lead one predicted component, given by its index, to the
    same maximum, which must not count twice.
    """
    points = updated.means[:, :3]
    offsets = points[:, None] - points
    precision = np.linalg.inv(updated.covariances[:, :3, :3])
    distance = np.einsum('abp,apq,abq->ab', offsets, precision, offsets)
    same = (distance < _SAME_MAXIMUM) & (component[:, None] == component)
    first: np.ndarray = ~np.tril(same, -1).any(axis=1)
    return first


def _evidence(
        offsets: np.ndarray, predicted: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the product of two Gaussians, one a density, the other with the maximum 1.

    Returns the logarithm, float64 [...], and the precision of the offset, float64 [..., 3, 3].

    Parameters
    ----------
    offsets
        Differences of the means, float64 [..., 3].
    predicted, spread
        Covariance of the density and of the other, float64 [..., 3, 3].
    """
    total = predicted + spread
    precision = np.linalg.inv(total)
    distance = np.einsum('...p,...pq,...q->...', offsets, precision, offsets)
    log_value = (np.linalg.slogdet(spread)[1] - np.linalg.slogdet(total)[1] - distance) / 2
    return log_value, precision


def _shifted(mixture: Mixture, precision: np.ndarray, offsets: np.ndarray) -> Mixture:
    """Apply the Kalman update with innovations [C, 3] and their precision [C, 3, 3]."""
    gain = np.matmul(mixture.covariances[:, :, :3], precision)
    means = mixture.means + np.matmul(gain, offsets[..., None])[..., 0]
    covariances = mixture.covariances - np.matmul(gain, mixture.covariances[:, :3])
    covariances = (covariances + np.swapaxes(covariances, 1, 2)) / 2
    return mixture._replace(means=means, covariances=covariances)
