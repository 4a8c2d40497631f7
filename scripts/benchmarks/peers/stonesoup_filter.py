"""A particle filter of Stone Soup with the likelihood and the movement of the track."""

import datetime

import numpy as np
from stonesoup.base import Property
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.transition.base import TransitionModel
from stonesoup.models.transition.linear import (
    CombinedLinearGaussianTransitionModel,
    OrnsteinUhlenbeck,
)
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import ParticleState
from stonesoup.updater.particle import ParticleUpdater

from rhs_isac_ros.positioning import BayesEstimator, Motion
from rhs_isac_ros.positioning.posterior import draw_samples

EPOCH = datetime.datetime(2000, 1, 1)
# Rows of the position in a state (x, vx, y, vy, z, vz).
POSITION, VELOCITY = [0, 2, 4], [1, 3, 5]


class Likelihood(MeasurementModel):
    """The likelihood of whitened signals, a vector, at the positions of particles."""

    model: object = Property(doc='Mean and covariance of the signals')
    bounds: np.ndarray = Property(doc='Corners of the region')

    @property
    def ndim_state(self):
        """Number of states."""
        return 6

    @property
    def mapping(self):
        """Rows of the states that are measured."""
        return POSITION

    @property
    def ndim_meas(self):
        """Number of complex measurements."""
        return int(np.prod(self.model.shape))

    def function(self, state, noise=False, **kwargs):
        """Return the mean of the whitened signals."""
        positions = np.asarray(state.state_vector)[POSITION].T.astype(float)
        return self._whitened_means(positions).T

    def logpdf(self, state1, state2, **kwargs):
        """Return the log-likelihood of the particles, up to a constant."""
        positions = np.asarray(state2.state_vector)[POSITION].T.astype(float)
        inside = ((positions >= self.bounds[0]) & (positions <= self.bounds[1])).all(axis=1)
        result = np.full(len(positions), -1e6)
        means = self._whitened_means(positions[inside])
        signals = np.asarray(state1.state_vector).ravel()
        result[inside] = -np.sum(np.abs(signals - means)**2, axis=1)
        return result

    def _whitened_means(self, positions):
        return self.model.whiten(self.model.mean(positions)).reshape(len(positions), -1)

    def pdf(self, state1, state2, **kwargs):
        """Return the likelihood."""
        return np.exp(self.logpdf(state1, state2, **kwargs))

    def rvs(self, num_samples=1, **kwargs):
        """Return no samples: they are not needed."""
        raise NotImplementedError


class Turns(TransitionModel):
    """Straight movement, and one turn at a random moment for some of the particles."""

    straight: TransitionModel = Property(doc='Movement without a turn')
    motion: Motion = Property(doc='Assumed movement')
    rng: np.random.Generator = Property(doc='Generator of the turns')

    @property
    def ndim_state(self):
        """Number of states."""
        return 6

    def function(self, state, noise=False, time_interval=None, **kwargs):
        """Return the states of particles after a time."""
        before = np.asarray(state.state_vector, float)
        after = np.array(
            self.straight.function(state, noise=noise, time_interval=time_interval), float)
        elapsed_s = time_interval.total_seconds()
        probability = -np.expm1(-elapsed_s / self.motion.turn_s)
        turns = self.rng.uniform(size=before.shape[1]) < probability
        moments_s = self.rng.uniform(0, elapsed_s, turns.sum())
        velocities = np.sqrt(self.motion.velocity_variance) * self.rng.standard_normal(
            (3, turns.sum()))
        after[np.ix_(POSITION, turns)] = (
            before[np.ix_(POSITION, turns)] + moments_s * before[np.ix_(VELOCITY, turns)]
            + (elapsed_s - moments_s) * velocities)
        after[np.ix_(VELOCITY, turns)] = velocities
        return StateVectors(after)

    def rvs(self, num_samples=1, **kwargs):
        """Return no noise: it depends on the state."""
        raise NotImplementedError

    def pdf(self, state1, state2, **kwargs):
        """Return no density: the filter draws from the model."""
        raise NotImplementedError


class ParticleFilter:
    """A bootstrap filter, started from the posterior of the first cycle."""

    def __init__(self, estimator: BayesEstimator, motion: Motion, n_particles: int,
                 seed: int) -> None:
        # Stone Soup draws from the global generator.
        np.random.seed(seed)  # noqa: NPY002
        self._rng = np.random.default_rng(seed)
        self._estimator, self._motion, self._n_particles = estimator, motion, n_particles
        axis = OrnsteinUhlenbeck(
            noise_diff_coeff=2 * motion.velocity_variance / motion.memory_s,
            damping_coeff=1 / motion.memory_s)
        straight = CombinedLinearGaussianTransitionModel([axis] * 3)
        self._predictor = ParticlePredictor(
            Turns(straight=straight, motion=motion, rng=self._rng))
        self._likelihood = Likelihood(
            model=estimator.exact_likelihood.model, bounds=estimator.scenario.roi_bounds_m)
        self._updater = ParticleUpdater(self._likelihood, ESSResampler())
        self._state: ParticleState | None = None

    def update(self, time_s: float, signals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of the position."""
        now = EPOCH + datetime.timedelta(seconds=float(time_s))
        if self._state is None:
            posterior = self._estimator.posterior(signals)
            self._state = self._start(posterior.modes, now)
            return posterior.estimate.mean, posterior.estimate.covariance
        whitened = self._likelihood.model.whiten(signals[None])[0].reshape(-1, 1)
        detection = Detection(
            whitened, timestamp=now, measurement_model=self._likelihood)
        prediction = self._predictor.predict(self._state, timestamp=now)
        # The updater returns the particles after resampling.
        self._state = self._updater.update(SingleHypothesis(prediction, detection))
        weights = np.exp(np.asarray(self._state.log_weight, float))
        weights /= weights.sum()
        positions = np.asarray(self._state.state_vector)[POSITION].T.astype(float)
        mean = weights @ positions
        offsets = positions - mean
        # Equal particles have a singular covariance.
        return mean, (weights[:, None] * offsets).T @ offsets + 1e-9 * np.eye(3)

    def _start(self, modes, now: datetime.datetime) -> ParticleState:
        """Draw particles from the Gaussians of the modes."""
        n, rng = self._n_particles, self._rng
        bounds = self._estimator.scenario.roi_bounds_m
        samples = draw_samples(modes, rng.standard_normal((1024, 3)), bounds)
        weights = np.exp(samples.log_weights - samples.log_weights.max()).ravel()
        chosen = rng.choice(len(weights), n, p=weights / weights.sum())
        states = np.empty((6, n))
        states[POSITION] = samples.positions.reshape(-1, 3)[chosen].T
        states[VELOCITY] = np.sqrt(self._motion.velocity_variance) * rng.standard_normal((3, n))
        return ParticleState(
            StateVectors(states), log_weight=np.full(n, -np.log(n)), timestamp=now)
