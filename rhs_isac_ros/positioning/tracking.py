"""The track of a user over successive positioning phases.

With Table I, the signals of a phase often fit several positions, 0.6 m apart in range. The tracker
keeps all these positions, as a mixture of Gaussians over position and velocity, until the movement
over several phases decides between them. The mixture is in the frame of the site; `prior` updates
it with the signals. Velocities are assumed to drift at random, with sudden turns.
"""

import dataclasses
import itertools

import numpy as np

from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.model.multipath import time_correlation
from rhs_isac_ros.positioning.alternatives import BLOCKED_LIMIT, LIMIT
from rhs_isac_ros.positioning.estimate import SITE, Estimate, SignalError
from rhs_isac_ros.positioning.estimators import SearchEstimator
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.prior import ELSEWHERE, Users
from rhs_isac_ros.positioning.segments import concatenate, select
from rhs_isac_ros.support.fields import finite, to_number
from rhs_isac_ros.support.threads import one_blas_thread

# A track ends after this time without an update [s].
MAX_GAP_S = 10.0
# Bounds of the intervals, as shares of the time between two phases, for which turns are modelled
# separately. A single interval would make the position after an early turn too unlikely, because
# its Gaussian applies to the mean time of a turn.
_TURN_INTERVALS = 0.0, 0.5, 1.0
# Components whose log-weight is below the largest by more than this do not turn.
_TURN_MARGIN = 10.0
# Rate at which a track is assumed to be wrong [1/s]; the user is then anywhere in the region.
_LOSS_RATE_HZ = 1e-3
# Phases with a smaller share of new information do not update the track. The share is an exponent
# of the likelihood; with a small one, modes overlap, and the likelihood is no longer their sum.
_LEAST_SHARE = 0.25
# Distance over which errors of elements change, so that they favour other modes [m].
_SHARED_M = 1.0


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
            value = to_number(getattr(self, name), float)
            if not (isinstance(value, float) and 0 < value < np.inf):
                raise ValueError(f'{name}: {value}, expected a positive number')
            object.__setattr__(self, name, value)

    @property
    def velocity_variance(self) -> float:
        """Variance of each component of the velocity [m^2/s^2]."""
        return self.speed_mps**2 / 3

    def start(self, mixture: Mixture) -> Mixture:
        """Add velocities of the stationary process to a mixture without velocities."""
        return mixture.at_velocities(self.velocity_variance * np.eye(3))

    def predict(self, mixture: Mixture, elapsed_s: float) -> Mixture:
        """Return the mixture after a time of at least 0 [s].

        Every component splits into one without a turn and, unless its weight is low, one with a
        turn in each of the `_TURN_INTERVALS`.
        """
        log_no_turn = -finite('elapsed_s', elapsed_s, 0.0) / self.turn_s
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
    transition = _for_each_axis(np.array([[1.0, reach_s], [0.0, decay]]))
    return Mixture._make((
        mixture.log_weights, mixture.means @ transition.T,
        transition @ mixture.covariances @ transition.T + _for_each_axis(noise)))


def _for_each_axis(matrix: np.ndarray) -> np.ndarray:
    """Expand a matrix of position and velocity, [2, 2], to all axes, [6, 6]."""
    # `np.kron` returns the same, but takes ten times as long.
    return (matrix[:, None, :, None] * np.eye(3)[:, None]).reshape(6, 6)


class MixtureTracker:
    """The track of one user from likelihoods that are mixtures, such as those of a site.

    Gaps and correlated multipath, with the correlation of `scenario`, are treated as by `Tracker`.
    Positions may be slightly outside of the region, of which `bounds_m`, float64 [2, 3] [m], are
    the corners.
    """

    def __init__(self, scenario: Scenario, bounds_m: np.ndarray, motion: Motion) -> None:
        self._scenario, self._motion = scenario, motion
        self._users = Users.of(scenario, bounds_m, Pose())
        self._mixture: Mixture | None = None
        self._time_s, self._n_phases = -np.inf, 0

    @one_blas_thread
    def update(self, time_s: float, likelihood: Mixture, missing: float) -> Estimate | None:
        """Return position and velocity after a phase; None if the phase is late.

        The track is that of a position with the errors that are the same in all phases. Their
        covariance, `Mixture.constant_covariance`, is part of the result but not of the track.
        `missing`, above 0 and below 1, is the probability that the likelihood does not contain the
        position. If a phase is late by more than `MAX_GAP_S`, the clock has been reset, and a new
        track begins. Raises ValueError if the time is not finite.
        """
        elapsed_s = finite('time_s', time_s) - self._time_s
        constant = likelihood.constant_covariance
        if self._mixture is None or abs(elapsed_s) > MAX_GAP_S:
            self._mixture, self._time_s, self._n_phases = (
                self._motion.start(likelihood.fresh), time_s, 1)
            return self._described(self._mixture, constant)
        if elapsed_s <= 0:
            return None
        predicted = self._motion.predict(self._mixture, elapsed_s)
        share = independent_share(self._scenario, elapsed_s)
        if share < _LEAST_SHARE:
            return self._described(predicted, constant)
        self._mixture = self._users.updated(
            predicted, likelihood, missing, share, _LOSS_RATE_HZ * elapsed_s)
        self._time_s = time_s
        self._n_phases += 1
        return self._described(self._mixture, constant)

    def _described(self, mixture: Mixture, constant: np.ndarray) -> Estimate:
        return Estimate.without_fix('', n_phases=self._n_phases, frame=SITE).described(
            mixture.shared(constant))


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
        #: Posterior after the latest phase; None before the first one. Its sighting is that of the
        #: signals of this phase alone.
        self.latest: Estimate | None = None
        self._mixture: Mixture | None = None
        # Time of the mixture, and of the latest phase, which may not have changed it [s].
        self._time_s = self._latest_s = -np.inf
        self._n_phases = 0
        # Covariance of errors that are the same in all phases, in the site. They are part of the
        # position whose track the mixture is.
        self._constant = np.zeros((3, 3))

    @one_blas_thread
    def update(self, time_s: float, received: np.ndarray) -> Estimate:
        """Estimate position and velocity at the time [s] of a phase from this and earlier phases.

        Takes signals, complex128 [N_B, N_SB F]; raises `SignalError` if they are unusable, and
        ValueError if the time is not finite. If the phase is not later than the previous one, its
        position follows from its own signals alone, and the track does not change.
        """
        if np.ndim(received) != 2:
            raise SignalError(f'received: shape {np.shape(received)}, expected the signals of one '
                              'phase, [N_B, N_SB F]')
        time_s = finite('time_s', time_s)
        elapsed_s = time_s - self._time_s
        if self._mixture is None or elapsed_s > MAX_GAP_S or time_s <= self._latest_s:
            return self._alone(time_s, received)
        share = independent_share(self.estimator.scenario, elapsed_s)
        is_new = share >= _LEAST_SHARE
        # The evidence of phases with the same errors grows more slowly than their number.
        distance = elapsed_s * self._motion.speed_mps / _SHARED_M
        n_before = min(self._n_phases, 1 / np.expm1(max(distance, 1e-6)))
        shared = float(self.estimator.constant_shares[0])
        predicted = self._motion.predict(self._mixture._replace(
            log_weights=self._mixture.log_weights * (
                1 - shared * min(n_before, 1.0) / (1 + n_before * shared))), elapsed_s)
        found = self.latest = self._posterior(received, predicted, elapsed_s, n_before) if (
            is_new) else self.estimator.posterior(received)
        if not found.fix:
            return self._predicted(time_s, found)
        self._latest_s = time_s
        if not is_new:
            return self._placed(found, predicted)
        assert isinstance(found.unbounded, Mixture)
        self._mixture, self._time_s = found.unbounded.fresh, time_s
        self._constant = found.unbounded.constant_covariance
        self._n_phases += 1
        return dataclasses.replace(found, n_phases=self._n_phases)

    def _posterior(self, received: np.ndarray, predicted: Mixture, elapsed_s: float,
                   n_before: float) -> Estimate:
        """Return the posterior for a prediction; see `SearchEstimator.posterior`."""
        share = independent_share(self.estimator.scenario, elapsed_s)
        return self.estimator.posterior(
            received, predicted, share=share, wrong=_LOSS_RATE_HZ * elapsed_s,
            n_before=n_before)

    def predict(self, time_s: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Predict the position at a time [s] after the latest phase, in the surface's frame.

        Returns mean, float64 [3] [m], and covariance, float64 [3, 3] [m^2], without regard to the
        region; None without a track at this time.
        """
        elapsed_s = finite('time_s', time_s) - self._time_s
        if self._mixture is None or not 0 < elapsed_s <= MAX_GAP_S:
            return None
        pose = self.estimator.scenario.pose
        # The motion maps moments to moments, so those of one Gaussian are those of the mixture.
        mean, covariance = self._mixture.moments()
        gaussian = Mixture._make((np.zeros(1), mean[None], covariance[None]))
        predicted = self._motion.predict(gaussian, elapsed_s).shared(self._constant)
        mean, covariance = predicted.position().moments()
        return pose.to_surface(mean), pose.covariances_to_surface(covariance)

    def _alone(self, time_s: float, received: np.ndarray) -> Estimate:
        """Estimate the position from one phase, which begins a track unless it is late."""
        found = self.latest = self.estimator.posterior(received)
        if not found.fix:
            return self._predicted(time_s, found)
        begin = self.estimator.begin(found)
        if self.estimator.scenario.user_speed_std_mps and found.mixture:
            begin = found.mixture
        mixture = self._motion.start(begin.fresh)
        if time_s > self._latest_s:
            self._mixture, self._time_s, self._latest_s = mixture, time_s, time_s
            self._n_phases, self._constant = 1, begin.constant_covariance
        moving = found.described(mixture, self.estimator.scenario.pose)
        return dataclasses.replace(moving, mean=found.mean, covariance=found.covariance,
                                   density=found.density, n_phases=1)

    def _predicted(self, time_s: float, found: Estimate) -> Estimate:
        """Continue the track of a blocked user by prediction; other users get no position."""
        elapsed_s = time_s - self._time_s
        if (self._mixture is None or not 0 < elapsed_s <= MAX_GAP_S
                or not found.blocked_probability > BLOCKED_LIMIT
                or found.outside_probability > LIMIT):
            return found
        self._latest_s = max(time_s, self._latest_s)
        estimate = self._placed(
            dataclasses.replace(found, reason='', see=None),
            self._motion.predict(self._mixture, elapsed_s))
        return dataclasses.replace(estimate, is_predicted=True)

    def _placed(self, found: Estimate, mixture: Mixture) -> Estimate:
        """Replace the position of an estimate by that of a mixture inside the region."""
        placed = self.estimator.restricted(
            self.estimator.in_front(mixture, ELSEWHERE), found, self._constant)
        return dataclasses.replace(placed, n_phases=self._n_phases)


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
