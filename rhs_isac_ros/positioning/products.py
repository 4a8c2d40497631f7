"""Products of curved sheets, each around another surface, and Gaussians that are as wide.

A sheet is a Gaussian in range and direction cosines of its surface. Around each place, the
logarithm of a product has a gradient and a curvature. Two sheets of opposite curvature that touch
have a product along a rim, which may be far from the maximum. A Gaussian is thus as wide as if the
other sheets were thicker by what they bend over it. Three thin sheets meet in a point, over which
none of them bends.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.gaussian import step_to_maximum, symmetric
from rhs_isac_ros.model.geometry import jacobian, polar_derivative, to_polar, to_positions
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.positioning.sheets import Inside, log_values


class _Limits(NamedTuple):
    """Numbers that trade the width of Gaussians for the share of effective samples."""

    # Factor by which samples are wider than a Gaussian.
    spread: float = 1.2
    # Smallest extent of the region along an axis, relative to the largest one.
    extent: float = 1e-3
    # Step of second differences in standard deviations of a Gaussian, and factor by which sheets
    # are thicker, as they bend more in the tails.
    step: float = 1.5
    tails: float = 3.0
    # Greatest number of Gaussians, over each of which sheets bend anew, and largest increase of
    # the information after which there is no further one.
    passes: int = 5
    settled: float = 1.5
    # Largest distance of another place where two sheets meet, in standard deviations of the first
    # one, and smallest distance of the sheets between both places, in those of the second one.
    reach: float = 3.5
    apart: float = 2.0
    # Share of the way to this place that has to be inside the part of the region.
    within: float = 0.75


_LIMITS = _Limits()


class Rows(NamedTuple):
    """T sheets or constants of one surface."""

    points: np.ndarray  # Maxima, (r [m], u, v), float64 [T, 3].
    covariances: np.ndarray  # Float64 [T, 3, 3].
    curvature: np.ndarray  # Their inverses; 0 for a constant.
    log_peaks: np.ndarray  # Float64 [T].
    log_limits: np.ndarray  # Largest values in the region, infinite if unknown, float64 [T].
    is_sheet: np.ndarray  # Whether the row is not a constant, bool [T].


class Term(NamedTuple):
    """The factors of T products that are due to one surface."""

    pose: Pose
    rows: Rows

    def logarithm(self, positions: np.ndarray) -> np.ndarray:
        """Evaluate the factors at positions [T, S, 3] [m], float64 [T, S]."""
        local, rows = self.pose.to_surface(positions), self.rows
        values = np.minimum(log_values(
            local, rows.points, rows.curvature, rows.log_peaks), rows.log_limits[:, None])
        # No user behind the surface is in sight.
        return np.where((local[..., 0] <= 0) & rows.is_sheet[:, None], -np.inf, values)

    def expanded(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient [T, 3] and curvature [T, 3, 3] at positions [T, 3] [m]."""
        points = to_polar(self.pose.to_surface(positions))
        derivative = polar_derivative(points) @ self.pose.rotation.T
        slope = derivative.swapaxes(1, 2) @ self.rows.curvature
        return (slope @ (self.rows.points - points)[..., None])[..., 0], slope @ derivative


def logarithm(terms: Sequence[Term], positions: np.ndarray) -> np.ndarray:
    """Evaluate products at positions [T, S, 3] [m], float64 [T, S]."""
    return functools.reduce(np.add, (one.logarithm(positions) for one in terms))


def prior_information(bounds_m: np.ndarray) -> np.ndarray:
    """Return the information of uniform priors in boxes [2, ..., 3] [m], [..., 3, 3] [1/m^2]."""
    size = np.ptp(bounds_m, axis=0)
    smallest = _LIMITS.extent * size.max(axis=-1, keepdims=True)
    return 12 / np.maximum(size, smallest)[..., None]**2 * np.eye(3)


def expanded(terms: Sequence[Term], positions: np.ndarray, prior: np.ndarray
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (r, u, v) around the first surface, and gradient and curvature with respect to it.

    The curvature includes the information of a prior in the site, float64 [3, 3] [1/m^2].
    """
    pose = terms[0].pose
    points = to_polar(pose.to_surface(positions))
    by_point = pose.rotation @ jacobian(points)
    gradient, curvature = (functools.reduce(np.add, parts) for parts in zip(
        *(one.expanded(positions) for one in terms), strict=True))
    transposed = by_point.swapaxes(1, 2)
    return (points, (transposed @ gradient[..., None])[..., 0],
            symmetric(transposed @ (curvature + prior) @ by_point))


def proposal(terms: Sequence[Term], positions: np.ndarray, bounds_m: np.ndarray
             ) -> tuple[Inside, np.ndarray]:
    """Return Gaussians that are as wide as products around positions [T, 3] [m], and `beyond`.

    In (r, u, v) of the first surface, the sheets of the others are curved. Over the Gaussian, they
    are thicker by the second differences of their coordinates. The first Gaussian is that of the
    first sheet. The product with the others may be much smaller. Over its Gaussian, sheets bend
    less. A sheet may meet that of the first surface again, `beyond` a place where both are apart,
    [T, 3] [m]; NaN where none does.
    """
    (pose, first), *others = terms
    prior, centre = prior_information(bounds_m), bounds_m.mean(axis=0)
    positions, beyond = _on_line(terms[0], np.clip(positions, *bounds_m), bounds_m)
    points = to_polar(pose.to_surface(positions))
    by_point = pose.rotation @ jacobian(points)
    # The centre and the width of the sheet in the region.
    by_site = by_point.swapaxes(1, 2) @ prior
    total = symmetric(first.curvature + by_site @ by_point)
    step = step_to_maximum(total, (by_site @ (centre - positions)[..., None])[..., 0])
    for number in range(_LIMITS.passes):
        positions = np.clip(pose.to_site(to_positions(points + step)), *bounds_m)
        points = to_polar(pose.to_surface(positions))
        by_point = pose.rotation @ jacobian(points)
        axes = _LIMITS.step * np.linalg.cholesky(np.linalg.inv(total)).swapaxes(1, 2)
        around = pose.to_site(to_positions(
            points[:, None] + np.concatenate([axes, -axes], axis=1)))
        curvature = first.curvature
        gradient = (curvature @ (first.points - points)[..., None])[..., 0]
        for other, rows in others:
            here = to_polar(other.to_surface(positions))
            change = to_polar(other.to_surface(around)) - here[:, None]
            second = (change[:, :3] + change[:, 3:]) / _LIMITS.step**2
            if not number:
                slopes = (change[:, :3, 0] - change[:, 3:, 0]) / (2 * _LIMITS.step)
                turns, chosen = _turns(slopes, second[:, :, 0], rows)
                places = pose.to_site(to_positions(
                    points + axes[chosen] * turns[:, None] / _LIMITS.step))
                nearest = np.clip(places, *bounds_m)
                found = (np.linalg.norm(nearest - positions, axis=1)
                         > _LIMITS.within * np.linalg.norm(places - positions, axis=1))
                beyond[found] = nearest[found]
            thicker = _LIMITS.tails**2 * (
                np.sum(second**2, axis=1) / 2 + np.sum(second, axis=1)**2 / 4)
            information = rows.is_sheet[:, None, None] * np.linalg.inv(
                rows.covariances + thicker[:, :, None] * np.eye(3))
            slope = polar_derivative(here) @ other.rotation.T @ by_point
            by_slope = slope.swapaxes(1, 2) @ information
            curvature = curvature + by_slope @ slope
            gradient = gradient + (by_slope @ (rows.points - here)[..., None])[..., 0]
        before = total.diagonal(axis1=1, axis2=2)
        total = symmetric(curvature + by_point.swapaxes(1, 2) @ prior @ by_point)
        if np.all(total.diagonal(axis1=1, axis2=2) <= _LIMITS.settled * before):
            break
        step = step_to_maximum(total, gradient)
    wide = 1 / _LIMITS.spread**2
    return Inside.of(
        points, wide * gradient, wide * symmetric(curvature), bounds_m, pose), beyond


def _on_line(term: Term, positions: np.ndarray, bounds_m: np.ndarray
             ) -> tuple[np.ndarray, np.ndarray]:
    """Move positions [T, 3] [m] in a box that is a line to the sheet, which it meets twice.

    Returns them and the other places; NaN where these are outside of the box, or if it is no line.
    """
    others = np.full_like(positions, np.nan)
    (free,) = np.nonzero((bounds_m[1] > bounds_m[0]).any(axis=0))
    if len(free) == 1:
        sight = positions - term.pose.origin
        along_m2 = term.rows.points[:, 0]**2 - np.sum(np.delete(sight, free, axis=1)**2, axis=1)
        along_m = np.copysign(np.sqrt(np.maximum(along_m2, 0.0))[:, None], sight[:, free])
        mirrored = positions.copy()
        positions[:, free], mirrored[:, free] = term.pose.origin[free] + [along_m, -along_m]
        found = np.all((mirrored >= bounds_m[0]) & (mirrored <= bounds_m[1]), axis=1)
        others[found] = mirrored[found]
    return positions, others


def _turns(slopes: np.ndarray, second: np.ndarray, rows: Rows
           ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the farthest places at which ranges are the same again, [T], and their axes.

    Takes the derivatives of the ranges along the axes of the first sheet, [T, 3]. Places are in
    standard deviations of it; NaN if the sheet does not leave that of `rows` in between.
    """
    turns = -2 * slopes / np.where(second == 0, np.inf, second)
    apart = np.abs(slopes * turns) / 4 / np.sqrt(rows.covariances[:, :1, 0])
    apart[(np.abs(turns) > _LIMITS.reach) | ~rows.is_sheet[:, None]] = 0.0
    chosen = np.arange(len(turns)), np.argmax(apart, axis=1)
    return np.where(apart[chosen] > _LIMITS.apart, turns[chosen], np.nan), chosen
