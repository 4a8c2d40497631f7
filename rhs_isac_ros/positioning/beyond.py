"""The evidence of several surfaces for a user outside of the region of a site.

For each surface, the likelihood of a position outside is a sum of Gaussians and a constant, like
that of a position inside: see `Places`. The evidence is the average of the product of these sums
over one prior of the places outside, in front of all surfaces. So surfaces that see the user at
different places outside do not agree on a user outside. Of a surface that says no more than
whether the user is outside, the likelihood is a constant.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import log_size
from rhs_isac_ros.model.geometry import to_polar
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.positioning.estimate import Places, Sighting, regular
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.outside import farthest_range_m
from rhs_isac_ros.positioning.segments import concatenate, select
from rhs_isac_ros.positioning.sheets import Sheets
from rhs_isac_ros.positioning.templates import standard_normal

# Largest number of products, and decrease of the logarithm of their masses.
_PRODUCTS = 256
_MARGIN = 15.0
_SAMPLES = 16
# Numbers of ranges and directions of the points that represent a surface's prior.
_RANGES = 32
_DIRECTIONS = 64
# Smallest share of a likelihood that is a constant or beyond a region.
_LEAST = 1e-9
_AT_SURFACE = Pose()


def places_of(outside: Sheets, log_ratio: float, scenario: Scenario) -> Places:
    """Return the likelihood of places outside of the region of one surface.

    `outside` is the posterior of a user outside, in (r, u, v), whose mass is the share that it
    contains; `log_ratio` is the logarithm of the evidence outside relative to that inside.
    """
    pose, farthest_m = scenario.pose, farthest_range_m(scenario)
    places, own = outside.to_mixture(pose), _Prior.over((_AT_SURFACE, farthest_m),
                                                        bounds_m=scenario.roi_bounds_m)
    log_prior = _log_prior(places.means, pose, farthest_m) - _log_mass(own)
    known = np.isfinite(log_prior)
    log_rest = log_ratio + float(np.log(max(
        1 - np.exp(places.log_weights[known]).sum(), _LEAST)))
    return Places(
        select(places.weighted(log_ratio - np.where(known, log_prior, 0.0)), known), log_rest,
        farthest_m, log_size(scenario.roi_bounds_m))


def log_evidence(sightings: Sequence[Sighting], log_shares: Sequence[float],
                 bounds_m: np.ndarray) -> float:
    """Return the logarithm of the evidence outside, relative to the averages inside.

    The region has the bounds [2, 3] [m]. `log_shares` are the logarithms of the probability of the
    smallest box around it, among positions in the region of each surface.
    """
    factors = [_factor(one, log_share, bounds_m)
               for one, log_share in zip(sightings, log_shares, strict=True)]
    product = functools.reduce(_times, factors)
    constant = float(product.log_constant)
    if not len(product.rows.means):
        return constant
    positions = _samples(product.rows)
    prior = _Prior.over(*((one.pose, one.places.farthest_m) for one in sightings if one.places),
                        bounds_m=bounds_m)
    logs = prior.log_density(positions)
    total = np.logaddexp.reduce(
        (product.rows.log_weights[:, None] + logs).ravel()) - np.log(_SAMPLES)
    return float(np.logaddexp(constant, total))


class _Factor(NamedTuple):
    """Gaussians, maybe none, and a constant."""

    rows: Mixture
    log_constant: float


def _factor(sighting: Sighting, log_share: float, bounds_m: np.ndarray) -> _Factor:
    """Return the likelihood outside; the user may also be missing."""
    places, log_seen = sighting.places, float(np.log1p(-sighting.missing))
    rows = Mixture._make((np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3))))
    if places is None:
        # Or in the part of the region of the surface that is not around that of the site.
        log_rest = float(np.logaddexp(np.nan_to_num(sighting.outside_log_ratio), np.log(
            max(-np.expm1(log_share), _LEAST))))
    else:
        inside = sighting.mixture.position().normalised().weighted(places.log_volume)
        log_rest, found = places.log_rest, concatenate(inside, places.gaussians)
        found = found.widened(sighting.pose.spread(found.means))
        rows = select(found, _is_outside(_samples(found), bounds_m).any(axis=1)).weighted(log_seen)
    return _Factor(rows, float(np.logaddexp(np.log(sighting.missing), log_seen + log_rest)))


def _times(one: _Factor, other: _Factor) -> _Factor:
    """Multiply two likelihoods; keep the heaviest products."""
    parts = [one.rows.weighted(other.log_constant), other.rows.weighted(one.log_constant)]
    if len(one.rows.means) and len(other.rows.means):
        first, second = one.rows.heaviest_pairs(other.rows, _PRODUCTS, _MARGIN)
        parts.append(select(one.rows, first).updated(select(other.rows, second)))
    rows = concatenate(*parts)
    heaviest = np.argsort(-rows.log_weights, kind='stable')[:_PRODUCTS]
    return _Factor(select(rows, heaviest), one.log_constant + other.log_constant)


def _samples(mixture: Mixture) -> np.ndarray:
    """Return positions of each of C components, float64 [C, S, 3] [m]."""
    roots = np.linalg.cholesky(regular(mixture.covariances))
    return mixture.means[:, None] + np.matmul(
        standard_normal(_SAMPLES), np.swapaxes(roots, 1, 2))


def _is_outside(positions: np.ndarray, bounds_m: np.ndarray) -> np.ndarray:
    """Mark positions [..., 3] outside of a box, bool [...]."""
    return ((positions < bounds_m[0]) | (positions > bounds_m[1])).any(axis=-1)


class _Prior(NamedTuple):
    """The mean of the priors of surfaces, where all of them may see the user.

    As a user inside, a user outside is in front of all surfaces.
    """

    surfaces: tuple[tuple[Pose, float], ...]  # Poses and largest ranges [m].
    corners_m: tuple[float, ...]  # Bounds of the region.

    @classmethod
    def over(cls, *surfaces: tuple[Pose, float], bounds_m: np.ndarray) -> '_Prior':
        """Take poses and largest ranges, and the bounds of the region, [2, 3] [m]."""
        return cls(surfaces, tuple(bounds_m.ravel().tolist()))

    def log_density(self, positions: np.ndarray) -> np.ndarray:
        """Evaluate the logarithm of the density at positions [..., 3] outside of the region."""
        return self._log_mean(positions) - _log_mass(self)

    def _log_mean(self, positions: np.ndarray) -> np.ndarray:
        logs = np.array([_log_prior(positions, *one) for one in self.surfaces])
        is_outside = _is_outside(positions, np.reshape(self.corners_m, (2, 3)))
        return np.where(np.isfinite(logs).all(axis=0) & is_outside, np.logaddexp.reduce(
            logs, axis=0) - np.log(len(logs)), -np.inf)


@functools.lru_cache
def _log_mass(prior: _Prior) -> float:
    """Return the logarithm of the mass of a prior before it is normalised."""
    sight = standard_normal(_DIRECTIONS) * 1.0
    sight[:, 0] = np.abs(sight[:, 0])
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    shares = (np.arange(_RANGES) + 0.5) / _RANGES
    seen = [np.isfinite(prior._log_mean(pose.to_site(farthest_m * shares[:, None, None] * sight)))
            for pose, farthest_m in prior.surfaces]
    return float(np.log(max(np.mean(seen), _LEAST)))


def _log_prior(positions: np.ndarray, pose: Pose, farthest_m: float) -> np.ndarray:
    """Return the logarithm of a density uniform in range and solid angle in front of a surface."""
    local = pose.to_surface(positions)
    range_m = np.maximum(to_polar(local)[..., 0], np.finfo(float).tiny)
    return np.where((local[..., 0] > 0) & (range_m < farthest_m),
                    -np.log(2 * np.pi * farthest_m) - 2 * np.log(range_m), -np.inf)
