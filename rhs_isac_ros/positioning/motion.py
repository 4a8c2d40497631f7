"""Mixtures of Gaussians over position and velocity, and the movement that a track assumes.

Velocities drift at random, and there are turns. Coordinates are those of `coordinates`.
"""

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.coordinates import (
    concatenate,
    jacobian,
    log_sum,
    symmetric,
    to_polar,
    to_positions,
)

# Bounds of the intervals of the time between two phases, as shares of it, in which a turn is
# distinguished. With one interval, the position after an early turn is too unlikely: the Gaussian
# has the mean time after a turn.
_TURN_INTERVALS = (0.0, 0.5, 1.0)

# Components that are lighter than the heaviest by more than this, in log-weight, do not turn.
_TURN_MARGIN = 10.0
# Components whose squared Mahalanobis distance is below this are merged.
_MERGE_DISTANCE = 1.0
# Components that are lighter than the heaviest by more than this, in log-weight, are discarded.
_WEIGHT_MARGIN = 18.0


class Mixture(NamedTuple):
    """A mixture of C Gaussians."""

    log_weights: np.ndarray  # Float64 [C].
    means: np.ndarray  # (r [m], u, v) and its rate [1/s], float64 [C, 6].
    covariances: np.ndarray  # Float64 [C, 6, 6].

    def select(self, chosen: np.ndarray) -> 'Mixture':
        """Return the components with the given indices or mask."""
        return Mixture(*(field[chosen] for field in self))

    def normalised(self) -> 'Mixture':
        """Return the mixture with weights whose sum is one."""
        return self._replace(log_weights=self.log_weights - log_sum(self.log_weights))

    def positions(self, normal: np.ndarray) -> np.ndarray:
        """Map points that represent a standard Gaussian, [S, 3], to positions, [C, S, 3] [m]."""
        factors = np.linalg.cholesky(self.covariances[:, :3, :3])
        points = self.means[:, None, :3] + np.matmul(normal, np.swapaxes(factors, 1, 2))
        return to_positions(points)

    def velocity(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean, float64 [3] [m/s], and covariance, float64 [3, 3], of the velocity."""
        weights = np.exp(self.log_weights - log_sum(self.log_weights))
        by_rate = jacobian(self.means[:, :3])
        means = np.matmul(by_rate, self.means[:, 3:, None])[..., 0]
        mean = weights @ means
        offsets = means - mean
        within = np.matmul(np.matmul(by_rate, self.covariances[:, 3:, 3:]),
                           np.swapaxes(by_rate, 1, 2))
        covariance = np.tensordot(weights, within, axes=1)
        covariance += (weights[:, None] * offsets).T @ offsets
        return mean, symmetric(covariance)


def reduce(mixture: Mixture, max_components: int) -> Mixture:
    """Merge components that are close to each other, and discard those of little weight.

    A component is merged into the one of the largest weight that is close to it; mean and
    covariance of the merged ones remain the same.
    """
    order = np.argsort(-mixture.log_weights)
    order = order[mixture.log_weights[order] >= mixture.log_weights[order[0]] - _WEIGHT_MARGIN]
    mixture = mixture.select(order)
    means = mixture.means
    precisions = np.linalg.inv(mixture.covariances)
    free = np.ones(len(means), bool)
    group = np.full(len(means), -1)
    n_groups = 0
    while free.any() and n_groups < max_components:
        leader = int(np.argmax(free))
        offsets = means - means[leader]
        distance = np.einsum('cp,cp->c', offsets @ precisions[leader], offsets)
        members = free & (distance < _MERGE_DISTANCE)
        group[members] = n_groups
        free[members] = False
        n_groups += 1
    return _merge(mixture, group, n_groups)


def _merge(mixture: Mixture, group: np.ndarray, n_groups: int) -> Mixture:
    """Merge the components of each group; those of group -1 are discarded."""
    mixture = mixture.select(group >= 0)
    group = group[group >= 0]
    member = np.equal.outer(np.arange(n_groups), group)
    weights = np.exp(mixture.log_weights - mixture.log_weights.max())
    shares = member * weights
    total = shares.sum(axis=1)
    shares /= total[:, None]
    means = shares @ mixture.means
    offsets = mixture.means - means[group]
    spread = mixture.covariances + offsets[:, :, None] * offsets[:, None, :]
    covariances = (shares @ spread.reshape(len(group), -1)).reshape(n_groups, 6, 6)
    return Mixture(np.log(total) + mixture.log_weights.max(), means, covariances)


@dataclasses.dataclass(frozen=True)
class Motion:
    """A random velocity, the same in all directions, with sudden turns.

    Between turns, the velocity is an Ornstein-Uhlenbeck process: over times that are short against
    `memory_s`, it is constant up to noise. At a turn, which may also be a stop or a start, it is
    drawn anew. The numbers of turns in separate times are independent.

    Parameters
    ----------
    speed_mps
        Root mean square of the speed [m/s].
    memory_s
        Time over which the velocity loses its memory without a turn [s].
    turn_s
        Mean time between turns [s].
    """

    speed_mps: float = 1.0
    memory_s: float = 5.0
    turn_s: float = 2.0

    def __post_init__(self) -> None:
        """Check the ranges."""
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
        """Return a mixture with velocities of the stationary process.

        Takes means (r [m], u, v), float64 [C, 3], covariances, [C, 3, 3], and logarithms of the
        weights, [C], of the positions.
        """
        n = len(points)
        means, joint = np.zeros((n, 6)), np.zeros((n, 6, 6))
        means[:, :3], joint[:, :3, :3] = points, covariances
        joint[:, 3:, 3:] = self.velocity_variance * _isotropic(points)
        return Mixture(log_weights, means, joint)

    def predict(self, mixture: Mixture, elapsed_s: float) -> Mixture:
        """Return the mixture after a time [s].

        Every component gives one for a user that has not turned, and one for a user that has
        turned in each of the `_TURN_INTERVALS`. Means move in straight lines; the covariances
        neglect the curvature of the coordinates.
        """
        log_no_turn = -elapsed_s / self.turn_s
        turn = -np.expm1(log_no_turn)
        straight = self._straight(mixture, elapsed_s)
        straight = straight._replace(log_weights=straight.log_weights + log_no_turn)
        mixture = mixture.select(
            mixture.log_weights >= mixture.log_weights.max() - _TURN_MARGIN)
        return concatenate(
            straight,
            *(self._turned(
                mixture._replace(log_weights=mixture.log_weights + np.log(turn * (end - begin))),
                begin * elapsed_s, end * elapsed_s, elapsed_s)
              for begin, end in itertools.pairwise(_TURN_INTERVALS)))

    def _straight(self, mixture: Mixture, elapsed_s: float) -> Mixture:
        decay = np.exp(-elapsed_s / self.memory_s)
        reach_s = self.memory_s * (1 - decay)
        points, velocity = _moved(mixture, reach_s)
        rates = decay * np.linalg.solve(jacobian(points), velocity[..., None])[..., 0]
        means = np.concatenate([points, rates], axis=1)
        transition = np.eye(6)
        transition[:3, 3:] += reach_s * np.eye(3)
        transition[3:, 3:] *= decay
        return Mixture(
            mixture.log_weights, means,
            transition @ mixture.covariances @ transition.T
            + np.kron(self._noise(elapsed_s, decay), np.ones((3, 3)))
            * np.tile(_isotropic(points), (2, 2)))

    def _turned(
            self, mixture: Mixture, begin_s: float, end_s: float, elapsed_s: float) -> Mixture:
        """Return the mixture of users that have turned once, at any moment of an interval.

        Mean and covariance are those of a moment that is distributed uniformly; the user moves
        in a straight line before and after it.
        """
        mean_s, variance_s2 = (begin_s + end_s) / 2, (end_s - begin_s)**2 / 12
        rest_s = elapsed_s - mean_s
        points, _ = _moved(mixture, mean_s)
        means = np.concatenate([points, np.zeros_like(points)], axis=1)
        transition = np.hstack([np.eye(3), mean_s * np.eye(3)])
        rates, within = mixture.means[:, 3:], mixture.covariances[:, 3:, 3:]
        turned = self.velocity_variance * _isotropic(points)
        covariances = np.empty_like(mixture.covariances)
        covariances[:, :3, :3] = (
            transition @ mixture.covariances @ transition.T
            + variance_s2 * (within + rates[:, :, None] * rates[:, None])
            + (rest_s**2 + variance_s2) * turned)
        covariances[:, :3, 3:] = covariances[:, 3:, :3] = rest_s * turned
        covariances[:, 3:, 3:] = turned
        return Mixture(mixture.log_weights, means, covariances)

    def _noise(self, elapsed_s: float, decay: float) -> np.ndarray:
        """Covariance of position [m] and velocity [m/s] along an axis, float64 [2, 2]."""
        variance, memory_s = self.velocity_variance, self.memory_s
        ratio = elapsed_s / memory_s
        # The difference cancels for short times; its leading term is 2 ratio^3 / 3.
        drift = 2 * ratio - 3 + 4 * decay - decay**2 if ratio > 1e-3 else 2 * ratio**3 / 3
        return variance * np.array([
            [memory_s**2 * drift, memory_s * (1 - decay)**2],
            [memory_s * (1 - decay)**2, 1 - decay**2]])


def _moved(mixture: Mixture, time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points (r, u, v) after a time in a straight line, and velocities, float64 [C, 3]."""
    points = mixture.means[:, :3]
    velocities = np.matmul(jacobian(points), mixture.means[:, 3:, None])[..., 0]
    return to_polar(_in_front(to_positions(points) + time_s * velocities)), velocities


def _isotropic(points: np.ndarray) -> np.ndarray:
    """Covariance of (r, u, v) for the unit covariance of the position, float64 [C, 3, 3]."""
    inverse = np.linalg.inv(jacobian(points))
    return np.matmul(inverse, np.swapaxes(inverse, 1, 2))


def _in_front(positions: np.ndarray) -> np.ndarray:
    """Move positions behind the surface to just in front of it."""
    positions[:, 0] = np.maximum(positions[:, 0], 1e-3)
    return positions
