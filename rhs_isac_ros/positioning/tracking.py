"""The track of a user over successive positioning phases.

The signals of a phase often fit several positions, 0.6 m apart in range on Table I. The tracker
keeps them all, as a mixture of Gaussians over position and velocity, until the movement over
several phases decides between them.
"""

import dataclasses

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import time_correlation
from rhs_isac_ros.positioning.alternatives import BLOCKED_LIMIT
from rhs_isac_ros.positioning.coordinates import concatenate, is_inside, jacobian, symmetric
from rhs_isac_ros.positioning.estimate import Estimate
from rhs_isac_ros.positioning.estimators import SearchEstimator
from rhs_isac_ros.positioning.lattice import Resolution
from rhs_isac_ros.positioning.likelihood import Likelihood, Signals
from rhs_isac_ros.positioning.motion import Mixture, Motion, reduce
from rhs_isac_ros.positioning.posterior import Posterior
from rhs_isac_ros.positioning.search import EXACT_MARGIN, Modes
from rhs_isac_ros.support.threads import one_blas_thread

# Maximum number of components between phases.
MAX_COMPONENTS = 48
# A track ends after this time without a position [s].
MAX_GAP_S = 10.0
# Rate at which a track is assumed to be wrong [1/s]; the user is then anywhere in the region.
_LOSS_RATE_HZ = 1e-3
# Smallest share of a component inside the region.
_MIN_INSIDE = 0.02
# Phases with a smaller share of new information do not update the track: with the likelihood
# raised to a small power, its modes overlap, and their sum is no longer its value.
_MIN_SHARE = 0.25
# Components with a smaller weight do not contribute to the estimate.
_MIN_LOG_WEIGHT = -9.0
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


@dataclasses.dataclass(frozen=True, eq=False)
class TrackEstimate(Estimate):
    """A position and velocity with their uncertainty, or the reason why there is none.

    Attributes
    ----------
    velocity
        Float64 [3] [m/s]; NaN without a position.
    velocity_covariance
        Float64 [3, 3] [m^2/s^2]; NaN without a position.
    n_phases
        Number of phases that contribute to the estimate; 0 without a position.
    is_predicted
        Whether the position is a prediction, because the user is blocked.
    """

    velocity: np.ndarray = dataclasses.field(default_factory=lambda: np.full(3, np.nan))
    velocity_covariance: np.ndarray = dataclasses.field(
        default_factory=lambda: np.full((3, 3), np.nan))
    n_phases: int = 0
    is_predicted: bool = False


class Tracker:
    """The track of one user: a Gaussian mixture filter over the modes of the posterior.

    The first position of a track is the estimate itself. A track ends with a gap of more than
    `MAX_GAP_S`; signals without a position do not change it, and neither do those whose multipath
    is almost equal to the previous phase's. While the user is blocked, the position is a
    prediction. Positions are inside the region of interest.

    The attribute `estimator` may be replaced between phases, for example by the estimator of
    another codebook, whose probabilities of a user outside or blocked are part of the estimates.
    """

    def __init__(self, estimator: SearchEstimator, motion: Motion | None = None) -> None:
        self.estimator, self._motion = estimator, motion or Motion()
        self._mixture: Mixture | None = None
        # Time of the mixture, and of the latest phase, which may not have changed it [s].
        self._time_s = self._latest_s = -np.inf
        self._n_phases = 0

    @one_blas_thread
    def update(self, time_s: float, received: np.ndarray) -> TrackEstimate:
        """Return the position and velocity at the time [s] of a phase, from it and earlier ones.

        Takes signals, complex128 [N_B, N_SB F]; `SignalError` if they cannot be used. The position
        for a phase that is not later than the last one follows from its signals alone, and the
        track does not change.
        """
        posterior = self.estimator.posterior(received)
        if posterior.modes is None:
            return self._predicted(time_s, posterior.estimate)
        if time_s <= self._latest_s:
            return _described(posterior.estimate, self._start(posterior.modes), 1)
        self._latest_s = time_s
        elapsed_s = time_s - self._time_s
        if self._mixture is None or elapsed_s > MAX_GAP_S:
            self._mixture, self._time_s = self._start(posterior.modes).normalised(), time_s
            self._n_phases = 1
            return _described(posterior.estimate, self._mixture, 1)
        mixture = self._motion.predict(self._mixture, elapsed_s)
        share = independent_share(self.estimator.scenario, elapsed_s)
        if share >= _MIN_SHARE:
            mixture = self._updated(mixture, posterior, share, elapsed_s)
        mixture, mean, covariance = self._inside(mixture)
        if share >= _MIN_SHARE:
            self._mixture, self._time_s = mixture, time_s
            self._n_phases += 1
        found = posterior.estimate
        estimate = dataclasses.replace(found, mean=mean, covariance=covariance)
        return _described(estimate, mixture, self._n_phases)

    def _predicted(self, time_s: float, found: Estimate) -> TrackEstimate:
        """Continue the track of a blocked user without a change; other users get no position."""
        elapsed_s = time_s - self._time_s
        if (self._mixture is None or not 0 < elapsed_s <= MAX_GAP_S
                or not found.blocked_probability > BLOCKED_LIMIT):
            return TrackEstimate(**vars(found))
        self._latest_s = max(time_s, self._latest_s)
        mixture, mean, covariance = self._inside(
            self._motion.predict(self._mixture, elapsed_s))
        estimate = dataclasses.replace(found, mean=mean, covariance=covariance, reason='')
        return dataclasses.replace(
            _described(estimate, mixture, self._n_phases), is_predicted=True)

    def _start(self, modes: Modes, share: float = 1.0) -> Mixture:
        """Return the mixture of a user anywhere in the region, weighted with its likelihood."""
        covariances = np.linalg.inv(modes.curvature) / share
        log_mass = (np.log(np.linalg.det(jacobian(modes.roi_points))) + 1.5 * np.log(2 * np.pi)
                    + np.linalg.slogdet(covariances)[1] / 2)
        volume_m3 = Resolution.of(self.estimator.scenario).volume_m3
        return self._motion.start(
            modes.roi_points, covariances,
            share * modes.roi_log_likelihood + log_mass - np.log(volume_m3))

    def _updated(
            self, predicted: Mixture, posterior: Posterior, share: float, elapsed_s: float
    ) -> Mixture:
        modes, estimate = posterior.modes, posterior.estimate
        assert modes is not None
        parts = [update(
            predicted, modes, share, self.estimator.exact_likelihood, posterior.signals)]
        lost = self._start(modes, share)
        blocked, outside = np.nan_to_num([
            estimate.blocked_probability, estimate.outside_probability])
        if blocked:
            # Signals without a direct path say nothing. The probability is relative to that of a
            # user anywhere in the region.
            odds = share * np.log(blocked / max(1 - blocked - outside, 1e-12))
            weight = np.logaddexp.reduce(lost.log_weights) + odds
            parts.append(predicted._replace(log_weights=predicted.log_weights + weight))
        lost = lost._replace(log_weights=lost.log_weights + np.log(_LOSS_RATE_HZ * elapsed_s))
        return reduce(concatenate(*parts, lost), MAX_COMPONENTS).normalised()

    def _inside(self, mixture: Mixture) -> tuple[Mixture, np.ndarray, np.ndarray]:
        """Return the components that reach the region, and mean and covariance inside."""
        heavy = mixture.log_weights >= _MIN_LOG_WEIGHT
        mixture, light = mixture.select(heavy), mixture.select(~heavy)
        positions = mixture.positions(self.estimator.normal)
        bounds_m = Resolution.of(self.estimator.scenario).bounds_m
        inside = is_inside(positions, bounds_m)
        reaches = inside.mean(axis=1) >= _MIN_INSIDE
        if reaches.any():
            mixture, positions = mixture.select(reaches), positions[reaches]
            inside = inside[reaches]
        else:
            inside[...] = True
            positions = np.clip(positions, *bounds_m)
        weights = np.exp(mixture.log_weights)[:, None] * inside
        flat, points = (weights / weights.sum()).ravel(), positions.reshape(-1, 3)
        mean = flat @ points
        offsets = points - mean
        covariance = (flat[:, None] * offsets).T @ offsets
        mixture = concatenate(mixture, light).normalised()
        return mixture, mean, symmetric(covariance)


def _described(estimate: Estimate, mixture: Mixture, n_phases: int) -> TrackEstimate:
    velocity, covariance = mixture.velocity()
    return TrackEstimate(
        **vars(estimate), velocity=velocity, velocity_covariance=covariance, n_phases=n_phases)


def independent_share(scenario: Scenario, elapsed_s: float) -> float:
    """Return the share of a phase's information that the previous phase does not contain.

    With the correlation rho of Eq. (4) between the phases, averaged over the bands, N phases at
    one place contain as much information as N (1 - rho) / (1 + rho) independent ones. A negative
    correlation, which would add information, counts as none.
    """
    lag = np.array(elapsed_s / scenario.frame_duration_s)
    rho = np.array([float(time_correlation(scenario, band, lag, np.array(0.0)))
                    for band in range(scenario.n_bands)])
    # Without movement of the scatterers, the phases are identical.
    rho = np.clip(rho, 0.0, 1 - 1e-6)
    mean = float(np.mean(rho))
    return (1 - mean) / (1 + mean)


def update(
        predicted: Mixture, modes: Modes, share: float, likelihood: Likelihood | None,
        signals: Signals) -> Mixture:
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
    likelihood
        With which the heaviest pairs are evaluated; None to use the Gaussians of the modes.
    signals
        Signals of the phase, N = 1.
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
    if likelihood is not None:
        # The pairs are in the order of their weights.
        head = np.arange(min(_N_EXACT, len(order)))
        exact = _exact_update(
            predicted.select(component[head]), updated.means[head, :3], share, likelihood, signals)
        exact = exact.select(_is_first(exact, component[head]))
        updated = concatenate(exact, updated.select(np.arange(len(head), len(order))))
    best = int(np.argmax(modes.roi_log_likelihood))
    floor, _ = _evidence(np.zeros(3), predicted.covariances[:, :3, :3], spread[best])
    floor += share * (modes.roi_log_likelihood[best] + _FLOOR)
    return concatenate(
        updated, predicted._replace(log_weights=predicted.log_weights + floor))


def _exact_update(
        predicted: Mixture, points: np.ndarray, share: float, likelihood: Likelihood,
        signals: Signals) -> Mixture:
    """Update every component with the likelihood expanded at a point (r, u, v), [C, 3]."""
    value, gradient, curvature, _ = likelihood.local(
        points, np.zeros((len(points), 0)), signals.repeated(0, len(points)))
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
    return ~np.tril(same, -1).any(axis=1)


def _evidence(
        offsets: np.ndarray, predicted: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the product of two Gaussians, one a density, the other with the maximum 1.

    Takes the differences of the means, float64 [..., 3], and the covariances of both. Returns the
    logarithm, float64 [...], and the precision of the offset, float64 [..., 3, 3].
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
    return mixture._replace(means=means, covariances=symmetric(covariances))
