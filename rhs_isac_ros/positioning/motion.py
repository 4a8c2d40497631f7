"""The movement that a track assumes: velocities that change at random and return to zero."""

import dataclasses

import numpy as np

from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions


@dataclasses.dataclass(frozen=True)
class Motion:
    """A random velocity, an Ornstein-Uhlenbeck process, the same in all directions.

    Over times that are short against `memory_s`, the velocity is constant up to noise; over long
    ones, the position is a random walk, so that users that turn, stop and go are covered.

    Parameters
    ----------
    speed_mps
        Root mean square of the speed [m/s].
    memory_s
        Time over which the velocity loses its memory [s].
    """

    speed_mps: float = 1.0
    memory_s: float = 1.5

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ('speed_mps', 'memory_s'):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ValueError(f'{name}: {value}, expected a positive number')

    @property
    def velocity_variance(self) -> float:
        """Variance of each component of the velocity [m^2/s^2]."""
        return self.speed_mps**2 / 3

    def start(self, points: np.ndarray, covariances: np.ndarray,
              log_weights: np.ndarray) -> Mixture:
        """Return a mixture with the given positions and velocities of the stationary process.

        Parameters
        ----------
        points, covariances
            Mean (r [m], u, v), float64 [C, 3], and covariance, float64 [C, 3, 3].
        log_weights
            Logarithm of the weights, float64 [C].
        """
        n = len(points)
        means, joint = np.zeros((n, 6)), np.zeros((n, 6, 6))
        means[:, :3], joint[:, :3, :3] = points, covariances
        joint[:, 3:, 3:] = self.velocity_variance * _isotropic(points)
        return Mixture(log_weights, means, joint)

    def predict(self, mixture: Mixture, elapsed_s: float) -> Mixture:
        """Return the mixture after a time [s].

        Positions and velocities of the means move in straight lines; the covariances neglect
        the curvature of the coordinates.
        """
        decay = np.exp(-elapsed_s / self.memory_s)
        reach_s = self.memory_s * (1 - decay)
        before = mixture.means[:, :3]
        velocity = np.matmul(jacobian(before), mixture.means[:, 3:, None])
        points = to_polar(_in_front(to_positions(before) + reach_s * velocity[..., 0]))
        means = np.empty_like(mixture.means)
        means[:, :3] = points
        means[:, 3:] = decay * np.linalg.solve(jacobian(points), velocity)[..., 0]
        transition = np.eye(6)
        transition[:3, 3:] += reach_s * np.eye(3)
        transition[3:, 3:] *= decay
        covariances = transition @ mixture.covariances @ transition.T
        noise = self._noise(elapsed_s, decay)
        scale = _isotropic(points)
        for row in (0, 1):
            for column in (0, 1):
                covariances[:, 3 * row:3 * row + 3, 3 * column:3 * column + 3] += (
                    noise[row, column] * scale)
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


def _isotropic(points: np.ndarray) -> np.ndarray:
    """Covariance of (r, u, v) for the unit covariance of the position, float64 [C, 3, 3]."""
    inverse = np.linalg.inv(jacobian(points))
    covariance: np.ndarray = np.matmul(inverse, np.swapaxes(inverse, 1, 2))
    return covariance


def _in_front(positions: np.ndarray) -> np.ndarray:
    """Move positions behind the surface to just in front of it."""
    positions[:, 0] = np.maximum(positions[:, 0], 1e-3)
    return positions
