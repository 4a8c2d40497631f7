"""Mixtures of Gaussians over position and velocity, in the coordinates of `polar`."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.polar import jacobian, to_positions

# Components whose squared Mahalanobis distance is below this are merged.
_MERGE_DISTANCE = 1.0
# Components that are lighter than the heaviest by more than this, in log-weight, are discarded.
_WEIGHT_MARGIN = 18.0


class Mixture(NamedTuple):
    """A mixture of C Gaussians.

    Attributes
    ----------
    log_weights
        Logarithm of the weights, float64 [C].
    means
        (r [m], u, v) and its rate [1/s], float64 [C, 6].
    covariances
        Float64 [C, 6, 6].
    """

    log_weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray

    def select(self, chosen: np.ndarray) -> 'Mixture':
        """Return the components with the given indices or mask."""
        return Mixture(*(field[chosen] for field in self))

    def normalised(self) -> 'Mixture':
        """Return the mixture with weights whose sum is one."""
        return self._replace(log_weights=self.log_weights - log_sum(self.log_weights))

    def positions(self, normal: np.ndarray) -> np.ndarray:
        """Return points that represent each component, float64 [C, S, 3] [m].

        Parameters
        ----------
        normal
            Points that represent a standard Gaussian, float64 [S, 3].
        """
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
        return mean, (covariance + covariance.T) / 2


def log_sum(log_values: np.ndarray) -> float:
    """Return the logarithm of the sum of values that are given by their logarithms."""
    highest = log_values.max()
    return float(highest + np.log(np.sum(np.exp(log_values - highest))))


def concatenate(*mixtures: Mixture) -> Mixture:
    """Return the mixture of all components."""
    return Mixture(*(np.concatenate(fields) for fields in zip(*mixtures, strict=True)))


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
    for leader in range(len(means)):
        if not free[leader]:
            continue
        if n_groups == max_components:
            break
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
