"""Products of curved sheets, each around another surface, and Gaussians that are as wide.

A sheet is a Gaussian in range and direction cosines of its surface. Around each place, the
logarithm of a product has a gradient and a curvature. Two sheets of opposite curvature that touch
have a product along a rim, which may be far from the maximum. A Gaussian is thus as wide as if the
other sheets were thicker by what they bend over it. Three thin sheets meet in a point, over which
none of them bends. Sheets may meet at several places, such as two circles in a plane; ascents from
all over the first sheet find those that a Gaussian does not contain.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.gaussian import step_to_maximum, symmetric
from rhs_isac_ros.model.geometry import jacobian, polar_derivative, to_polar, to_positions
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.sheets import Inside, log_values
from rhs_isac_ros.positioning.templates import standard_normal

# Factor by which samples are wider than a Gaussian.
_SPREAD = 1.2
# Smallest extent of the region along an axis, relative to the largest one.
_EXTENT = 1e-3
# Step of second differences in standard deviations of a Gaussian, and factor by which sheets are
# thicker, as they bend more in the tails.
_STEP = 1.5
_TAILS = 3.0
# Greatest number of Gaussians, over each of which sheets bend anew, and largest increase of the
# information after which there is no further one.
_PASSES = 5
_SETTLED = 1.5
# Sheets may meet again if one slopes over the standard deviations of another by less than this
# many times what they bend.
_REACH = 6.0
# Number of ascents from the first sheet, which is wider by a factor, and their steps.
_STARTS = 16
_WIDER = 1.7
_STEPS = 4
# Logarithms: smallest excess of a weight over those of all samples, and largest decrease of the
# product, at a place that samples miss.
_EXCESS = 1.0
_DECREASE = 8.0


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
    smallest = _EXTENT * size.max(axis=-1, keepdims=True)
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


def proposal(terms: Sequence[Term], positions: np.ndarray, bounds_m: np.ndarray) -> Inside:
    """Return Gaussians that are as wide as products around positions [T, 3] [m].

    In (r, u, v) of the first surface, the sheets of the others are curved. Over the Gaussian, they
    are thicker by the second differences of their coordinates. The first Gaussian is that of the
    first sheet. The product with the others may be much smaller. Over its Gaussian, sheets bend
    less.
    """
    (pose, first), *others = terms
    prior, centre = prior_information(bounds_m), bounds_m.mean(axis=0)
    positions = np.clip(positions, *bounds_m)
    points = to_polar(pose.to_surface(positions))
    by_point = pose.rotation @ jacobian(points)
    # The centre and the width of the sheet in the region.
    by_site = by_point.swapaxes(1, 2) @ prior
    total = symmetric(first.curvature + by_site @ by_point)
    step = step_to_maximum(total, (by_site @ (centre - positions)[..., None])[..., 0])
    for _ in range(_PASSES):
        positions = np.clip(pose.to_site(to_positions(points + step)), *bounds_m)
        points = to_polar(pose.to_surface(positions))
        by_point = pose.rotation @ jacobian(points)
        axes = _STEP * np.linalg.cholesky(np.linalg.inv(total)).swapaxes(1, 2)
        around = pose.to_site(to_positions(
            points[:, None] + np.concatenate([axes, -axes], axis=1)))
        curvature = first.curvature
        gradient = (curvature @ (first.points - points)[..., None])[..., 0]
        for other, rows in others:
            here = to_polar(other.to_surface(positions))
            change = to_polar(other.to_surface(around)) - here[:, None]
            second = (change[:, :3] + change[:, 3:]) / _STEP**2
            thicker = _TAILS**2 * (
                np.sum(second**2, axis=1) / 2 + np.sum(second, axis=1)**2 / 4)
            information = rows.is_sheet[:, None, None] * np.linalg.inv(
                rows.covariances + thicker[:, :, None] * np.eye(3))
            slope = polar_derivative(here) @ other.rotation.T @ by_point
            by_slope = slope.swapaxes(1, 2) @ information
            curvature = curvature + by_slope @ slope
            gradient = gradient + (by_slope @ (rows.points - here)[..., None])[..., 0]
        before = total.diagonal(axis1=1, axis2=2)
        total = symmetric(curvature + by_point.swapaxes(1, 2) @ prior @ by_point)
        if np.all(total.diagonal(axis1=1, axis2=2) <= _SETTLED * before):
            break
        step = step_to_maximum(total, gradient)
    wide = 1 / _SPREAD**2
    return Inside.of(points, wide * gradient, wide * symmetric(curvature), bounds_m, pose)


def may_meet_again(terms: Sequence[Term], gaussians: Inside, bounds_m: np.ndarray) -> np.ndarray:
    """Mark products whose sheets may also meet elsewhere in the boxes, bool [T]."""
    (pose, first), *others = terms
    points = gaussians.points
    positions, by_point = pose.to_site(to_positions(points)), pose.rotation @ jacobian(points)
    prior = prior_information(bounds_m)
    total = first.curvature + by_point.swapaxes(1, 2) @ prior @ by_point
    roots = by_point[:, :, 1:] @ np.linalg.cholesky(np.linalg.inv(total)[:, 1:, 1:])
    width_m2, found = np.sum(roots**2, axis=(1, 2)), np.zeros(len(points), bool)
    for other, rows in others:
        sight = positions - other.origin
        range_m = np.linalg.norm(sight, axis=1)
        slope_m = np.linalg.norm((sight[:, None] @ roots)[:, 0], axis=1) / range_m
        bend_m = width_m2 * (1 / points[:, 0] + 1 / range_m)
        found |= rows.is_sheet & (slope_m < _REACH * bend_m)
    return found


def elsewhere(terms: Sequence[Term], gaussians: Inside, log_weights: np.ndarray,
              bounds_m: np.ndarray) -> np.ndarray:
    """Return places in boxes that samples of Gaussians miss, float64 [T, 3] [m]; NaN if none.

    There, the product is not much smaller than at the best place, and a sample would weigh more
    than all S samples, which have the given weights, [T, S]. Ascents start at places all over the
    first sheet.
    """
    pose, rows = terms[0].pose, terms[0].rows
    near, curvature = gaussians.points, rows.curvature / _WIDER**2
    gradient = (curvature @ (rows.points - near)[..., None])[..., 0]
    starts, _ = Inside.of(near, gradient, curvature, bounds_m, pose).sample(
        standard_normal(_STARTS))
    each = np.repeat(np.arange(len(starts)), _STARTS)
    repeated = [Term(one.pose, select(one.rows, each)) for one in terms]
    boxes = bounds_m[:, each]
    prior, path = prior_information(boxes), [starts.reshape(-1, 3)]
    for _ in range(_STEPS):
        points, gradient, total = expanded(repeated, path[-1], prior)
        path.append(np.clip(pose.to_site(to_positions(
            points + step_to_maximum(total, gradient))), *boxes))
    places = np.concatenate([one.reshape(starts.shape) for one in path], axis=1)
    values = logarithm(terms, places)
    excess = values + gaussians.log_ratio(places) - log_weights.max(axis=1, keepdims=True)
    excess[values < values.max(axis=1, keepdims=True) - _DECREASE] = -np.inf
    chosen = np.arange(len(places)), np.argmax(excess, axis=1)
    return np.where((excess[chosen] > _EXCESS)[:, None], places[chosen], np.nan)
