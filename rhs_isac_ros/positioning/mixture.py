"""Mixtures of Gaussians over the position of a user, in the frame of the site.

A mixture represents the posterior of one cycle, from one or several surfaces. It is Gaussian in
Cartesian coordinates. Where a component is a curved sheet around a surface, `fusion` bends it.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from rhs_isac_ros.model.arrays import log_sum, mixture_weights, numbers, read_only
from rhs_isac_ros.model.gaussian import (
    covariance_problem,
    moments,
    step_to_maximum,
    symmetric,
)
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.positioning.segments import concatenate, select

# Number of components of a posterior of one phase.
MAX_COMPONENTS = 48
# Components whose squared Mahalanobis distance is below this are merged.
_MERGE_DISTANCE = 1.0
# Components whose log-weight is below the heaviest by more than this are discarded.
_WEIGHT_MARGIN = 18.0
# Standard deviation of components of velocities that are 0, so that covariances have inverses.
_FIXED_MPS = 1e-5
# Largest share of the information of a component that a prior is taken to be.
_MOST_OF_PRIOR = 0.999
_MixtureT = TypeVar('_MixtureT', bound='Mixture')


class _Arrays(NamedTuple):
    """The fields of `Mixture`, whose constructor checks them."""

    log_weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray


class Mixture(_Arrays):
    """A mixture of C Gaussians over D = 3 coordinates of a position, or 6 with the velocity.

    Lengths are in metres, velocities in metres per second. Every method returns a new mixture.

    Parameters
    ----------
    log_weights
        Float64 [C]; the sum of the weights is the mass of the mixture.
    means, covariances
        Float64 [C, D] and [C, D, D].

    Raises
    ------
    ValueError
        If the shapes differ or have no rows, a number is not finite, or a covariance is not
        symmetric with positive eigenvalues. A log-weight may be -inf.
    """

    #: Part of the covariances of positions that errors cause that are nearly the same in all
    #: phases, such as those of poses, float64 [3, 3] [m^2]; see `shared`.
    constant_covariance: np.ndarray = read_only(np.zeros((3, 3)))

    # Tuples would compare the arrays, which have no truth value.
    __eq__, __ne__, __hash__ = object.__eq__, object.__ne__, object.__hash__

    def __new__(cls: type[_MixtureT], log_weights: np.ndarray, means: np.ndarray,
                covariances: np.ndarray) -> _MixtureT:
        """Check the arrays. `_make`, which all methods use, does not."""
        weights = numbers('log_weights', log_weights, shapes=[('C',)], finite=False)
        if not -np.inf < weights.max(initial=-np.inf) < np.inf:
            raise ValueError(f'log_weights: maximum {weights.max(initial=-np.inf):g}, expected a '
                             'finite one')
        n = len(weights)
        centres = numbers('means', means, shapes=[(n, 3), (n, 6)])
        spreads = numbers('covariances', covariances, shapes=[(*centres.shape, centres.shape[1])])
        if problem := covariance_problem(spreads):
            raise ValueError(f'covariances: {problem}')
        return super().__new__(cls, weights, centres, spreads)

    def __reduce__(self) -> tuple[object, ...]:
        """Return what copies and pickles consist of, without checks: a result may have no rows."""
        return type(self)._make, (tuple(self),), vars(self)

    @property
    def log_mass(self) -> float:
        """Logarithm of the integral of the density."""
        return log_sum(self.log_weights)

    @property
    def probabilities(self) -> np.ndarray:
        """Weights of the components with the sum 1, float64 [C]."""
        return mixture_weights(self.log_weights)[0]

    @property
    def log_peaks(self) -> np.ndarray:
        """Logarithms of the densities of the components at their means, float64 [C]."""
        return self.log_weights - log_volume(self.covariances)

    def normalised(self: _MixtureT) -> _MixtureT:
        """Return the mixture with a mass of 1."""
        return self.weighted(-self.log_mass)

    def weighted(self: _MixtureT, log_factor: float | np.ndarray) -> _MixtureT:
        """Return the mixture with its weights multiplied by a factor, given as its logarithm."""
        return self._replace(log_weights=self.log_weights + log_factor)

    def powered(self: _MixtureT, exponent: float) -> _MixtureT:
        """Return the mixture with the density of each component raised to a power."""
        powered = self._replace(covariances=self.covariances / exponent)
        return powered.weighted(exponent * self.log_peaks - powered.log_peaks)

    def widened(self: _MixtureT, covariance: np.ndarray) -> _MixtureT:
        """Return the mixture after independent errors, [D, D] or [C, D, D]; the mass stays."""
        return self._replace(covariances=self.covariances + covariance)

    def shared(self: _MixtureT, covariance: np.ndarray) -> _MixtureT:
        """Return the mixture after errors of the position, [3, 3], that other phases share.

        The result has this `constant_covariance`, which is lost in all further steps.
        """
        wider = np.zeros((self.means.shape[1],) * 2)
        wider[:3, :3] = covariance
        found = self.widened(wider)
        found.constant_covariance = covariance
        return found

    @property
    def fresh(self: _MixtureT) -> _MixtureT:
        """The mixture without the errors that other phases share."""
        return self.shared(-self.constant_covariance)

    def position(self: _MixtureT) -> _MixtureT:
        """Return the mixture of the position alone, D = 3."""
        return self._replace(
            means=self.means[:, :3], covariances=self.covariances[:, :3, :3])

    def at_velocities(self: _MixtureT, variance: np.ndarray) -> _MixtureT:
        """Return the mixture with D = 6; without velocities, they get a density around 0.

        `variance`, [3, 3] [m^2/s^2], is the covariance of this density.
        """
        n, size = self.means.shape
        if size > 3:
            return self
        covariances = np.zeros((n, 6, 6))
        covariances[:, :3, :3], covariances[:, 3:, 3:] = self.covariances, variance
        return self._replace(
            means=np.hstack([self.means, np.zeros((n, 3))]), covariances=covariances)

    def scaled(self: _MixtureT, factor: float) -> _MixtureT:
        """Return the mixture with its covariance multiplied by a factor, around its mean."""
        mean = self.probabilities @ self.means
        return self._replace(means=mean + factor**0.5 * (self.means - mean),
                             covariances=factor * self.covariances)

    def moved(self, before: Pose, after: Pose) -> 'Mixture':
        """Return the mixture as if a surface with one pose had another pose."""
        turn = after.rotation @ before.rotation.T
        whole = np.kron(np.eye(self.means.shape[1] // 3), turn)
        means = self.means @ whole.T
        means[:, :3] = after.to_site(before.to_surface(self.means[:, :3]))
        return self._replace(means=means, covariances=whole @ self.covariances @ whole.T)

    def velocities(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return means [T, 3] and covariances [T, 3, 3] of the velocity at positions [T, 3].

        The last result, [T, 3, 3] [1/s], is the derivative of the means of the components.
        """
        place, cross = self.covariances[:, :3, :3], self.covariances[:, 3:, :3]
        slopes = cross @ np.linalg.inv(place)
        offsets = positions[:, None] - self.means[:, :3]
        log_density, _ = overlap(offsets, np.broadcast_to(place, (*offsets.shape, 3)))
        shares, _ = mixture_weights(self.log_weights + log_density)
        means = self.means[:, 3:] + np.matmul(slopes, offsets[..., None])[..., 0]
        within = self.covariances[:, 3:, 3:] - slopes @ np.swapaxes(cross, 1, 2)
        mean, between = moments(shares, means)
        return (mean, symmetric(np.tensordot(shares, within, axes=1) + between),
                np.tensordot(shares, slopes, axes=1))

    def without_prior(self, variance: np.ndarray) -> 'Mixture':
        """Divide by the density of velocities before the signals, D = 6.

        That density is Gaussian around 0 with the covariance `variance`, [3, 3] [m^2/s^2]. The
        product of the result with it has the weights of this mixture.
        """
        information = np.zeros((6, 6))
        information[3:, 3:] = np.linalg.inv(variance)
        roots = np.linalg.cholesky(self.covariances)
        # Moments of samples may exceed those of the prior.
        shares, axes = np.linalg.eigh(np.swapaxes(roots, 1, 2) @ information @ roots)
        left = 1 / (1 - np.clip(shares, 0.0, _MOST_OF_PRIOR))
        covariances = roots @ (axes * left[:, None]) @ np.swapaxes(roots @ axes, 1, 2)
        means = np.matmul(covariances, np.linalg.solve(
            self.covariances, self.means[..., None]))[..., 0]
        log_density, _ = overlap(means[:, 3:], covariances[:, 3:, 3:] + variance)
        return self._replace(log_weights=self.log_weights - log_density, means=means,
                             covariances=symmetric(covariances))

    def or_within(self, centre_m: np.ndarray, covariance: np.ndarray, probability: float
                  ) -> 'Mixture':
        """Add a component, wider than a region, for users who may be anywhere in the region.

        The density is that of a uniform one with the given probability in a box whose squared
        edges are the variances, [3, 3] [m^2]. Velocities have the same mean square as in the
        mixture, the same in all directions.
        """
        size = self.means.shape[1]
        mean, joint = np.zeros(size), np.zeros((size, size))
        mean[:3], joint[:3, :3] = centre_m, covariance
        if size > 3:
            average, spread = (one[3:] for one in self.moments())
            square = (average @ average + np.trace(spread[:, 3:])) / 3
            joint[3:, 3:] = square * np.eye(size - 3)
        # The peak of a Gaussian is lower than a uniform density of the same extent.
        log_weight = np.log(probability) + 1.5 * np.log(2 * np.pi)
        rest = self.weighted(np.log1p(-probability) - self.log_mass)
        return concatenate(rest, self._replace(
            log_weights=np.array([log_weight]), means=mean[None], covariances=joint[None]))

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean, float64 [D], and the covariance, float64 [D, D]."""
        weights = self.probabilities
        mean, between = moments(weights, self.means)
        return mean, symmetric(np.tensordot(weights, self.covariances, axes=1) + between)

    def log_density(self, points: np.ndarray) -> np.ndarray:
        """Evaluate the logarithm of the density at points [..., D], float64 [...]."""
        precision = np.linalg.inv(self.covariances)
        points = numbers('points', points, shapes=[('...', self.means.shape[1])])
        offsets = points[..., None, :] - self.means
        squares = np.einsum('...cp,cpq,...cq->...c', offsets, precision, offsets)
        return mixture_weights(self.log_peaks - squares / 2)[1]

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw n independent points, float64 [n, D]."""
        chosen = rng.choice(len(self.means), size=n, p=self.probabilities)
        roots = np.linalg.cholesky(self.covariances)[chosen]
        normal = rng.standard_normal((n, self.means.shape[1], 1))
        return self.means[chosen] + np.matmul(roots, normal)[..., 0]

    def reduce(self: _MixtureT, max_components: int = MAX_COMPONENTS,
               distance: float = _MERGE_DISTANCE) -> _MixtureT:
        """Merge components close to a heavier one; discard light ones and any beyond the maximum.

        A component is close to another one if its squared Mahalanobis distance from it, with the
        covariance of the heavier one, is less than `distance`. Merging preserves the mass, the
        mean and the covariance.
        """
        order = np.argsort(-self.log_weights, kind='stable')
        order = order[self.log_weights[order] >= self.log_weights[order[0]] - _WEIGHT_MARGIN]
        mixture = select(self, order)
        precisions = np.linalg.inv(mixture.covariances)
        group = np.full(len(order), -1)
        for number in range(max_components):
            free = group < 0
            if not free.any():
                break
            leader = int(np.argmax(free))
            offsets = mixture.means - mixture.means[leader]
            squares = np.einsum('cp,cp->c', offsets @ precisions[leader], offsets)
            squares[leader] = -1.0
            group[free & (squares < distance)] = number
        return mixture._merged(group)

    def product(self, other: 'Mixture') -> 'Mixture':
        """Return the product of two densities: one component for each pair, not normalised.

        The other mixture may have fewer coordinates, which are the first ones of this mixture; it
        then is a likelihood of these. The mass is the integral of the product.
        """
        first, second = np.indices((len(self.means), len(other.means))).reshape(2, -1)
        return select(self, first).updated(select(other, second))

    def heaviest_pairs(self, other: 'Mixture', number: int, margin: float = np.inf
                       ) -> tuple[np.ndarray, np.ndarray]:
        """Return the components of both mixtures in the heaviest terms of `product`.

        The log-weights of the terms are within `margin` of the heaviest one.
        """
        size = other.means.shape[1]
        offsets = other.means[:, None] - self.means[:, :size]
        covariances = self.covariances[:, :size, :size] + other.covariances[:, None]
        log_weights = other.log_weights[:, None] + self.log_weights - log_volume(covariances)
        log_weights -= np.sum(offsets * step_to_maximum(covariances, offsets), axis=2) / 2
        order = np.argsort(-log_weights, axis=None, kind='stable')[:number]
        kept = log_weights.ravel()[order] >= log_weights.max() - margin
        second, first = np.unravel_index(order[kept], log_weights.shape)
        return first, second

    def updated(self: _MixtureT, other: 'Mixture') -> _MixtureT:
        """Multiply each component by the one in the same row of `other`; see `product`."""
        size = other.means.shape[1]
        offsets = other.means - self.means[:, :size]
        log_density, precision = overlap(
            offsets, self.covariances[:, :size, :size] + other.covariances)
        gain = np.matmul(self.covariances[:, :, :size], precision)
        return self._replace(
            log_weights=self.log_weights + other.log_weights + log_density,
            means=self.means + np.matmul(gain, offsets[..., None])[..., 0],
            covariances=symmetric(
                self.covariances - np.matmul(gain, self.covariances[:, :size])))

    def _merged(self: _MixtureT, group: np.ndarray) -> _MixtureT:
        """Merge the components of each group; discard group -1."""
        members = np.equal.outer(np.arange(group.max() + 1), group)
        shares, log_weights = mixture_weights(np.where(members, self.log_weights, -np.inf))
        means = shares @ self.means
        offsets = self.means - means[group]
        spread = self.covariances + offsets[:, :, None] * offsets[:, None, :]
        size = means.shape[1]
        covariances = (shares @ spread.reshape(len(group), -1)).reshape(-1, size, size)
        return self._replace(log_weights=log_weights, means=means, covariances=covariances)


def velocity_variance(std_mps: float, bounds_m: np.ndarray) -> np.ndarray:
    """Return the covariance of the velocities of users before any signals, [3, 3] [m^2/s^2].

    They have components only along the axes with an extent between the bounds, [2, 3] [m].
    """
    return np.diag(std_mps**2 * (np.ptp(bounds_m, axis=0) > 0) + _FIXED_MPS**2)


def with_velocities(
        places: Mixture, others: Sequence[Mixture], variance: np.ndarray) -> Mixture:
    """Add the velocities of mixtures with D = 6 to a mixture of positions.

    Each component has the product of their densities at its mean; the mass becomes 1. All of them
    contain the same density before the signals, with a variance [3, 3] [m^2/s^2]; see
    `Mixture.without_prior`.
    """
    first, *rest = others
    mean, within, slope = first.velocities(places.means)
    log_weights = places.log_weights
    for one in rest:
        other, spread, other_slope = one.without_prior(variance).velocities(places.means)
        log_density, precision = overlap(other - mean, within + spread)
        gain = np.matmul(within, precision)
        log_weights = log_weights + log_density
        mean = mean + np.matmul(gain, (other - mean)[..., None])[..., 0]
        slope = slope + np.matmul(gain, other_slope - slope)
        within = symmetric(within - np.matmul(gain, within))
    cross = np.matmul(slope, places.covariances)
    covariances = np.concatenate([
        np.concatenate([places.covariances, np.swapaxes(cross, 1, 2)], axis=2),
        np.concatenate([cross, within + np.matmul(cross, np.swapaxes(slope, 1, 2))], axis=2)],
        axis=1)
    found = Mixture._make((
        log_weights, np.hstack([places.means, mean]), symmetric(covariances))).normalised()
    found.constant_covariance = places.constant_covariance
    return found


def overlap(offsets: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log of Gaussian densities at offsets [..., D], and inverses of covariances."""
    precision = np.linalg.inv(covariances)
    log_scale = np.linalg.slogdet(2 * np.pi * covariances)[1] / 2
    squares = np.einsum('...p,...pq,...q->...', offsets, precision, offsets)
    return -squares / 2 - log_scale, precision


def log_volume(covariances: np.ndarray) -> np.ndarray:
    """Return logarithms of integrals of Gaussians with the maximum 1, for [C, D, D], [C]."""
    size = covariances.shape[-1]
    return (size * np.log(2 * np.pi) + np.linalg.slogdet(covariances)[1]) / 2
