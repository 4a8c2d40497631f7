"""Gaussians in (r, u, v), restricted to the region of interest.

A mode of the posterior is Gaussian in range and direction cosines, and the region is a box in x, y
and z. Coordinates of a position in both are therefore chosen one axis after another, each given
those before it. The limits of an axis are then those of the box, and every choice is inside. An
axis without extent has one value; the other axes follow as from any other value.

The axis in which the region is widest, compared with the Gaussian, comes last. Because the range
is known best, the surface of constant likelihood is nearly a sphere, which the last axis follows.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import untied
from rhs_isac_ros.model.gaussian import step_to_maximum
from rhs_isac_ros.model.geometry import polar_derivative, to_polar, to_positions
from rhs_isac_ros.positioning.segments import select


class _Limits(NamedTuple):
    """Numbers that keep the restricted Gaussians accurate."""

    # Information that is added to each axis, relative to a uniform prior over the region, and
    # smallest extent of an axis in it, relative to the largest one. At the edge of the half space,
    # directions contain no information about x.
    floor: float = 1e-3
    extent: float = 1e-3
    # Smallest standard deviation of the position that range and directions have, relative to the
    # extent of the region. If they are known better, rounding exceeds the floor.
    exact: float = 3e-7
    # The others are in standard deviations. Distance from a Gaussian's centre beyond which samples
    # follow a Gaussian that is nearer. Its distribution function is then accurate.
    deviation: float = 6.0
    # Distance beyond which limits do not change the samples.
    distant: float = 5.0
    # Width of an interval below which the density in it is constant.
    constant: float = 1e-4
    # Distance between both sides of the last axis on the sphere from which they are separate, and
    # decrease of the log-likelihood up to which the far side counts.
    separate: float = 1.0
    far_side: float = 8.0


_LIMITS = _Limits()

# Returns coordinates, given the number of the axis, and mean, standard deviation and both limits
# of the Gaussians, [M, 1] or [M, S] [m].
_Choice = Callable[[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Restricted(NamedTuple):
    """M Gaussians ``exp(g^T d - d^T C d / 2)`` of offsets d from points inside the region."""

    points: np.ndarray  # (r [m], u, v), float64 [M, 3].
    gradient: np.ndarray  # g, float64 [M, 3].
    curvature: np.ndarray  # C, float64 [M, 3, 3].
    order: np.ndarray  # Axes in the order of their choice, int [M, 3].
    low_m: np.ndarray  # Limits of the axes in this order, float64 [M, 3].
    high_m: np.ndarray
    centre_m: np.ndarray  # Unrestricted maximum, in this order, float64 [M, 3].
    precision: np.ndarray  # Inverse of the covariance, in this order, float64 [M, 3, 3] [1/m^2].
    std_m: np.ndarray  # Standard deviation of each axis, given those before it, float64 [M, 3].
    coupling: np.ndarray  # Decrease of an axis with those before it, float64 [M, 3, 3].
    direction: np.ndarray  # Unit vector to the point, in this order, float64 [M, 3].

    @classmethod
    def of(cls, points: np.ndarray, gradient: np.ndarray, curvature: np.ndarray,
           bounds: np.ndarray) -> 'Restricted':
        """Restrict Gaussians with gradient [M, 3] and curvature [M, 3, 3] to bounds [2, 3] [m]."""
        positions, derivative = to_positions(points), polar_derivative(points)
        transposed = np.swapaxes(derivative, 1, 2)
        extent = bounds[1] - bounds[0]
        # Metres per unit of r, u and v.
        metres = np.column_stack([np.ones(len(points)), points[:, :1], points[:, :1]])
        known = np.sqrt(np.diagonal(curvature, axis1=1, axis2=2)) / metres
        widening = 1 / np.maximum(known * _LIMITS.exact * np.linalg.norm(extent), 1.0)
        gradient = widening * gradient
        curvature = widening[:, :, None] * curvature * widening[:, None]
        precision = np.matmul(np.matmul(transposed, curvature), derivative)
        precision += np.diag(
            12 * _LIMITS.floor / np.maximum(extent, _LIMITS.extent * extent.max())**2)
        centre = positions + step_to_maximum(
            precision, np.matmul(transposed, gradient[..., None])[..., 0])
        freedom = extent * np.sqrt(np.diagonal(precision, axis1=1, axis2=2))
        order = np.argsort(untied(freedom), axis=1, kind='stable')
        rows = np.arange(len(points))[:, None]
        low, high = bounds
        return cls._in_order(
            points, gradient, curvature, order, low[order], high[order], centre[rows, order],
            precision[rows[..., None], order[:, :, None], order[:, None]],
            derivative[:, 0][rows, order])

    @classmethod
    def _in_order(
            cls, points: np.ndarray, gradient: np.ndarray, curvature: np.ndarray,
            order: np.ndarray, low: np.ndarray, high: np.ndarray, centre: np.ndarray,
            precision: np.ndarray, direction: np.ndarray) -> 'Restricted':
        # With the axes reversed, the Cholesky factor contains the conditional distributions.
        root = np.linalg.cholesky(precision[:, ::-1, ::-1])[:, ::-1, ::-1]
        std = 1 / np.diagonal(root, axis1=1, axis2=2)
        coupling = np.swapaxes(root, 1, 2) * std[:, :, None]
        return cls(points, gradient, curvature, order, low, high, centre, precision, std,
                   coupling, direction)

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
        return positions

    def _at_end(self, last_m: np.ndarray) -> 'Restricted':
        """Give the last axis a single value, [M] [m], and choose it first."""
        turn = [2, 0, 1]
        low, high = self.low_m[:, turn], self.high_m[:, turn]
        low[:, 0] = high[:, 0] = last_m
        return self._in_order(
            self.points, self.gradient, self.curvature, self.order[:, turn], low, high,
            self.centre_m[:, turn], self.precision[:, turn][:, :, turn], self.direction[:, turn])

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

        sides = None
        if (two_sided := self._is_two_sided()).any():
            # Half of the samples are on either side of the last axis' zero.
            sides = np.zeros((len(two_sided), len(normal)))
            sides[two_sided] = np.where(np.arange(len(normal)) < len(normal) // 2, 1.0, -1.0)
            low_m, high_m = self._side_limits(sides)
            share = (high_m - low_m)[two_sided] / (self.high_m - self.low_m)[two_sided, 2:]
            log_ratio[two_sided] = np.log(2 * share)
        positions = self._positions(truncated, len(normal), sides)
        return np.moveaxis(positions, 0, 2), log_ratio

    def _is_two_sided(self) -> np.ndarray:
        """Mark Gaussians with samples on either side of the last axis' zero, bool [M].

        A sphere meets a line along this axis at two points. They are apart if the region is thin
        along the other axes, and similarly likely if the directions are hardly known.
        """
        last, range_m, axis = self.direction[:, 2], self.points[:, 0], self.order[:, 2]
        found = (self.low_m[:, 2] < 0) & (self.high_m[:, 2] > 0)
        by_range = self.curvature[:, 0, 0] * last**2
        total = np.maximum(self.precision[:, 2, 2], by_range)
        found &= 2 * by_range * range_m * np.abs(last) > _LIMITS.separate * np.sqrt(total)
        rows = np.flatnonzero(found)
        if len(rows):
            far_side = to_positions(self.points[rows])
            far_side[np.arange(len(rows)), axis[rows]] *= -1
            likelihood = select(self, rows).logarithm(far_side[:, None])[:, 0]
            found[rows] = likelihood > -_LIMITS.far_side
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
        # Contiguous coordinates make these operations several times as fast.
        range_m = np.sqrt(np.sum(np.moveaxis(positions, 2, 0)**2, axis=0))
        offsets = [range_m, positions[..., 1] / range_m, positions[..., 2] / range_m]
        total = np.zeros_like(range_m)
        for first in range(3):
            offsets[first] -= self.points[:, first, None]
            slope = self.gradient[:, first, None] - self.curvature[:, first, first, None] / 2 * (
                offsets[first])
            for second in range(first):
                slope -= self.curvature[:, first, second, None] * offsets[second]
            total += slope * offsets[first]
        return total

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
        return mean + by_range / total * (on_sphere - mean), 1 / np.sqrt(total)


def move_inside(points: np.ndarray, curvature: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return the most likely points inside the region for Gaussians around points [M, 3]."""
    moved = points.copy()
    positions = to_positions(points)
    (outside,) = np.nonzero(((positions < bounds[0]) | (positions > bounds[1])).any(axis=1))
    if len(outside):
        start = to_polar(np.clip(positions[outside], *bounds))
        curvature = curvature[outside]
        gradient = np.matmul(curvature, (points[outside] - start)[..., None])[..., 0]
        moved[outside] = to_polar(Restricted.of(start, gradient, curvature, bounds).nearest())
    return moved


def _truncated(normal: np.ndarray, low: np.ndarray, high: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
    """Restrict points of a normal density [S] to intervals [M, 1] or [M, S].

    Returns points [M, S], and the logarithm of a uniform density relative to theirs.
    """
    from scipy.special import ndtr, ndtri

    deviations = np.repeat(normal[None], len(low), axis=0)
    width = high - low
    cut = (low.max(axis=1) > -_LIMITS.distant) | (high.min(axis=1) < _LIMITS.distant)
    ratio = normal**2 / 2 - np.log(np.where(cut[:, None], 1.0, width))
    if cut.any():
        low, high, width = low[cut], high[cut], width[cut]
        # The lower tail of the distribution function is accurate.
        sign = np.where(low + high > 0, -1.0, 1.0)
        left, right = np.where(sign < 0, (-high, -low), (low, high))
        shift = np.minimum(right + _LIMITS.deviation, 0.0)
        left, right = left - shift, right - shift
        share = ndtr(left)
        between = ndtr(right) - share
        value = ndtri(share + between * np.where(sign < 0, ndtr(-normal), ndtr(normal)))
        centre = np.exp(-(left + right)**2 / 8) / np.sqrt(2 * np.pi)
        least = _LIMITS.constant
        density = np.where(width > least, between / np.maximum(width, least), centre)
        deviations[cut] = sign * (value + shift)
        ratio[cut] = value**2 / 2 + np.log(density)
    return deviations, ratio + np.log(2 * np.pi) / 2
