"""Gaussians in (r, u, v), restricted to the region of interest.

A mode of the posterior is Gaussian in range and direction cosines, and the region is a box in x, y
and z. Coordinates of a position in both are therefore chosen one axis after another, each given
those before it. The limits of an axis are then those of the box, and every choice is inside. An
axis without extent has one value; the other axes follow as from any other value.

The axis in which the region is widest, compared with the Gaussian, comes last. Because the range
is known best, the surface of constant likelihood is nearly a sphere, which the last axis follows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import mixture_weights, untied
from rhs_isac_ros.model.gaussian import likelihood_loss, step_to_maximum, symmetric
from rhs_isac_ros.model.geometry import jacobian, polar_derivative, to_polar, to_positions
from rhs_isac_ros.model.pose import Frames, Pose
from rhs_isac_ros.positioning.mixture import Mixture, log_volume
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.templates import standard_normal

# Information that is added to each axis, relative to a uniform prior over the region, and smallest
# extent of an axis in it, relative to the largest one. At the edge of the half space, directions
# contain no information about x.
_FLOOR = 1e-3
_EXTENT = 1e-3
# Smallest standard deviation of the position that range and directions have, relative to the
# extent of the region. If they are known better, rounding exceeds the floor.
_EXACT = 3e-7
# In standard deviations: distance from a Gaussian's centre beyond which samples follow a Gaussian
# that is nearer, whose distribution function is then accurate; distance beyond which limits do not
# change the samples; and width of an interval in which the density is constant.
_DEVIATION = 6.0
_DISTANT = 5.0
_CONSTANT = 1e-4
# Share of the whole precision of an axis that counts like that of the range in its order.
_LEAST = 1e-6
# Standard deviation across the line of sight, relative to the diagonal of the region, above which
# a plane does not approximate the sphere.
_WIDE = 0.5
# Distance in standard deviations between both sides of the last axis on the sphere from which they
# are separate, and decrease of the log-likelihood up to which the far side counts.
_SEPARATE = 1.0
_FAR_SIDE = 8.0
# Smallest cosine of the angle from boresight in curvatures.
_COSINE = 0.05
# Densities of samples: smallest standard deviation [m], largest share of a uniform prior in the
# information along an axis, and number of samples of a mass.
_STD_M = 1e-5
_SHARE = 0.9
_SAMPLES = 64

# By default, regions are in the frame of the surface.
_AT_SURFACE = Pose()

# Returns coordinates, given the number of the axis, and mean, standard deviation and both limits
# of the Gaussians, [M, 1] or [M, S] [m].
_Choice = Callable[[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Sheets(Mixture):
    """C Gaussians over (r [m], u, v) around a surface; further coordinates are those of the site.

    A mode of the likelihood is a fraction of a wavelength thick and up to metres wide, so it bends
    around its surface. As a likelihood, sheets are functions of the position with the maxima
    `log_peaks`; as a posterior, they are a density of r, u, v and the further coordinates.
    """

    @classmethod
    def expanded(cls, points: np.ndarray, gradient: np.ndarray, curvature: np.ndarray,
                 log_values: np.ndarray, share: float = 1.0) -> 'Sheets':
        """Return likelihoods with given values, gradients and curvatures at points [C, 3].

        `share` is an exponent of the likelihood.
        """
        step = step_to_maximum(curvature, gradient)
        covariances = symmetric(np.linalg.inv(curvature)) / share
        log_peaks = share * (log_values + np.sum(gradient * step, axis=1) / 2)
        return cls._make((log_peaks + log_volume(covariances), points + step, covariances))

    @classmethod
    def of_density(cls, log_weights: np.ndarray, means: np.ndarray, covariances: np.ndarray,
                   bounds: np.ndarray) -> 'Sheets':
        """Return the likelihood whose product with a uniform prior in a region is a density.

        The density consists of Gaussians in (r, u, v) with moments inside the region; what the
        prior contributes to them is removed.
        """
        size, by_point = np.ptp(bounds, axis=0), jacobian(means)
        prior = np.where(size > 0, 12 / np.maximum(size, _STD_M)**2, 0.0)
        derivative = polar_derivative(means)
        # Where the region has no extent, the density contains no information across it.
        spread = np.einsum('cpa,cab,cpb->c', by_point, covariances, by_point)
        across = np.where(size > 0, 0.0, spread[:, None]) + _STD_M**2
        smallest = (derivative * across[:, None]) @ np.swapaxes(derivative, 1, 2)
        roots = np.linalg.cholesky(symmetric(covariances) + smallest)
        whitened = by_point @ roots
        shares, axes = np.linalg.eigh(
            np.swapaxes(whitened, 1, 2) @ (prior[:, None] * whitened))
        wider = 1 / (1 - np.minimum(shares, _SHARE))[:, None]
        by_axis = roots @ axes
        spread = (wider * by_axis) @ np.swapaxes(by_axis, 1, 2)
        sheets = cls._make((np.zeros(len(means)), means, symmetric(spread)))
        gaussians = sheets.inside(bounds)
        positions, log_ratio = gaussians.sample(standard_normal(_SAMPLES))
        _, log_mass = mixture_weights(gaussians.logarithm(positions) + log_ratio)
        return sheets.weighted(log_weights - log_mass)

    @classmethod
    def from_mixture(cls, mixture: Mixture, pose: Pose) -> 'Sheets':
        """Convert a density in the site to second order; what is behind the surface is left out.

        Raises ValueError if everything is behind.
        """
        positions = pose.to_surface(mixture.means[:, :3])
        mixture = select(mixture, _in_front(positions))
        points = to_polar(positions[positions[:, 0] > 0])
        sheets = cls._converted(mixture, points, polar_derivative(points) @ pose.rotation.T)
        # The second derivative of the range is the projection across the line of sight over the
        # range.
        sight = jacobian(points)[:, :, 0]
        across = (np.eye(3) - sight[:, :, None] * sight[:, None]) / points[:, :1, None]
        longer_m, variance_m2 = _moments_of_square(
            across, pose.covariances_to_surface(mixture.covariances[:, :3, :3]))
        sheets.means[:, 0] += longer_m
        sheets.covariances[:, 0, 0] += variance_m2
        return sheets

    @classmethod
    def tangent(cls, mixture: Mixture, pose: Pose) -> 'Sheets':
        """Bend a likelihood whose Gaussians touch their sheets at the maxima, and keep these.

        Raises ValueError if a maximum is behind the surface.
        """
        positions = pose.to_surface(mixture.means)
        if not _in_front(positions).all():
            raise _behind(positions)
        points = to_polar(positions)
        sheets = cls._converted(mixture, points, polar_derivative(points) @ pose.rotation.T)
        return sheets.weighted(mixture.log_peaks - sheets.log_peaks)

    def to_mixture(self, pose: Pose) -> Mixture:
        """Convert a density to the coordinates of the site, to second order."""
        points, cosines = self.means[:, :3], self.means[:, 1:3]
        mixture = Mixture._make(self._converted(
            self, pose.to_site(to_positions(points)), pose.rotation @ jacobian(points)))
        # Of the position, only x = r (1 - u^2 - v^2)^(1/2) is curved in u and v.
        w = np.sqrt(np.maximum(1 - np.sum(cosines**2, axis=1), _COSINE**2))[:, None, None]
        bending = -points[:, :1, None] * (
            np.eye(2) / w + cosines[:, :, None] * cosines[:, None, :] / w**3)
        shift_m, variance_m2 = _moments_of_square(bending, self.covariances[:, 1:3, 1:3])
        outward = pose.rotation[:, 0]
        mixture.means[:, :3] += shift_m[:, None] * outward
        mixture.covariances[:, :3, :3] += variance_m2[:, None, None] * np.outer(outward, outward)
        return mixture

    @classmethod
    def _converted(cls, mixture: Mixture, points: np.ndarray, derivative: np.ndarray) -> 'Sheets':
        """Replace the first three coordinates, which have the given derivative, [C, 3, 3]."""
        means, covariances = mixture.means.copy(), mixture.covariances.copy()
        means[:, :3] = points
        covariances[:, :3] = derivative @ covariances[:, :3]
        covariances[:, :, :3] = covariances[:, :, :3] @ np.swapaxes(derivative, 1, 2)
        return cls._make((mixture.log_weights, means, covariances))

    def narrowed(self, constant: np.ndarray, n_before: float = 0.0) -> 'Sheets':
        """Return likelihoods of a position with the errors that are the same in all phases.

        `constant`, float64 [3], contains their shares of the variances of r, u and v. The evidence
        of a phase counts less, the more phases `n_before` there were, because these had the same
        errors.
        """
        roots = np.sqrt(1 - constant)
        sheets = self._replace(covariances=roots[:, None] * self.covariances * roots)
        return sheets.weighted(
            self.log_peaks / (1 + n_before * constant[0]) - sheets.log_peaks)

    def as_density(self) -> 'Sheets':
        """Return the density of r, u and v for a uniform prior on the positions."""
        return self.weighted(np.log(np.linalg.det(jacobian(self.means))))

    def inside(self, bounds: np.ndarray, pose: Pose | Frames = _AT_SURFACE,
               around: np.ndarray | None = None) -> 'Inside':
        """Restrict the first three coordinates to a region, or a region each; see `Inside`.

        `around`, float64 [C, 3] [m], are positions in the region, by default those next to the
        maxima.
        """
        precision = np.linalg.inv(self.covariances[:, :3, :3])
        if around is None:
            around = pose.to_site(to_positions(self.means[:, :3]))
        points = to_polar(pose.to_surface(np.clip(around, *bounds)))
        offsets = self.means[:, :3] - points
        log_values = self.position().log_peaks - likelihood_loss(offsets, precision)
        return Inside.of(points, np.matmul(precision, offsets[..., None])[..., 0], precision,
                         bounds, pose, log_values)


def _in_front(positions: np.ndarray) -> np.ndarray:
    """Mark positions [C, 3] in front of the surface; raise ValueError if there is none."""
    front: np.ndarray = positions[:, 0] > 0
    if not front.any():
        raise _behind(positions)
    return front


def _behind(positions: np.ndarray) -> ValueError:
    return ValueError(f'mixture: means at x = {positions[:, 0].min():g} m in the frame of the '
                      'surface, expected positive x')


def _moments_of_square(matrices: np.ndarray, covariances: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance, [C], of d^T H d / 2 for Gaussian d of covariance [C, n, n]."""
    product = matrices @ covariances
    return (np.trace(product, axis1=1, axis2=2) / 2,
            np.einsum('cpq,cqp->c', product, product) / 2)


class Inside(NamedTuple):
    """M Gaussians ``exp(a + g^T d - d^T C d / 2)`` of offsets d in (r, u, v), in a region.

    Positions and the region are in the frame in which the surface has the pose.
    """

    origin: np.ndarray  # Those of `Frames`.
    rotation: np.ndarray
    log_values: np.ndarray  # a, float64 [M].
    points: np.ndarray  # (r [m], u, v), float64 [M, 3].
    gradient: np.ndarray  # g, float64 [M, 3].
    curvature: np.ndarray  # C, float64 [M, 3, 3].
    order: np.ndarray  # Axes in the order of their choice, int [M, 3].
    low_m: np.ndarray  # Limits of the axes from the surface, in this order, float64 [M, 3].
    high_m: np.ndarray
    centre_m: np.ndarray  # Unrestricted maximum, in this order, float64 [M, 3].
    precision: np.ndarray  # Inverse of the covariance, in this order, float64 [M, 3, 3] [1/m^2].
    std_m: np.ndarray  # Standard deviation of each axis, given those before it, float64 [M, 3].
    coupling: np.ndarray  # Decrease of an axis with those before it, float64 [M, 3, 3].
    direction: np.ndarray  # Unit vector to the point, in this order, float64 [M, 3].
    wide: np.ndarray  # See `_is_wide`, bool [M].

    @classmethod
    def of(cls, points: np.ndarray, gradient: np.ndarray, curvature: np.ndarray,
           bounds: np.ndarray, pose: Pose | Frames = _AT_SURFACE,
           log_values: np.ndarray | None = None) -> 'Inside':
        """Restrict Gaussians to the region between the bounds, [2, 3] or [2, M, 3] [m].

        Takes the first four fields, by default `log_values` of 0, and the pose of the surface or
        those of M surfaces.
        """
        frames = pose.frames(len(points))
        if log_values is None:
            log_values = np.zeros(len(points))
        positions = frames.vectors_to_site(to_positions(points))
        derivative = polar_derivative(points) @ frames.rotation.swapaxes(1, 2)
        transposed = derivative.transpose(0, 2, 1)
        low, high = limits = np.empty((2, *points.shape))
        limits[:] = bounds.reshape(2, -1, 3) - frames.origin
        extent = high - low
        known = np.sqrt(curvature.diagonal(axis1=1, axis2=2))
        known[:, 1:] /= points[:, :1]  # In standard deviations per metre.
        diagonal_m = np.sqrt(np.einsum('mp,mp->m', extent, extent))
        widening = 1 / np.maximum(known * _EXACT * diagonal_m[:, None], 1.0)
        gradient = widening * gradient
        curvature = widening[:, :, None] * curvature * widening[:, None]
        precision = np.matmul(np.matmul(transposed, curvature), derivative)
        smallest = _EXTENT * extent.max(axis=1, keepdims=True)
        np.einsum('mpp->mp', precision)[:] += 12 * _FLOOR / np.maximum(extent, smallest)**2
        centre = positions + step_to_maximum(
            precision, np.matmul(transposed, gradient[..., None])[..., 0])
        known = precision.diagonal(axis1=1, axis2=2)
        order = untied(extent * np.sqrt(known)).argsort(axis=1, kind='stable')
        wide = _is_wide(points, curvature, extent)
        if wide.any():
            # The last axis follows the sphere, even if directions determine another better.
            by_range = curvature[:, :1, 0] * derivative[:, 0]**2 + _LEAST * known
            last = np.argmax(untied(extent * np.sqrt(by_range)), axis=1)
            kept = order != last[:, None]
            order[wide] = np.column_stack([order[kept].reshape(-1, 2), last])[wide]
        # Places of the ordered axes in flat arrays, which `take` reads faster than an index.
        axes = order + 3 * np.arange(len(points))[:, None]
        return cls._in_order(
            (*frames, log_values, points, gradient, curvature), order, low.take(axes),
            high.take(axes), centre.take(axes),
            precision.take(3 * axes[:, :, None] + order[:, None]),
            derivative[:, 0].take(axes), wide)

    @classmethod
    def _in_order(
            cls, gaussians: tuple[Any, ...], order: np.ndarray, low: np.ndarray, high: np.ndarray,
            centre: np.ndarray, precision: np.ndarray, direction: np.ndarray, wide: np.ndarray
    ) -> 'Inside':
        # With the axes reversed, the Cholesky factor contains the conditional distributions.
        root = np.linalg.cholesky(precision[:, ::-1, ::-1])[:, ::-1, ::-1]
        std = 1 / root.diagonal(axis1=1, axis2=2)
        coupling = root.transpose(0, 2, 1) * std[:, :, None]
        return cls._make((*gaussians, order, low, high, centre, precision, std, coupling,
                          direction, wide))

    def nearest(self) -> np.ndarray:
        """Return the most likely position of each Gaussian in the region, float64 [M, 3] [m]."""
        def clipped(axis: int, mean: np.ndarray, std: np.ndarray, low: np.ndarray,
                    high: np.ndarray) -> np.ndarray:
            return mean

        positions = self._positions(clipped, 1)[..., 0].T
        last = positions[np.arange(len(positions)), self.order[:, 2]]
        (ends,) = np.nonzero((last == self.low_m[:, 2]) | (last == self.high_m[:, 2]))
        if len(ends):
            # The other axes may compensate for a limit of the last one.
            fixed = select(self, ends)._at_end(last[ends])
            positions[ends] = fixed._positions(clipped, 1)[..., 0].T
        return positions + self.origin

    def _at_end(self, last_m: np.ndarray) -> 'Inside':
        """Give the last axis a single value, [M] [m], and choose it first."""
        turn = [2, 0, 1]
        low, high = self.low_m[:, turn], self.high_m[:, turn]
        low[:, 0] = high[:, 0] = last_m
        return self._in_order(
            self[:6], self.order[:, turn], low, high, self.centre_m[:, turn],
            self.precision[:, turn][:, :, turn], self.direction[:, turn],
            _is_wide(self.points, self.curvature, high - low))

    def sample(self, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Draw samples in the region, which represent `normal`, points of a Gaussian [S, 3].

        Returns positions, float64 [M, S, 3] [m], and the logarithm of the uniform density over the
        region relative to the density of the samples, [M, S].
        """
        log_ratio = np.zeros((len(self.points), len(normal)))

        def truncated(axis: int, mean: np.ndarray, std: np.ndarray, low: np.ndarray,
                      high: np.ndarray) -> np.ndarray:
            deviations, ratio = _truncated(
                normal[:, axis], (low - mean) / std, (high - mean) / std)
            np.add(log_ratio, ratio, out=log_ratio)
            return mean + std * deviations

        # Half of the samples are on either side of the last axis' zero.
        sides = self._sides(np.where(np.arange(len(normal)) < len(normal) // 2, 1.0, -1.0))
        positions = self._positions(truncated, len(normal), sides)
        return (positions.transpose(1, 2, 0) + self.origin[:, None],
                log_ratio + self._log_share(sides))

    def log_ratio(self, positions: np.ndarray) -> np.ndarray:
        """Return the second result of `sample` at positions [M, S, 3] [m] in the region."""
        places = (positions - self.origin[:, None]).transpose(2, 0, 1)
        places = places[self.order.T, np.arange(len(positions))]
        log_ratio = np.zeros(places.shape[1:])

        def given(axis: int, mean: np.ndarray, std: np.ndarray, low: np.ndarray,
                  high: np.ndarray) -> np.ndarray:
            cut = _Cut.of((low - mean) / std, (high - mean) / std)
            np.add(log_ratio, cut.log_ratio((places[axis] - mean) / std), out=log_ratio)
            return places[axis]

        sides = self._sides(np.copysign(1.0, places[2]) * np.copysign(1.0, self.direction[:, 2:]))
        self._positions(given, places.shape[2], sides)
        return log_ratio + self._log_share(sides)

    def _sides(self, sides: np.ndarray) -> np.ndarray | None:
        """Return the sides of samples, [S] or [M, S], 0 where there is one; or None."""
        two_sided = self._is_two_sided()
        return np.where(two_sided[:, None], sides, 0.0) if two_sided.any() else None

    def _log_share(self, sides: np.ndarray | None) -> np.ndarray | float:
        """Return the logarithms of twice the shares of the sides in the last axis, [M, S]."""
        if sides is None:
            return 0.0
        low, high = self._side_limits(sides)
        shares = np.divide(high - low, (self.high_m - self.low_m)[:, 2:],
                           out=np.full(sides.shape, 0.5), where=sides != 0)
        return np.log(2 * shares)

    def _is_two_sided(self) -> np.ndarray:
        """Mark Gaussians with samples on either side of the last axis' zero, bool [M].

        A sphere meets a line along this axis at two points. They are apart if the region is thin
        along the other axes, and similarly likely if the directions are hardly known.
        """
        last, range_m, axis = self.direction[:, 2], self.points[:, 0], self.order[:, 2]
        found = (self.low_m[:, 2] < 0) & (self.high_m[:, 2] > 0)
        by_range = self.curvature[:, 0, 0] * last**2
        total = np.maximum(self.precision[:, 2, 2], by_range)
        found &= 2 * by_range * range_m * np.abs(last) > _SEPARATE * np.sqrt(total)
        rows = np.flatnonzero(found)
        if len(rows):
            chosen = select(self, rows)
            far_side = Frames(*chosen[:2]).vectors_to_site(to_positions(chosen.points))
            far_side[np.arange(len(rows)), axis[rows]] *= -1
            likelihood = chosen.logarithm((far_side + chosen.origin)[:, None])[:, 0]
            found[rows] = likelihood - self.log_values[rows] > -_FAR_SIDE
        return found

    def _side_limits(self, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the limits of the last axis on the same side of zero as the point, [M, S] [m].

        `sides` is 1 for this side, -1 for the other one, and 0 for both.
        """
        signs = np.copysign(sides, sides * self.direction[:, 2:])
        low, high = self.low_m[:, 2:], self.high_m[:, 2:]
        return (np.where(signs > 0, np.maximum(low, 0.0), low),
                np.where(signs < 0, np.minimum(high, 0.0), high))

    def logarithm(self, positions: np.ndarray) -> np.ndarray:
        """Evaluate the logarithms of the Gaussians at positions [M, S, 3] [m], float64 [M, S]."""
        positions = Frames(*self[:2]).to_surface(positions)
        # No user behind the surface is in sight.
        return np.where(positions[..., 0] > 0, log_values(
            positions, self.points, self.curvature, self.log_values, self.gradient), -np.inf)

    def _positions(self, choose: _Choice, n: int, sides: np.ndarray | None = None) -> np.ndarray:
        """Choose n positions for each Gaussian, axis by axis, float64 [3, M, n] [m].

        `sides`, [M, n], is that of `_side_limits`.
        """
        chosen = np.empty((3, len(self.points), n))
        offsets: list[np.ndarray] = []
        for axis in range(3):
            mean = self.centre_m[:, axis, None]
            for before, offset in enumerate(offsets):
                mean = mean - self.coupling[:, axis, before, None] * offset
            std = self.std_m[:, axis, None]
            low, high = self.low_m[:, axis, None], self.high_m[:, axis, None]
            if axis == 2:
                mean, std = self._on_sphere(chosen, mean, sides)
                if sides is not None:
                    low, high = self._side_limits(sides)
            # Rounding may lead to values just outside. These two are faster than `np.clip`.
            np.maximum(choose(axis, mean, std, low, high), low, out=chosen[axis])
            np.minimum(chosen[axis], high, out=chosen[axis])
            offsets.append(chosen[axis] - self.centre_m[:, axis, None])
        positions = np.empty_like(chosen)
        positions[self.order.T, np.arange(len(self.points))] = chosen
        return positions

    def _on_sphere(self, chosen: np.ndarray, mean: np.ndarray, sides: np.ndarray | None
                   ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation of the last axis, given the other two, [M, n].

        The mean is on the sphere of the range that the tangent plane has at `mean`. Where the
        sphere is parallel to the axis, the directions determine the coordinate.
        """
        first, second, last = (self.direction[:, axis, None] for axis in range(3))
        square_m2 = (first * chosen[0] + second * chosen[1] + last * mean)**2
        rest_m2 = np.maximum(square_m2 - chosen[0]**2 - chosen[1]**2, 0.0)
        precision = self.curvature[:, 0, 0, None]
        least = 1 / (np.sqrt(precision) * self.points[:, :1])
        by_range = precision * np.maximum(rest_m2 / square_m2, least)
        total = by_range + np.maximum(self.precision[:, 2, 2, None] - precision * last**2, 0.0)
        on_sphere = np.copysign(np.sqrt(rest_m2), last)
        if sides is not None:
            on_sphere = np.where(sides < 0, -on_sphere, on_sphere)
        mean, std = mean + by_range / total * (on_sphere - mean), 1 / np.sqrt(total)
        if (wide := self.wide).any():
            # Far outside, perhaps behind the surface, the derivatives are not those in the region.
            inside = np.clip(mean[wide], self.low_m[wide, 2:], self.high_m[wide, 2:])
            mean[wide], std[wide] = select(self, wide)._along(chosen[:, wide], inside)
        return mean, std

    def _along(self, chosen: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation of the last axis near values of it, [M, n].

        They follow from the derivatives of range and directions at these values.
        """
        positions, rows = np.empty((3, *last.shape)), np.arange(len(last))
        for axis, values in enumerate((*chosen[:2], last)):
            positions[self.order[:, axis], rows] = values
        sight, along = np.einsum('mba,bmn->amn', self.rotation, positions), self.rotation[
            rows, self.order[:, 2]].T
        range_m = np.sqrt(np.sum(sight**2, axis=0))
        sight /= range_m
        slope = np.einsum('am,amn->mn', along, sight)
        slopes = np.stack([slope, *((along[1:, :, None] - sight[1:] * slope) / range_m)])
        offsets = np.stack([range_m, *sight[1:]]) - self.points.T[..., None]
        through = np.einsum('mij,jmn->imn', self.curvature, slopes)
        information = np.maximum(np.sum(slopes * through, axis=0), np.finfo(float).tiny)
        gradient = np.einsum('mi,imn->mn', self.gradient, slopes) - np.sum(
            through * offsets, axis=0)
        return last + gradient / information, 1 / np.sqrt(information)


def log_values(
        positions: np.ndarray, points: np.ndarray, curvature: np.ndarray, log_peaks: np.ndarray,
        gradient: np.ndarray | None = None) -> np.ndarray:
    """Evaluate Gaussians of offsets from points [M, 3] at positions [M, S, 3] [m], [M, S].

    Everything is in the frame of the surface. Without a gradient, [M, 3], the points are maxima.
    """
    # Contiguous coordinates make these operations several times as fast.
    x, y, z = positions.transpose(2, 0, 1)
    range_m = np.sqrt(x * x + y * y + z * z)
    offsets, total = [range_m, y / range_m, z / range_m], np.zeros_like(range_m)
    for first in range(3):
        offsets[first] = offsets[first] - points[:, first, None]
        slope = curvature[:, first, first, None] / -2 * offsets[first]
        if gradient is not None:
            slope += gradient[:, first, None]
        for second in range(first):
            slope -= curvature[:, first, second, None] * offsets[second]
        slope *= offsets[first]
        total += slope
    total += log_peaks[:, None]
    return total


def _is_wide(points: np.ndarray, curvature: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Mark Gaussians, one of whose directions is hardly determined within the region, bool [M].

    This is so for a board with a single row or column of elements. The region then contains a
    large part of the sphere, which no plane approximates.
    """
    least = np.minimum(curvature[:, 1, 1], curvature[:, 2, 2])
    limit_m2 = _WIDE**2 * np.einsum('mp,mp->m', extent, extent)
    wide: np.ndarray = points[:, 0]**2 > limit_m2 * least
    return wide


def move_inside(points: np.ndarray, curvature: np.ndarray, bounds: np.ndarray,
                pose: Pose | Frames = _AT_SURFACE) -> np.ndarray:
    """Return the most likely points inside the region for Gaussians around points [M, 3].

    Bounds and poses are those of `Inside.of`.
    """
    positions = pose.to_site(to_positions(points))
    (outside,) = np.nonzero(((positions < bounds[0]) | (positions > bounds[1])).any(axis=1))
    moved = points.copy()
    if len(outside):
        frames, curvature = select(pose.frames(len(points)), outside), curvature[outside]
        bounds = np.broadcast_to(bounds.reshape(2, -1, 3), (2, *points.shape))[:, outside]
        start = to_polar(frames.to_surface(np.clip(positions[outside], *bounds)))
        gradient = np.matmul(curvature, (points[outside] - start)[..., None])[..., 0]
        moved[outside] = to_polar(frames.to_surface(
            Inside.of(start, gradient, curvature, bounds, frames).nearest()))
    return moved


class _Cut(NamedTuple):
    """A normal density, restricted to intervals [M, 1] or [M, S].

    It is mirrored so that the lower tail of the distribution function, which is accurate, counts.
    """

    sign: np.ndarray  # -1 where it is mirrored.
    shift: np.ndarray  # By which the interval is moved towards the maximum.
    share: np.ndarray  # Of the density below the interval.
    between: np.ndarray  # Share of the density in the interval.
    log_density: np.ndarray  # Logarithm of its average in the interval.

    @classmethod
    def of(cls, low: np.ndarray, high: np.ndarray) -> '_Cut':
        """Restrict it to the intervals between these limits."""
        from scipy.special import ndtr

        width, sign = high - low, np.where(low + high > 0, -1.0, 1.0)
        left, right = np.where(sign < 0, (-high, -low), (low, high))
        shift = np.minimum(right + _DEVIATION, 0.0)
        left, right = left - shift, right - shift
        share = ndtr(left)
        between = ndtr(right) - share
        centre = np.exp(-(left + right)**2 / 8) / np.sqrt(2 * np.pi)
        least = _CONSTANT
        return cls(sign, shift, share, between, np.log(np.where(
            width > least, between / np.maximum(width, least), centre)))

    def log_ratio(self, deviations: np.ndarray) -> np.ndarray:
        """Return the logarithm of a uniform density relative to this one, [M, S]."""
        ratio: np.ndarray = (self.log_density + np.log(2 * np.pi) / 2
                             + (self.sign * deviations - self.shift)**2 / 2)
        return ratio


def _truncated(normal: np.ndarray, low: np.ndarray, high: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
    """Restrict points of a normal density [S] to intervals [M, 1] or [M, S].

    Returns points [M, S], and the logarithm of a uniform density relative to theirs.
    """
    from scipy.special import ndtr, ndtri

    deviations = np.repeat(normal[None], len(low), axis=0)
    wide = (low.max(axis=1) <= -_DISTANT) & (high.min(axis=1) >= _DISTANT)
    ratio = normal**2 / 2 - np.log(np.where(wide[:, None], high - low, 1.0)) + np.log(
        2 * np.pi) / 2
    if not wide.all():
        cut = _Cut.of(low[~wide], high[~wide])
        value = cut.sign * (cut.shift + ndtri(cut.share + cut.between * np.where(
            cut.sign < 0, ndtr(-normal), ndtr(normal))))
        deviations[~wide], ratio[~wide] = value, cut.log_ratio(value)
    return deviations, ratio
