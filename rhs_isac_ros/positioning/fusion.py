"""The position of a user from the signals of several surfaces of a site.

For each surface, the likelihood of a position is a mixture, widened by the uncertainty of the pose
of the surface. The posterior is the product of these mixtures. Each of its components is the
product of one component of every surface.

A component is a sheet around its surface, a fraction of a wavelength thick and metres wide. As a
Gaussian in x, y and z it would be flat, and the product of two sheets would be at a wrong place.
Components are therefore Gaussian in range and direction cosines of their own surface. The maximum
of a product is found by Gauss-Newton steps on the sum of the quadratic forms, and samples around
it yield the moments in the region.

To each mixture, a constant is added: the user may be blocked from the surface, the search may have
missed a mode, or the surface may be elsewhere. A surface that disagrees with the others thus makes
the posterior broader.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import log_sum, mixture_weights, untied
from rhs_isac_ros.model.gaussian import likelihood_loss, moments, step_to_maximum, symmetric
from rhs_isac_ros.model.geometry import (
    jacobian,
    polar_derivative,
    to_polar,
    to_positions,
)
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.positioning.estimate import regular
from rhs_isac_ros.positioning.mixture import Mixture, log_volume
from rhs_isac_ros.positioning.posterior import Posterior
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.templates import standard_normal
from rhs_isac_ros.support.threads import one_blas_thread

# Number of modes of each surface that are used.
MAX_MODES = 32


class _Limits(NamedTuple):
    """Numbers that trade the speed of a product for its accuracy."""

    # Gauss-Newton steps of every product, then further steps of those that are kept. A first step
    # from one sheet to another one that is nearly parallel may be far too long.
    steps: tuple[int, int] = (2, 3)
    # After each of the two, products with a log-weight below the best by more than this are
    # discarded, and so are the lightest ones beyond a number.
    margins: tuple[float, float] = (40.0, 12.0)
    products: tuple[int, int] = (400, 64)
    # Number of samples of a product, and factor by which they are wider than its Gaussian. Two
    # sheets that touch have a product with more weight at its borders.
    samples: int = 128
    spread: float = 1.2
    # Information of a uniform prior in the region that narrows their Gaussian, as a share of it.
    narrowing: float = 0.25
    # Information of a prior that keeps matrices invertible, relative to a uniform one in the
    # region, and smallest extent of the region along an axis [m].
    floor: float = 1e-3
    extent_m: float = 0.01
    # Smallest cosine of the angle between boresight and the maximum of a mode, and largest change
    # of the range from the mode's point to its maximum, as a share.
    cosine: float = 0.05
    change: float = 0.5


_LIMITS = _Limits()
# Probability that a mixture does not contain the position of a user in sight.
_MISS_PROBABILITY = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Sighting:
    """The likelihood of positions for the signals of one surface."""

    pose: Pose
    mixture: Mixture  #: D = 3, in the frame of the site, as if the pose were exact.
    #: Probability that the mixture does not contain the position of the user.
    missing: float = _MISS_PROBABILITY

    @classmethod
    def of(cls, posterior: Posterior, pose: Pose) -> 'Sighting | None':
        """Return the likelihood for the signals of one shot; None without a position.

        The modes become Gaussians, which extend beyond the region.
        """
        if posterior.modes is None:
            return None
        modes = select(posterior.modes, slice(MAX_MODES))
        points = modes.centres
        # The maximum of a mode on the border of the region may be far outside.
        valid = np.sum(points[:, 1:]**2, axis=1) < 1 - _LIMITS.cosine**2
        valid &= np.abs(points[:, 0] / modes.points[:, 0] - 1) < _LIMITS.change
        points = np.where(valid[:, None], points, modes.points)
        rise = np.sum(modes.gradient * (points - modes.points), axis=1) / 2
        by_point = jacobian(points)
        covariances = symmetric(
            by_point @ np.linalg.inv(modes.curvature) @ np.swapaxes(by_point, 1, 2))
        mixture = Mixture(
            modes.log_likelihood + rise + log_volume(covariances),
            pose.to_site(to_positions(points)), pose.covariances_to_site(covariances))
        blocked = float(np.nan_to_num(posterior.estimate.blocked_probability))
        return cls(pose, mixture, blocked + (1 - blocked) * _MISS_PROBABILITY)


class Fused(NamedTuple):
    """The posterior of a position, for a uniform prior on the region."""

    mixture: Mixture  #: Normalised, in the frame of the site.
    #: Logarithm of the density of the signals of all surfaces for one user, relative to that for
    #: a different user at each surface.
    log_agreement: float


def fuse(sightings: Sequence[Sighting], bounds_m: np.ndarray) -> Fused:
    """Multiply the likelihoods of the surfaces, for a user between the bounds of the region.

    The bounds, float64 [2, 3] [m], are in the frame of the site. Raises ValueError without
    sightings, or if a mixture has no finite density.
    """
    return Fuser(bounds_m).fuse(sightings)


class Fuser:
    """Products of the sightings of one user, each of which is computed once.

    The products of sightings that begin in the same way share their first factors.
    """

    def __init__(self, bounds_m: np.ndarray) -> None:
        """Take the bounds of the region in the frame of the site, float64 [2, 3] [m]."""
        extent = np.maximum(np.ptp(bounds_m, axis=0), _LIMITS.extent_m)
        self._bounds_m = bounds_m.mean(axis=0) + np.outer([-0.5, 0.5], extent)
        self._log_volume = float(np.log(extent).sum())
        self._sheets = functools.cache(lambda one: _Sheets.of(one, self._bounds_m))
        self._product = functools.cache(self._multiply)
        self._fused = functools.cache(self._locate)

    @one_blas_thread
    def fuse(self, sightings: Sequence[Sighting]) -> Fused:
        """Multiply likelihoods; see the function `fuse`."""
        if not sightings:
            raise ValueError('sightings: none, expected at least one')
        return self._fused(tuple(sightings))

    def _multiply(self, sightings: tuple[Sighting, ...]) -> '_Products':
        sheets = [self._sheets(one) for one in sightings]
        if len(sheets) == 1:
            return _Products.of(sheets[0]).climb(sheets, self._bounds_m, 1)
        return self._product(sightings[:-1]).extended(sheets, self._bounds_m)

    def _locate(self, sightings: tuple[Sighting, ...]) -> Fused:
        sheets, products = [self._sheets(one) for one in sightings], self._product(sightings)
        # At least one surface sees the user.
        products = select(products, ~products.are_constant(sheets))
        mixture = products.restricted(sheets, self._bounds_m)
        return Fused(mixture.normalised().reduce(),
                     mixture.log_mass + (len(sheets) - 1) * self._log_volume)


class _Sheets(NamedTuple):
    """The likelihood of one surface: C Gaussians around it, the last of which is constant."""

    pose: Pose
    points: np.ndarray  # (r [m], u, v), float64 [C, 3].
    curvature: np.ndarray  # Float64 [C, 3, 3].
    log_peaks: np.ndarray  # Logarithms of the maxima, float64 [C].
    best_m: np.ndarray  # Most likely positions in the region, float64 [C, 3] [m].

    @classmethod
    def of(cls, sighting: Sighting, bounds_m: np.ndarray) -> '_Sheets':
        """Bend and widen a mixture, so that its mass in the region, with the constant, is 1."""
        pose, mixture = sighting.pose, sighting.mixture
        mixture = mixture.widened(pose.spread(mixture.means))
        points = to_polar(pose.to_surface(mixture.means))
        by_point = pose.rotation @ jacobian(points)
        curvature = (np.swapaxes(by_point, 1, 2)
                     @ np.linalg.solve(mixture.covariances, by_point))
        sheets = cls(pose, points, symmetric(curvature), mixture.log_peaks, mixture.means)
        found = _Products.of(sheets).climb([sheets], bounds_m, _LIMITS.steps[1])
        log_total = log_sum(found.log_weights) - np.log1p(-sighting.missing)
        log_constant = np.log(sighting.missing) - np.log(np.ptp(bounds_m, axis=0)).sum()
        return cls(
            pose, np.append(points, points[:1], axis=0),
            np.append(sheets.curvature, np.zeros((1, 3, 3)), axis=0),
            np.append(mixture.log_peaks - log_total, log_constant),
            np.append(found.positions, bounds_m.mean(axis=0)[None], axis=0))

    def logarithm(self, rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Evaluate components `rows` [T] at positions [T, S, 3] [m], float64 [T, S]."""
        local, curvature = self.pose.to_surface(positions), self.curvature[rows]
        offsets = to_polar(local) - self.points[rows, None]
        values = self.log_peaks[rows, None] - np.sum(
            np.matmul(offsets, curvature) * offsets, axis=-1) / 2
        # No user behind the surface is in sight.
        behind = (local[..., 0] <= 0) & curvature.any(axis=(1, 2))[:, None]
        return np.where(behind, -np.inf, values)

    def expanded(self, rows: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return value [T], gradient [T, 3] and curvature [T, 3, 3] at positions [T, 3] [m]."""
        points = to_polar(self.pose.to_surface(positions))
        derivative = polar_derivative(points) @ self.pose.rotation.T
        offsets, curvature = points - self.points[rows], self.curvature[rows]
        slope = np.matmul(np.swapaxes(derivative, 1, 2), curvature)
        return (self.log_peaks[rows] - likelihood_loss(offsets, curvature),
                -np.matmul(slope, offsets[..., None])[..., 0], np.matmul(slope, derivative))


class _Products(NamedTuple):
    """T products, each of one component of every surface so far."""

    rows: np.ndarray  # Components, int [T, number of surfaces].
    positions: np.ndarray  # Maxima in the region, float64 [T, 3] [m].
    curvature: np.ndarray  # Float64 [T, 3, 3] [1/m^2].
    log_peaks: np.ndarray  # Float64 [T].

    @classmethod
    def of(cls, sheets: _Sheets) -> '_Products':
        """Return the components of one surface; `climb` computes curvatures and peaks."""
        n = len(sheets.points)
        return cls(np.arange(n)[:, None], sheets.best_m, np.zeros((n, 3, 3)), np.zeros(n))

    def extended(self, sheets: Sequence[_Sheets], bounds_m: np.ndarray) -> '_Products':
        """Multiply each product by each component of the last surface; keep the heaviest."""
        constant = len(sheets[-1].points) - 1
        first, last = np.divmod(np.arange(len(self.rows) * (constant + 1)), constant + 1)
        found = select(self, first)._replace(
            rows=np.concatenate([self.rows[first], last[:, None]], axis=1))
        # If everything else is constant, start from the only component that is not.
        alone = self.are_constant(sheets)[first, None]
        found = found._replace(
            positions=np.where(alone, sheets[-1].best_m[last], found.positions))
        for stage in zip(_LIMITS.steps, _LIMITS.margins, _LIMITS.products, strict=True):
            found = found.climb(sheets, bounds_m, stage[0])
            found = found.heaviest(*stage[1:], found.are_constant(sheets))
        return found

    def climb(self, sheets: Sequence[_Sheets], bounds_m: np.ndarray, n_steps: int
              ) -> '_Products':
        """Move towards the maxima in the region by Gauss-Newton steps."""
        positions = np.clip(self.positions, *bounds_m)
        for _ in range(n_steps):
            parts = zip(*(one.expanded(rows, positions)
                          for one, rows in zip(sheets, self.rows.T, strict=True)), strict=True)
            value, gradient, curvature = (np.sum(part, axis=0) for part in parts)
            curvature += _region_information(bounds_m)
            step = _step_inside(positions, gradient, curvature, bounds_m)
            positions = positions + step
            value = value + np.sum(step * gradient, axis=1) - likelihood_loss(step, curvature)
        return self._replace(positions=positions, curvature=curvature, log_peaks=value)

    def are_constant(self, sheets: Sequence[_Sheets]) -> np.ndarray:
        """Mark the products of constants alone, bool [T]."""
        n_surfaces = self.rows.shape[1]
        last = [len(one.points) - 1 for one in sheets[:n_surfaces]]
        constant: np.ndarray = (self.rows == last).all(axis=1)
        return constant

    @property
    def log_weights(self) -> np.ndarray:
        """Logarithms of the masses, float64 [T]."""
        return self.log_peaks + log_volume(np.linalg.inv(self.curvature))

    def heaviest(self, margin: float, number: int, constant: np.ndarray) -> '_Products':
        """Return the heaviest products, at least one of which is not constant.

        `constant`, bool [T], marks the constant ones. Raises ValueError if no other is finite.
        """
        log_weights = self.log_weights
        order = np.argsort(-log_weights, kind='stable')
        best = log_weights[order[~constant[order]][0]]
        if not np.isfinite(best):
            raise ValueError('sightings: no finite product, expected mixtures in front of their '
                             'surfaces')
        order = order[:number]
        return select(self, order[log_weights[order] >= best - margin])

    def restricted(self, sheets: Sequence[_Sheets], bounds_m: np.ndarray) -> Mixture:
        """Return the mixture of the products inside the bounds, with the moments of samples."""
        normal = standard_normal(_LIMITS.samples)
        information = self.curvature + _region_information(bounds_m, _LIMITS.narrowing)
        covariances = _LIMITS.spread**2 * np.linalg.inv(information)
        roots = np.linalg.cholesky(covariances)
        positions, log_density = self._bent(
            np.matmul(normal, np.swapaxes(roots, 1, 2)), sheets)
        log_density -= np.sum(normal**2, axis=1) / 2 + log_volume(covariances)[:, None]
        logs = sum(one.logarithm(rows, positions)
                   for one, rows in zip(sheets, self.rows.T, strict=True)) - log_density
        inside = ((positions >= bounds_m[0]) & (positions <= bounds_m[1])).all(axis=-1)
        inside &= np.isfinite(logs)
        if inside.any():
            logs = np.where(inside, logs, -np.inf)
        else:
            positions = np.clip(positions, *bounds_m)
        chosen = np.isfinite(logs).any(axis=1)
        weights, log_totals = mixture_weights(logs[chosen])
        means, covariances = moments(weights, positions[chosen])
        return Mixture(log_totals - np.log(len(normal)), means, regular(covariances))

    def _bent(self, offsets: np.ndarray, sheets: Sequence[_Sheets]
              ) -> tuple[np.ndarray, np.ndarray]:
        """Bend offsets [T, S, 3] [m] around the surface with the thinnest component.

        Returns positions [T, S, 3] [m], and the logarithm of the factor by which their density
        differs from that of the offsets, [T, S].
        """
        curvature = np.stack([one.curvature[rows, 0, 0] for one, rows in zip(
            sheets, self.rows.T, strict=True)], axis=1)
        thinnest = np.argmin(untied(-curvature), axis=1)
        positions, log_factor = np.empty_like(offsets), np.empty(offsets.shape[:2])
        for number, one in enumerate(sheets):
            (mine,) = np.nonzero(thinnest == number)
            start = to_polar(one.pose.to_surface(self.positions[mine]))
            derivative = polar_derivative(start) @ one.pose.rotation.T
            points = start[:, None] + np.matmul(offsets[mine], np.swapaxes(derivative, 1, 2))
            positions[mine] = one.pose.to_site(to_positions(points))
            # The volume element of (r, u, v) is r^2 / w.
            cosines = np.maximum(1 - np.sum(points[..., 1:]**2, axis=-1), 1e-9)
            log_factor[mine] = np.log(cosines) / 2 - 2 * np.log(points[..., 0]) - (
                np.linalg.slogdet(derivative)[1][:, None])
        return positions, log_factor


def _step_inside(positions: np.ndarray, gradient: np.ndarray, curvature: np.ndarray,
                 bounds_m: np.ndarray) -> np.ndarray:
    """Return the steps to the maxima between the bounds, float64 [T, 3] [m]."""
    low, high = bounds_m[:, None] - positions
    fixed, values = np.zeros(positions.shape, bool), np.zeros(positions.shape)
    for _ in range(3):
        pull = gradient - np.matmul(curvature, values[..., None])[..., 0]
        matrix = np.where(fixed[:, :, None] | fixed[:, None], np.eye(3), curvature)
        step = step_to_maximum(matrix, np.where(fixed, values, pull))
        limited = np.clip(step, low, high)
        # A coordinate that would leave the region stays at its limit.
        beyond = ~fixed & (limited != step)
        if not beyond.any():
            break
        fixed |= beyond
        values = np.where(beyond, limited, values)
    return limited


def _region_information(bounds_m: np.ndarray, share: float = _LIMITS.floor) -> np.ndarray:
    """Return a share of the information of a uniform prior, float64 [3, 3] [1/m^2]."""
    return np.diag(12 * share / np.ptp(bounds_m, axis=0)**2)
