"""The track of a user over successive positioning phases.

With Table I, the signals of a phase often fit several positions, 0.6 m apart in range. The tracker
keeps all these positions, as a mixture of Gaussians over position and velocity, until the movement
over several phases decides between them. Velocities are assumed to drift at random, with sudden
turns. The module `coordinates` describes the coordinates.
"""

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.gaussian import step_to_maximum
from rhs_isac_ros.model.multipath import time_correlation
from rhs_isac_ros.positioning.alternatives import BLOCKED_LIMIT
from rhs_isac_ros.positioning.coordinates import (
    concatenate,
    is_inside,
    jacobian,
    log_sum,
    moments,
    select,
    symmetric,
    to_polar,
    to_positions,
)
from rhs_isac_ros.positioning.estimate import Estimate
from rhs_isac_ros.positioning.estimators import SearchEstimator
from rhs_isac_ros.positioning.lattice import Resolution
from rhs_isac_ros.positioning.likelihood import Likelihood, Signals
from rhs_isac_ros.positioning.posterior import Posterior
from rhs_isac_ros.positioning.search import EXACT_MARGIN, Modes
from rhs_isac_ros.support.threads import one_blas_thread

# Maximum number of components between phases.
MAX_COMPONENTS = 48
# A track ends after this time without an update [s].
MAX_GAP_S = 10.0
# Rate at which a track is assumed to be wrong [1/s]; the user is then anywhere in the region.
_LOSS_RATE_HZ = 1e-3
# Smallest share of a component inside the region.
_MIN_INSIDE = 0.02
# Phases with a smaller share of new information do not update the track. The share is an exponent
# of the likelihood; with a small one, modes overlap, and the likelihood is no longer their sum.
_MIN_SHARE = 0.25
# Components with a smaller weight do not contribute to the estimate.
_MIN_LOG_WEIGHT = -9.0
# Maximum number of pairs of a component and a mode.
_MAX_PAIRS = 160
# Number of pairs whose likelihood is evaluated with the exact model. Errors of the Gaussians alone
# accumulate over the phases and favour wrong modes.
_N_EXACT = 16
# Log-likelihood of a mode that the search has missed, relative to the best mode. The search finds
# all modes above this value.
_FLOOR = -EXACT_MARGIN
# Bounds of the intervals, as shares of the time between two phases, for which turns are modelled
# separately. A single interval would make the position after an early turn too unlikely, because
# its Gaussian applies to the mean time of a turn.
_TURN_INTERVALS = (0.0, 0.5, 1.0)
# Components whose log-weight is below the heaviest by more than this do not turn.
_TURN_MARGIN = 10.0
# Components whose squared Mahalanobis distance is below this are merged.
_MERGE_DISTANCE = 1.0
# Components whose log-weight is below the heaviest by more than this are discarded.
_WEIGHT_MARGIN = 18.0


class Mixture(NamedTuple):
    """A mixture of C Gaussians."""

    log_weights: np.ndarray  # Float64 [C].
    means: np.ndarray  # (r [m], u, v) and their rates of change per second, float64 [C, 6].
    covariances: np.ndarray  # Float64 [C, 6, 6].

    def normalised(self) -> 'Mixture':
        """Return the mixture with weights whose sum is one."""
        return self.weighted(-log_sum(self.log_weights))

    def weighted(self, log_factor: float | np.ndarray) -> 'Mixture':
        """Return the mixture with its weights multiplied by a factor, given as its logarithm."""
        return self._replace(log_weights=self.log_weights + log_factor)

    def velocity(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean, float64 [3] [m/s], and covariance, float64 [3, 3], of the velocity."""
        weights, _ = mixture_weights(self.log_weights)
        by_rate = jacobian(self.means[:, :3])
        within = np.matmul(np.matmul(by_rate, self.covariances[:, 3:, 3:]),
                           np.swapaxes(by_rate, 1, 2))
        mean, between = moments(weights, np.matmul(by_rate, self.means[:, 3:, None])[..., 0])
        return mean, symmetric(np.tensordot(weights, within, axes=1) + between)


def reduce(mixture: Mixture, max_components: int) -> Mixture:
    """Merge components close to a heavier one; discard light ones and any beyond the maximum."""
    order = np.argsort(-mixture.log_weights)
    order = order[mixture.log_weights[order] >= mixture.log_weights[order[0]] - _WEIGHT_MARGIN]
    mixture = select(mixture, order)
    precisions = np.linalg.inv(mixture.covariances)
    group = np.full(len(order), -1)
    for number in range(max_components):
        free = group < 0
        if not free.any():
            break
        leader = int(np.argmax(free))
        offsets = mixture.means - mixture.means[leader]
        distance = np.einsum('cp,cp->c', offsets @ precisions[leader], offsets)
        group[free & (distance < _MERGE_DISTANCE)] = number
    return _merge(mixture, group)


def _merge(mixture: Mixture, group: np.ndarray) -> Mixture:
    """Merge the components of each group, preserving mean and covariance; discard group -1."""
    members = np.equal.outer(np.arange(group.max() + 1), group)
    shares, log_weights = mixture_weights(np.where(members, mixture.log_weights, -np.inf))
    means = shares @ mixture.means
    offsets = mixture.means - means[group]
    spread = mixture.covariances + offsets[:, :, None] * offsets[:, None, :]
    covariances = (shares @ spread.reshape(len(group), -1)).reshape(-1, 6, 6)
    return Mixture(log_weights, means, covariances)


@dataclasses.dataclass(frozen=True)
class Motion:
    """A random velocity with sudden turns; its distribution is the same in all directions.

    Between turns, the velocity is an Ornstein-Uhlenbeck process: over times much shorter than
    `memory_s`, it is constant up to noise. At a turn, which may also be a stop or a start, it is
    redrawn. The numbers of turns in disjoint intervals are independent.
    """

    speed_mps: float = 1.0  #: Root-mean-square speed.
    memory_s: float = 5.0  #: Correlation time of the velocity between turns.
    turn_s: float = 2.0  #: Mean time between turns.

    def __post_init__(self) -> None:
        """Raise ValueError unless all fields are positive and finite."""
        for name in ('speed_mps', 'memory_s', 'turn_s'):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ValueError(f'{name}: {value}, expected a positive number')

    @property
    def velocity_variance(self) -> float:
        """Variance of each component of the velocity [m^2/s^2]."""
        return self.speed_mps**2 / 3

    def start(self, points: np.ndarray, covariances: np.ndarray,
              log_weights: np.ndarray) -> Mixture:
        """Return a mixture at points (r [m], u, v) with velocities of the stationary process."""
        n = len(points)
        means, joint = np.zeros((n, 6)), np.zeros((n, 6, 6))
        means[:, :3], joint[:, :3, :3] = points, covariances
        joint[:, 3:, 3:] = self.velocity_variance * _isotropic(points)
        return Mixture(log_weights, means, joint)

    def predict(self, mixture: Mixture, elapsed_s: float) -> Mixture:
        """Return the mixture after a time [s].

        Every component splits into one without a turn and, unless its weight is low, one with a
        turn in each of the `_TURN_INTERVALS`. Means move in straight lines; the covariances
        neglect the curvature of the coordinates.
        """
        log_no_turn = -elapsed_s / self.turn_s
        turn = -np.expm1(log_no_turn)
        straight = self._straight(mixture, elapsed_s).weighted(log_no_turn)
        heavy = mixture.log_weights >= mixture.log_weights.max() - _TURN_MARGIN
        mixture = select(mixture, heavy)
        return concatenate(
            straight,
            *(self._turned(mixture.weighted(np.log(turn * (end - begin))),
                           begin * elapsed_s, end * elapsed_s, elapsed_s)
              for begin, end in itertools.pairwise(_TURN_INTERVALS)))

    def _straight(self, mixture: Mixture, elapsed_s: float) -> Mixture:
        memory_s, ratio = self.memory_s, elapsed_s / self.memory_s
        decay = np.exp(-ratio)
        # For short times, the terms nearly cancel; their sum is then 2 ratio^3 / 3.
        drift = 2 * ratio - 3 + 4 * decay - decay**2 if ratio > 1e-3 else 2 * ratio**3 / 3
        noise = self.velocity_variance * np.array([
            [memory_s**2 * drift, memory_s * (1 - decay)**2],
            [memory_s * (1 - decay)**2, 1 - decay**2]])
        return _moved(mixture, memory_s * (1 - decay), decay, noise)

    def _turned(self, mixture: Mixture, begin_s: float, end_s: float, elapsed_s: float) -> Mixture:
        """Return the mixture of users who have turned once, at a random time in an interval."""
        mean_s, variance_s2 = (begin_s + end_s) / 2, (end_s - begin_s)**2 / 12
        rest_s = elapsed_s - mean_s
        noise = self.velocity_variance * np.array([
            [rest_s**2 + variance_s2, rest_s], [rest_s, 1.0]])
        moved = _moved(mixture, mean_s, 0.0, noise)
        # The velocity before the turn acts for a random time.
        rates, within = mixture.means[:, 3:], mixture.covariances[:, 3:, 3:]
        moved.covariances[:, :3, :3] += variance_s2 * (
            within + rates[:, :, None] * rates[:, None])
        return moved


def _moved(mixture: Mixture, reach_s: float, decay: float, noise: np.ndarray) -> Mixture:
    """Move by `reach_s` times the velocity, and scale velocities by `decay`.

    `noise`, [2, 2], is the covariance of position and velocity that each axis gains.
    """
    points = mixture.means[:, :3]
    velocities = np.matmul(jacobian(points), mixture.means[:, 3:, None])
    positions = to_positions(points) + reach_s * velocities[..., 0]
    # No user is behind the surface.
    positions[:, 0] = np.maximum(positions[:, 0], 1e-3)
    points = to_polar(positions)
    rates = decay * np.linalg.solve(jacobian(points), velocities)[..., 0]
    transition = np.kron([[1.0, reach_s], [0.0, decay]], np.eye(3))
    return Mixture(
        mixture.log_weights, np.concatenate([points, rates], axis=1),
        transition @ mixture.covariances @ transition.T
        + np.kron(noise, np.ones((3, 3))) * np.tile(_isotropic(points), (2, 2)))


def _isotropic(points: np.ndarray) -> np.ndarray:
    """Return the covariance of (r, u, v) for a unit covariance of the position, [C, 3, 3]."""
    inverse = np.linalg.inv(jacobian(points))
    return np.matmul(inverse, np.swapaxes(inverse, 1, 2))


@dataclasses.dataclass(frozen=True, eq=False)
class TrackEstimate(Estimate):
    """A position and velocity with their uncertainty, or the reason why there is none."""

    #: Velocity, float64 [3] [m/s], and its covariance, [3, 3]; NaN without a position.
    velocity: np.ndarray = dataclasses.field(default_factory=lambda: np.full(3, np.nan))
    velocity_covariance: np.ndarray = dataclasses.field(
        default_factory=lambda: np.full((3, 3), np.nan))
    n_phases: int = 0  #: Number of phases in the estimate; 0 without a position.
    is_predicted: bool = False  #: Whether the position is a prediction for a blocked user.


class Tracker:
    """The track of one user: a Gaussian mixture filter over the modes of the posterior.

    The first position of a track is the estimate itself. A track ends after a gap of more than
    `MAX_GAP_S`. A phase does not change the track if it has no position, or if its multipath is
    almost the same as in the latest phase that did. While the user is blocked, the position is a
    prediction. Positions are inside the region of interest.

    The attribute `estimator` may be replaced between phases, for example for another codebook. The
    probabilities that the user is outside or blocked come from this estimator.
    """

    def __init__(self, estimator: SearchEstimator, motion: Motion | None = None) -> None:
        self.estimator, self._motion = estimator, motion or Motion()
        self._mixture: Mixture | None = None
        # Time of the mixture, and of the latest phase, which may not have changed it [s].
        self._time_s = self._latest_s = -np.inf
        self._n_phases = 0

    @one_blas_thread
    def update(self, time_s: float, received: np.ndarray) -> TrackEstimate:
        """Estimate position and velocity at the time [s] of a phase from this and earlier phases.

        Takes signals, complex128 [N_B, N_SB F]; raises `SignalError` if they are unusable. If the
        phase is not later than the previous one, its position follows from its own signals alone,
        and the track does not change.
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
        """Continue the track of a blocked user by prediction; other users get no position."""
        elapsed_s = time_s - self._time_s
        if (self._mixture is None or not 0 < elapsed_s <= MAX_GAP_S
                or not found.blocked_probability > BLOCKED_LIMIT):
            return TrackEstimate(**vars(found))
        self._latest_s = max(time_s, self._latest_s)
        mixture, mean, covariance = self._inside(self._motion.predict(self._mixture, elapsed_s))
        estimate = dataclasses.replace(found, mean=mean, covariance=covariance, reason='')
        return dataclasses.replace(
            _described(estimate, mixture, self._n_phases), is_predicted=True)

    def _start(self, modes: Modes, share: float = 1.0) -> Mixture:
        """Return the mixture for a user anywhere in the region, weighted with the likelihood."""
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
            # Signals without a direct path contain no information. The odds are relative to a user
            # anywhere in the region.
            odds = share * np.log(blocked / max(1 - blocked - outside, 1e-12))
            weight = np.logaddexp.reduce(lost.log_weights) + odds
            parts.append(predicted.weighted(weight))
        lost = lost.weighted(np.log(_LOSS_RATE_HZ * elapsed_s))
        return reduce(concatenate(*parts, lost), MAX_COMPONENTS).normalised()

    def _inside(self, mixture: Mixture) -> tuple[Mixture, np.ndarray, np.ndarray]:
        """Return the mixture without components outside the region; mean and covariance inside."""
        heavy = mixture.log_weights >= _MIN_LOG_WEIGHT
        mixture, light = select(mixture, heavy), select(mixture, ~heavy)
        factors = np.linalg.cholesky(mixture.covariances[:, :3, :3])
        positions = to_positions(mixture.means[:, None, :3] + np.matmul(
            self.estimator.normal, np.swapaxes(factors, 1, 2)))
        bounds_m = Resolution.of(self.estimator.scenario).bounds_m
        inside = is_inside(positions, bounds_m)
        reaches = inside.mean(axis=1) >= _MIN_INSIDE
        if reaches.any():
            mixture, positions = select(mixture, reaches), positions[reaches]
            inside = inside[reaches]
        else:
            inside[...] = True
            positions = np.clip(positions, *bounds_m)
        weights = np.exp(mixture.log_weights)[:, None] * inside
        mean, covariance = moments((weights / weights.sum()).ravel(), positions.reshape(-1, 3))
        return concatenate(mixture, light).normalised(), mean, symmetric(covariance)


def _described(estimate: Estimate, mixture: Mixture, n_phases: int) -> TrackEstimate:
    velocity, covariance = mixture.velocity()
    return TrackEstimate(
        **vars(estimate), velocity=velocity, velocity_covariance=covariance, n_phases=n_phases)


def independent_share(scenario: Scenario, elapsed_s: float) -> float:
    """Return the share of a phase's information that is not in the previous phase.

    With the correlation rho of Eq. (4) between the phases, averaged over the bands, N phases at
    one place contain as much information as N (1 - rho) / (1 + rho) independent ones. A negative
    correlation, which would add information, is treated as 0.
    """
    # If the scatterers do not move, the phases are identical.
    rho = np.clip(time_correlation(scenario, elapsed_s), 0.0, 1 - 1e-6)
    mean = float(np.mean(rho))
    return (1 - mean) / (1 + mean)


def update(
        predicted: Mixture, modes: Modes, share: float, likelihood: Likelihood | None,
        signals: Signals) -> Mixture:
    """Return the product of a predicted mixture and the likelihood of a phase, not normalised.

    Every mode updates every component, and the heaviest results are kept. `likelihood`, if given,
    evaluates the heaviest of all. Each component is also kept without an update, for an unlikely
    mode that the search may have missed; it is assumed to be as wide as the best mode. `share`,
    from 0 to 1, is the exponent of the likelihood: below 1 if successive multipath is similar.
    """
    spread = np.linalg.inv(modes.curvature) / share
    offsets = modes.points[:, None] - predicted.means[:, :3]
    log_weights, precision = _evidence(offsets, predicted.covariances[:, :3, :3], spread[:, None])
    log_weights += share * modes.log_likelihood[:, None] + predicted.log_weights
    mode, component = np.unravel_index(
        np.argsort(-log_weights, axis=None)[:_MAX_PAIRS], log_weights.shape)
    chosen = select(predicted, component)._replace(log_weights=log_weights[mode, component])
    updated = _shifted(chosen, precision[mode, component], offsets[mode, component])
    if likelihood is not None:
        # The heaviest pairs come first.
        exact = _exact_update(
            select(predicted, component[:_N_EXACT]), updated.means[:_N_EXACT, :3], share,
            likelihood, signals)
        updated = concatenate(exact, select(updated, slice(_N_EXACT, None)))
    # The best mode comes first.
    floor, _ = _evidence(np.zeros(3), predicted.covariances[:, :3, :3], spread[0])
    floor += share * (modes.roi_log_likelihood[0] + _FLOOR)
    return concatenate(updated, predicted.weighted(floor))


def _exact_update(
        predicted: Mixture, points: np.ndarray, share: float, likelihood: Likelihood,
        signals: Signals) -> Mixture:
    """Update each component with the likelihood expanded at its own point (r, u, v), [C, 3]."""
    value, gradient, curvature, _ = likelihood.local(
        points, np.zeros((len(points), 0)), signals)
    step = step_to_maximum(curvature, gradient)
    offsets = points + step - predicted.means[:, :3]
    log_weights, precision = _evidence(
        offsets, predicted.covariances[:, :3, :3], np.linalg.inv(curvature) / share)
    log_weights += share * (value + np.sum(gradient * step, axis=1) / 2)
    log_weights += predicted.log_weights
    return _shifted(predicted._replace(log_weights=log_weights), precision, offsets)


def _evidence(
        offsets: np.ndarray, predicted: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the product of a Gaussian density and a Gaussian with the maximum 1.

    Takes the differences of the means, float64 [..., 3], and both covariances. Returns the
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
