"""The track of a user over successive positioning phases.

The signals of a phase often fit several positions, 0.6 m apart in range on Table I. The tracker
keeps them all, as a mixture of Gaussians over position and velocity, until the movement over
several phases decides between them.
"""

import dataclasses

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import time_correlation
from rhs_isac_ros.model.threads import one_blas_thread
from rhs_isac_ros.positioning.estimate import Estimate
from rhs_isac_ros.positioning.mixture import Mixture, concatenate, reduce
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.motion import Motion
from rhs_isac_ros.positioning.polar import jacobian
from rhs_isac_ros.positioning.region import is_inside
from rhs_isac_ros.positioning.search import SearchEstimator
from rhs_isac_ros.positioning.track_update import update

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
    """

    velocity: np.ndarray = dataclasses.field(default_factory=lambda: np.full(3, np.nan))
    velocity_covariance: np.ndarray = dataclasses.field(
        default_factory=lambda: np.full((3, 3), np.nan))
    n_phases: int = 0


class Tracker:
    """The track of one user: a Gaussian mixture filter over the modes of the posterior.

    The first position of a track is that of the estimator. A track ends with a gap of more than
    `MAX_GAP_S`; signals without a position do not change it, and neither do those whose multipath
    is almost that of the phase before.

    Positions of the track are inside the region of interest. If the signals of a phase may be from
    outside, its covariance includes the positions there, as that of the estimator does.

    Parameters
    ----------
    estimator
        Estimator of the signals. The attribute may be replaced between phases, for example by
        the estimator of another codebook.
    motion
        Assumed movement.
    """

    def __init__(self, estimator: SearchEstimator, motion: Motion | None = None) -> None:
        self.estimator, self._motion = estimator, motion or Motion()
        self._mixture: Mixture | None = None
        # Time of the mixture, and of the latest phase, which may not have changed it [s].
        self._time_s = self._latest_s = -np.inf
        self._n_phases = 0

    @one_blas_thread
    def update(self, time_s: float, received: np.ndarray) -> TrackEstimate:
        """Return the position and velocity at the time of a phase, from it and earlier ones.

        The position for a phase that is not later than the last one follows from its signals
        alone, and the track does not change.

        Parameters
        ----------
        time_s
            Time of the phase [s].
        received
            Signals, complex128 [N_B, N_SB F].

        Raises
        ------
        SignalError
            If the signals cannot be used; the track does not change.
        """
        posterior = self.estimator.posterior(received)
        if posterior.modes is None:
            found = posterior.estimate
            return TrackEstimate(
                found.mean, found.covariance, found.reason, found.residual,
                found.expected_residual)
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
            mixture = self._updated(
                mixture, posterior.modes, posterior.whitened, share, elapsed_s)
        mixture, mean, covariance = self._inside(mixture)
        if posterior.doubt:
            covariance = self.estimator.with_outside(mean, covariance, posterior.doubt)
        if share >= _MIN_SHARE:
            self._mixture, self._time_s = mixture, time_s
            self._n_phases += 1
        found = posterior.estimate
        estimate = Estimate(mean, covariance, '', found.residual, found.expected_residual)
        return _described(estimate, mixture, self._n_phases)

    def _start(self, modes: Modes, share: float = 1.0) -> Mixture:
        """Return the mixture of a user anywhere in the region, weighted with its likelihood."""
        covariances = np.linalg.inv(modes.curvature) / share
        log_mass = (np.log(np.linalg.det(jacobian(modes.roi_points))) + 1.5 * np.log(2 * np.pi)
                    + np.linalg.slogdet(covariances)[1] / 2)
        volume_m3 = float(np.prod(self.estimator.scenario.roi_size_m))
        return self._motion.start(
            modes.roi_points, covariances,
            share * modes.roi_log_likelihood + log_mass - np.log(volume_m3))

    def _updated(
            self, predicted: Mixture, modes: Modes, whitened: np.ndarray, share: float,
            elapsed_s: float) -> Mixture:
        updated = update(predicted, modes, share, self.estimator.exact_model, whitened)
        lost = self._start(modes, share)
        lost = lost._replace(log_weights=lost.log_weights + np.log(_LOSS_RATE_HZ * elapsed_s))
        return reduce(concatenate(updated, lost), MAX_COMPONENTS).normalised()

    def _inside(self, mixture: Mixture) -> tuple[Mixture, np.ndarray, np.ndarray]:
        """Return the components that reach the region, and mean and covariance inside."""
        heavy = mixture.log_weights >= _MIN_LOG_WEIGHT
        mixture, light = mixture.select(heavy), mixture.select(~heavy)
        positions = mixture.positions(self.estimator.normal)
        inside = is_inside(positions, self.estimator.scenario.roi_bounds_m)
        reaches = inside.mean(axis=1) >= _MIN_INSIDE
        if reaches.any():
            mixture, positions = mixture.select(reaches), positions[reaches]
            inside = inside[reaches]
        else:
            inside[...] = True
            positions = np.clip(positions, *self.estimator.scenario.roi_bounds_m)
        weights = np.exp(mixture.log_weights)[:, None] * inside
        flat, points = (weights / weights.sum()).ravel(), positions.reshape(-1, 3)
        mean = flat @ points
        offsets = points - mean
        covariance = (flat[:, None] * offsets).T @ offsets
        mixture = concatenate(mixture, light).normalised()
        return mixture, mean, (covariance + covariance.T) / 2


def _described(estimate: Estimate, mixture: Mixture, n_phases: int) -> TrackEstimate:
    velocity, covariance = mixture.velocity()
    return TrackEstimate(
        estimate.mean, estimate.covariance, estimate.reason, estimate.residual,
        estimate.expected_residual, velocity, covariance, n_phases)


def independent_share(scenario: Scenario, elapsed_s: float) -> float:
    """Return the share of a phase's information that the previous phase does not contain.

    With the correlation rho of Eq. (4) between the phases, N phases at one place contain as much
    information as N (1 - rho) / (1 + rho) independent ones. A negative correlation, which would
    add information, counts as none. The result is the average over the bands.
    """
    lag = np.array(elapsed_s / scenario.frame_duration_s)
    rho = np.array([float(time_correlation(scenario, band, lag, np.array(0.0)))
                    for band in range(scenario.n_bands)])
    # Without movement of the scatterers, the phases are identical.
    rho = np.clip(rho, 0.0, 1 - 1e-6)
    mean = float(np.mean(rho))
    return (1 - mean) / (1 + mean)
