"""The position of a user from the signals of several surfaces of a site.

For each surface, the likelihood of a position is a sum of sheets, widened by the uncertainty of
the pose of the surface. The posterior is the product of these sums. Each of its components is the
product of one sheet of every surface.

The maximum of a product is found by a Gauss-Newton step from that of the sheets' moments. Weighted
samples around it, in range and direction cosines of the surface with the thinnest sheet, yield the
moments in the region; see `products`. Where few of them carry the weight, or where they miss a
part of the product, the region is halved, and each half has a proposal of its own.

To each likelihood, a constant is added: the user may be blocked from the surface, the search may
have missed a mode, or the surface may be elsewhere. A surface that disagrees with the others thus
makes the posterior broader. All masses are averages over the region, in all of its dimensions.

All surfaces together decide whether a user is outside of the region. The product for a user inside
is compared with that for a user outside; see `beyond`. A surface may see the user beyond its own
region, or in the part of it that is outside of the region of the site.
"""

import functools
import statistics
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import checked_bounds, log_sum, mixture_weights
from rhs_isac_ros.model.gaussian import likelihood_loss, moments, step_to_maximum, symmetric
from rhs_isac_ros.model.geometry import polar_derivative, to_positions
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.positioning.alternatives import Outside, log_odds_of, rejection
from rhs_isac_ros.positioning.beyond import log_evidence
from rhs_isac_ros.positioning.estimate import SITE, Estimate, Sighting, regular
from rhs_isac_ros.positioning.mixture import Mixture, log_volume, velocity_variance
from rhs_isac_ros.positioning.products import (
    Rows,
    Term,
    elsewhere,
    expanded,
    logarithm,
    may_meet_again,
    prior_information,
    proposal,
)
from rhs_isac_ros.positioning.segments import Segments, concatenate, select
from rhs_isac_ros.positioning.sheets import Inside, Sheets, move_inside
from rhs_isac_ros.positioning.templates import standard_normal
from rhs_isac_ros.support.recent import Recent
from rhs_isac_ros.support.threads import one_blas_thread

# Products whose log-weight is below the best by more than this, and any beyond a number, are
# discarded: by the overlap of their sheets' moments, and after a Gauss-Newton step. Equal
# products, such as those of sheets at regular distances, must not be discarded.
_MARGINS = 25.0, 12.0
_PRODUCTS = 4000
# Largest number of Gaussians of a posterior.
_COMPONENTS = 512
# Numbers of samples of a sheet, smallest and largest one of a part of a product, and number of all
# parts together that are computed at a time. All products have the same few points, so that their
# errors do not average out.
_OF_SHEET = 64
_OF_PRODUCT = 64, 256
_SAMPLES = 1 << 13
# Information of a uniform prior in the region that narrows Gaussians, as a share of it.
_NARROWING = 0.25
# Share of the samples that have to be effective in parts whose log-weight is within a margin of
# the best. Others are halved, this many at a time and so often.
_EFFECTIVE = 0.35
_MARGIN = 5.0
_PARTS = 32
_HALVINGS = 8
# Number of results of each kind that a `Fuser` keeps.
_KEPT = 256
# Largest share of a variance that is the same in all phases.
_CONSTANT = 0.98
# Logarithm of a likelihood of 0.
_NEVER = -1e9
# Logarithm of the largest value of sheets in the region, relative to their maxima, below which all
# of them are far from it.
_FAR = -12.0
# Largest logarithm of an average that is due to the tails of sheets alone.
_TAIL = -9.0
# Smallest logarithm of an average, relative to that of the constant.
_LEAST = -10.0
# Tolerance of the comparison of positions with a region [m].
_TOLERANCE_M = 1e-3
_AT_SURFACE = Pose()


def fuse(sightings: Sequence[Sighting], bounds_m: np.ndarray, outside_probability: float = 0.0,
         user_speed_std_mps: float = 0.0) -> Estimate:
    """Multiply the likelihoods of the surfaces, for a user between the bounds of the region.

    The bounds, float64 [2, 3] [m], and the result are in the frame of the site. The prior
    probability of a user outside of the region is from 0 to less than 1; with 0, users are inside.
    If `alternatives.rejection` refuses the posterior one, the result is a reason. Velocities have
    the given prior. Raises ValueError without sightings, or if one has no density in the region.
    """
    return Fuser(bounds_m, outside_probability, user_speed_std_mps).fuse(sightings)


class Fuser:
    """Products of the sightings of one user, each of which is computed once.

    The products of sightings that begin in the same way share their first factors.
    """

    def __init__(self, bounds_m: np.ndarray, outside_probability: float = 0.0,
                 user_speed_std_mps: float = 0.0) -> None:
        """Take the bounds of the region and what is known of users; see the function `fuse`."""
        bounds_m = checked_bounds(bounds_m)
        self._bounds_m, self._outside_probability = bounds_m, outside_probability
        self._velocity_variance = velocity_variance(user_speed_std_mps, bounds_m)
        self._factors = functools.partial(_Factor.of_each, bounds_m=bounds_m)
        self._factor = Recent(self._factor_of, _KEPT)
        self._product = Recent(self._multiply, _KEPT)
        self._fused = Recent(self._locate, _KEPT)

    @one_blas_thread
    def fuse(self, sightings: Sequence[Sighting]) -> Estimate:
        """Multiply likelihoods; see the function `fuse`."""
        if not sightings:
            raise ValueError('sightings: none, expected at least one')
        self._factor.keep(dict.fromkeys(sightings), self._factors)
        return self._fused(tuple(sightings))

    def _factor_of(self, sighting: Sighting) -> '_Factor':
        (factor,) = self._factors([sighting])
        return factor

    def _multiply(self, sightings: tuple[Sighting, ...]) -> '_Products':
        if len(sightings) == 1:
            return _Products.of(self._factor(sightings[0]))
        return self._product(sightings[:-1]).times(
            [self._factor(one) for one in sightings], self._bounds_m)

    def _locate(self, sightings: tuple[Sighting, ...]) -> Estimate:
        factors = [self._factor(one) for one in sightings]
        products = self._product(sightings).inside(factors, self._bounds_m)
        log_agreement = products.moments.log_mass
        common: dict[str, Any] = {'log_agreement': log_agreement, 'frame': SITE}
        log_ratios = np.array([one.outside_log_ratio for one in sightings])
        if self._outside_probability and not np.isnan(log_ratios).all():
            log_missing = np.log([one.missing for one in sightings])
            log_outside = log_evidence(
                sightings, [one.log_share for one in factors], self._bounds_m)
            # A user inside, too, may be seen by no surface.
            log_inside = np.logaddexp(log_agreement, log_missing.sum())
            probability = float(np.exp(-np.logaddexp(
                0.0, log_inside - log_outside - log_odds_of(self._outside_probability))))
            common['outside_probability'] = probability
            if reason := rejection(Outside, probability, 1 - probability):
                return Estimate.without_fix(reason, **common)
        return Estimate(*products.moments.moments(), density=functools.cache(functools.partial(
            products.mixture, factors)), **common).with_velocities(
                [one.mixture for one in sightings], self._velocity_variance)


def _smallest_box(bounds_m: np.ndarray, pose: Pose) -> np.ndarray:
    """Return the bounds of the smallest box in which a surface sees users of a region."""
    corners = pose.to_surface(np.stack(np.meshgrid(*bounds_m.T), axis=-1).reshape(-1, 3))
    return pose.seen(np.stack([corners.min(axis=0), corners.max(axis=0)]))


class _Factor(NamedTuple):
    """The likelihood of one surface: C sheets and, as the last row, a constant.

    Its average over the region of the surface, which contains that of the site, is 1.
    """

    pose: Pose
    rows: Rows
    moments: Mixture  # Averages and moments inside the region, in the frame of the site.
    # Logarithm of the surface's probability of the smallest box around the region of the site.
    log_share: float
    thickness: float  # Decreases with the median information about the range.

    @classmethod
    def of_each(cls, sightings: Sequence[Sighting], bounds_m: np.ndarray) -> list['_Factor']:
        """Return the factors of all surfaces.

        Each sheet is restricted to the region of the site, with the errors of the pose, and to
        that of its surface, without.
        """
        of_surface = [_smallest_box(bounds_m, one.pose) if one.region_m is None else one.region_m
                      for one in sightings]
        likelihoods = [one.likelihood for one in sightings]
        of_sighting = Segments.of_counts(np.array([len(one.means) for one in likelihoods]))
        n = int(of_sighting.counts.sum())
        boxes = np.concatenate([np.repeat(bounds_m[:, None], n, axis=1), np.stack(
            of_surface, axis=1).repeat(of_sighting.counts, axis=1)], axis=1)
        frames = concatenate(*(one.pose.frames(len(sheets.means)) for one, sheets in zip(
            sightings, likelihoods, strict=True)), _AT_SURFACE.frames(n))
        sheets = concatenate(*likelihoods, *likelihoods)
        points = move_inside(sheets.means, np.linalg.inv(sheets.covariances), boxes, frames)
        near = frames.to_site(to_positions(points))
        derivative = polar_derivative(points[:n]) @ frames.rotation[:n].swapaxes(1, 2)
        spread = np.concatenate([one.pose.spread(near[rows]) for one, rows in zip(
            sightings, of_sighting.slices, strict=True)])
        # This does not change the masses.
        sheets.covariances[:n] += symmetric(derivative @ spread @ derivative.swapaxes(1, 2))
        # A pose that is off moves a sheet away from a region without extent along an axis. The
        # likeliest point in it then depends on the errors of the pose.
        points[:n] = move_inside(
            sheets.means[:n], np.linalg.inv(sheets.covariances[:n]), boxes[:, :n],
            select(frames, slice(n)))
        near = frames.to_site(to_positions(points))
        gaussians = sheets.inside(boxes, frames, near)
        positions, log_ratio = gaussians.sample(standard_normal(_OF_SHEET))
        logs = gaussians.logarithm(positions) + log_ratio
        inside, _ = _moments(positions, logs)
        return [cls._of(
            one, bounds_m, points[rows], select(sheets, rows), select(inside, rows),
            log_sum(inside.log_weights[n:][rows]),
            _log_share(logs[n:][rows], positions[n:][rows], _smallest_box(bounds_m, one.pose)))
            for one, rows in zip(sightings, of_sighting.slices, strict=True)]

    @classmethod
    def _of(cls, sighting: Sighting, bounds_m: np.ndarray, points: np.ndarray, sheets: Sheets,
            inside: Mixture, log_mass: float, log_share: float) -> '_Factor':
        """Take sheets inside the region, and mass and share in the region of the surface."""
        pose, kept = sighting.pose, np.flatnonzero(_has_mass(inside))
        sheets, inside = select(sheets, kept), select(inside, kept)
        curvature = np.linalg.inv(sheets.covariances)
        heights = -likelihood_loss(points[kept] - sheets.means, curvature)
        centre, size = bounds_m.mean(axis=0), np.ptp(bounds_m, axis=0)
        # Without sheets, the region of the surface is not known. If a maximum is in that of the
        # site, it is taken to be the same.
        log_average = (inside.log_mass - log_mass) if sighting.sheets else float(heights.max())
        is_far = heights.max() < _FAR
        if is_far:
            log_average = min(log_average, _TAIL)
        # A product with the sheets remains if all of them are far from the region.
        log_average = max(log_average, float(np.log(sighting.missing)) + _LEAST)
        log_total = inside.log_mass - np.log1p(-sighting.missing) - log_average
        log_peaks, log_limit = sheets.log_peaks - log_total, np.inf
        if is_far:
            # Masses and maxima of tails are inaccurate, and must not exceed those of other sheets.
            log_peaks += log_average - heights.max() - log_peaks.max()
            log_limit = log_average
        return cls(
            pose, concatenate(
                Rows(sheets.means, sheets.covariances, curvature, log_peaks,
                     np.full(len(kept), log_limit), np.ones(len(kept), bool)),
                Rows(sheets.means[:1], np.eye(3)[None], np.zeros((1, 3, 3)),
                     np.log([sighting.missing]), np.full(1, np.inf), np.zeros(1, bool))),
            Mixture._make((
                np.append(inside.log_weights - log_total, np.log(sighting.missing)),
                np.append(inside.means, centre[None], axis=0),
                np.append(inside.covariances, regular(np.diag(size**2 / 12))[None], axis=0))),
            log_share if sighting.sheets else min(log_average, 0.0),
            -statistics.median([*curvature[:, 0, 0].tolist(), 0.0]))

    def term(self, chosen: np.ndarray) -> Term:
        """Return the rows with these indices, int [T], as factors of products."""
        return Term(self.pose, select(self.rows, chosen))


class _Products(NamedTuple):
    """T products, each of one row of every factor so far."""

    rows: np.ndarray  # Int [T, number of factors].
    # Averages over the region, maxima or means, and covariances, in the frame of the site.
    moments: Mixture

    @classmethod
    def of(cls, factor: _Factor) -> '_Products':
        """Return the rows of one factor."""
        return cls(np.arange(len(factor.rows.points))[:, None], factor.moments)

    def times(self, factors: Sequence[_Factor], bounds_m: np.ndarray) -> '_Products':
        """Multiply each product by each row of the last factor; keep the heaviest."""
        size, last = np.ptp(bounds_m, axis=0), factors[-1].moments
        free = size > 0
        one, other = (mixture._replace(
            means=mixture.means[:, free], covariances=mixture.covariances[:, free][:, :, free])
            for mixture in (self.moments, last))
        pairs = one.heaviest_pairs(other, _PRODUCTS, _MARGINS[0])
        found = _Products(
            np.column_stack([self.rows[pairs[0]], pairs[1]]),
            select(self.moments, pairs[0]).updated(select(last, pairs[1])))
        return found.climbed(factors, bounds_m).heaviest(
            _PRODUCTS, _MARGINS[1], factors)

    def heaviest(self, number: int, margin: float, factors: Sequence[_Factor]) -> '_Products':
        """Return the heaviest products, and that of all constants if there are more factors."""
        log_weights, constant = self.moments.log_weights, self.are_constant(factors)
        best = log_weights[~constant].max(initial=-np.inf)
        if not np.isfinite(best):
            raise ValueError('sightings: no finite product, expected densities in the region')
        order = np.argsort(-log_weights, kind='stable')
        kept = constant[order] | (log_weights[order] >= best - margin)
        return self.select(order[kept][:number])

    def select(self, chosen: np.ndarray) -> '_Products':
        """Return the products with these indices or in a mask."""
        return _Products(self.rows[chosen], select(self.moments, chosen))

    def are_constant(self, factors: Sequence[_Factor]) -> np.ndarray:
        """Mark the products of constants alone, bool [T]."""
        constant: np.ndarray = (
            self.rows == [len(one.rows.points) - 1 for one in factors]).all(axis=1)
        return constant

    def climbed(self, factors: Sequence[_Factor], bounds_m: np.ndarray) -> '_Products':
        """Move to the maxima in the region by a Gauss-Newton step."""
        found, _ = self._single(factors)
        prior = _NARROWING * prior_information(bounds_m)
        for mine, terms in self._by_reference(factors):
            around = terms[0].pose
            place = np.clip(self.moments.means[mine], *bounds_m)
            points, gradient, curvature = expanded(terms, place, prior)
            place = around.to_site(to_positions(move_inside(
                points + step_to_maximum(curvature, gradient), curvature, bounds_m, around)))
            points, gradient, curvature = expanded(terms, place, prior)
            derivative = polar_derivative(points) @ around.rotation.T
            covariances = np.linalg.inv(np.swapaxes(derivative, 1, 2) @ curvature @ derivative)
            found.means[mine], found.covariances[mine] = place, covariances
            # Where this has not converged, the next step still raises the value.
            rise = np.sum(gradient * step_to_maximum(curvature, gradient), axis=1) / 2
            found.log_weights[mine] = (
                logarithm(terms, place[:, None])[:, 0] + rise + log_volume(covariances))
        return _Products(self.rows, found)

    def _by_reference(self, factors: Sequence[_Factor]
                      ) -> Iterator[tuple[np.ndarray, list[Term]]]:
        """Yield indices of products of several sheets, and their factors.

        That of the surface with the thinnest sheets comes first.
        """
        sheets = self._are_sheets(factors)
        left = np.count_nonzero(sheets, axis=1) > 1
        for number in np.argsort([one.thickness for one in factors], kind='stable'):
            mine = np.flatnonzero(left & sheets[:, number])
            left[mine] = False
            if len(mine):
                terms = _terms(factors, self.rows[mine])
                yield mine, [terms.pop(number), *terms]

    def _are_sheets(self, factors: Sequence[_Factor]) -> np.ndarray:
        """Mark the factors that are not constants, bool [T, number of factors]."""
        sheets: np.ndarray = self.rows < [len(one.rows.points) - 1 for one in factors]
        return sheets

    def _single(self, factors: Sequence[_Factor]) -> tuple[Mixture, np.ndarray]:
        """Return the averages and moments of products of at most one sheet, and mark them."""
        sheets = self._are_sheets(factors)
        n_sheets = np.count_nonzero(sheets, axis=1)
        single = n_sheets == 1
        found = Mixture._make(field.copy() for field in self.moments)
        found.log_weights[n_sheets < 2] = 0.0
        for number, (one, rows) in enumerate(zip(factors, self.rows.T, strict=True)):
            found.log_weights[n_sheets < 2] += one.moments.log_weights[rows[n_sheets < 2]]
            mine = single & sheets[:, number]
            found.means[mine] = one.moments.means[rows[mine]]
            found.covariances[mine] = one.moments.covariances[rows[mine]]
        return found, n_sheets < 2

    def inside(self, factors: Sequence[_Factor], bounds_m: np.ndarray) -> '_Products':
        """Return the products with averages over the region and moments in it.

        The region of a product is halved where few of the samples carry the weight.
        """
        found = self.select(~self.are_constant(factors))
        mass, single = found._single(factors)
        owners, moments = np.flatnonzero(single), select(mass, single)
        parts = _Parts(np.flatnonzero(~single), mass.means[~single], *np.repeat(
            bounds_m[:, None], np.count_nonzero(~single), axis=1))
        for left in reversed(range(_HALVINGS + 1) if len(parts.owners) else ()):
            samples = parts.sampled(found.select(parts.owners), factors)
            inside, effective = _moments(samples.positions, samples.logs)
            inside = inside.weighted(parts.log_shares(bounds_m))
            best = max(inside.log_weights.max(), moments.log_weights.max(initial=-np.inf))
            heavy = inside.log_weights >= best - _MARGIN
            beyond = parts.beyond(samples, heavy)
            poor = np.isfinite(beyond[:, 0]) | heavy & (effective < _EFFECTIVE)
            order = np.argsort(-np.where(poor, inside.log_weights, -np.inf), kind='stable')
            halved = order[:min(np.count_nonzero(poor), _PARTS)] if left else order[:0]
            kept = np.delete(np.arange(len(poor)), halved)
            owners = np.append(owners, parts.owners[kept])
            moments = concatenate(moments, select(inside, kept))
            if not len(halved):
                break
            parts = select(parts, halved).halved(
                samples.positions[halved], samples.logs[halved], beyond[halved])
        kept = np.flatnonzero(_has_mass(moments))
        names, groups = np.unique(owners[kept], return_inverse=True)
        return _Products(found.rows[names], select(moments, kept)._merged(groups))

    def mixture(self, factors: Sequence[_Factor]) -> Mixture:
        """Return the normalised density, with the covariance that errors of poses cause."""
        constant = self.constant(factors)
        mixture = self.moments.widened(-constant).reduce(_COMPONENTS).normalised()
        return mixture.shared(np.tensordot(self.moments.probabilities, constant, axes=1))

    def constant(self, factors: Sequence[_Factor]) -> np.ndarray:
        """Return the parts of the covariances that errors of poses cause, float64 [T, 3, 3] [m^2].

        If a pose moves a sheet, the product moves by its own covariance times the information of
        the sheet.
        """
        means, covariances = self.moments.means, self.moments.covariances
        pulls = np.zeros_like(covariances)
        for one in _terms(factors, self.rows):
            _, curvature = one.expanded(means)
            pulls += curvature @ one.pose.spread(means) @ curvature
        # Where a product is no Gaussian, its covariance may exceed the inverse of the information.
        roots = np.linalg.cholesky(covariances)
        shares, axes = np.linalg.eigh(np.swapaxes(roots, 1, 2) @ pulls @ roots)
        moves = roots @ axes * np.sqrt(np.clip(shares, 0.0, _CONSTANT))[:, None]
        return moves @ np.swapaxes(moves, 1, 2)


class _Samples(NamedTuple):
    """Samples of P parts, S each."""

    positions: np.ndarray  # Float64 [P, S, 3] [m].
    logs: np.ndarray  # Logarithms of weights for averages over the boxes, float64 [P, S].
    # Indices of parts, and the factors and Gaussians of their products.
    groups: list[tuple[np.ndarray, list[Term], Inside]]


class _Parts(NamedTuple):
    """P products, each in a box that is a part of the region."""

    owners: np.ndarray  # Index of the product, int [P].
    starts_m: np.ndarray  # Positions near the maxima in the boxes, float64 [P, 3].
    low_m: np.ndarray  # Corners of the boxes, float64 [P, 3].
    high_m: np.ndarray

    def log_shares(self, bounds_m: np.ndarray) -> np.ndarray:
        """Return the logarithms of the shares of the boxes in the region, [P]."""
        size = np.ptp(bounds_m, axis=0)
        shares: np.ndarray = np.log(
            (self.high_m - self.low_m)[:, size > 0] / size[size > 0]).sum(axis=1)
        return shares

    def sampled(self, products: _Products, factors: Sequence[_Factor]) -> _Samples:
        """Draw samples of products in the boxes."""
        n = int(np.clip(_SAMPLES // len(self.owners), *_OF_PRODUCT))
        normal = standard_normal(1 << (n.bit_length() - 1))
        positions = np.empty((len(self.owners), *normal.shape))
        logs, groups = np.empty(positions.shape[:2]), []
        for mine, terms in products._by_reference(factors):
            gaussians = proposal(terms, self.starts_m[mine], self._boxes(mine))
            groups.append((mine, terms, gaussians))
            positions[mine], logs[mine] = gaussians.sample(normal)
            logs[mine] += logarithm(terms, positions[mine])
        return _Samples(positions, logs, groups)

    def beyond(self, samples: _Samples, chosen: np.ndarray) -> np.ndarray:
        """Return places of `elsewhere` for chosen parts, float64 [P, 3] [m]; NaN for others."""
        found = np.full_like(self.starts_m, np.nan)
        for mine, terms, gaussians in samples.groups:
            rows = np.flatnonzero(chosen[mine] & may_meet_again(
                terms, gaussians, self._boxes(mine)))
            if len(rows):
                found[mine[rows]] = elsewhere(
                    [Term(one.pose, select(one.rows, rows)) for one in terms],
                    select(gaussians, rows), samples.logs[mine[rows]], self._boxes(mine[rows]))
        return found

    def _boxes(self, chosen: np.ndarray) -> np.ndarray:
        return np.stack([self.low_m[chosen], self.high_m[chosen]])

    def halved(self, positions: np.ndarray, logs: np.ndarray, beyond: np.ndarray) -> '_Parts':
        """Halve boxes in front of places beyond, or among the samples, where these are widest."""
        rows = np.arange(len(self.owners))
        apart, best = np.isfinite(beyond[:, 0]), positions[rows, np.argmax(logs, axis=1)]
        axis = np.argmax(np.where(
            apart[:, None], np.abs(beyond - best), positions.std(axis=1)), axis=1)
        along = positions[rows, :, axis]
        middle = np.where(
            apart, (best + beyond)[rows, axis] / 2, np.median(along, axis=1))
        low_m, high_m = self.low_m.copy(), self.high_m.copy()
        low_m[rows, axis] = high_m[rows, axis] = middle
        halves = []
        for half, side in ((self._replace(high_m=high_m), along <= middle[:, None]),
                           (self._replace(low_m=low_m), along > middle[:, None])):
            best = positions[rows, np.argmax(np.where(side, logs, -np.inf), axis=1)]
            is_here = np.all((beyond >= half.low_m) & (beyond <= half.high_m), axis=1)
            halves.append(half._replace(starts_m=np.where(is_here[:, None], beyond, best)))
        return concatenate(*halves)


def _terms(factors: Sequence[_Factor], rows: np.ndarray) -> list[Term]:
    """Return the factors of products of the given rows, int [T, number of factors]."""
    return [one.term(chosen) for one, chosen in zip(factors, rows.T, strict=True)]


def _log_share(logs: np.ndarray, positions: np.ndarray, bounds_m: np.ndarray) -> float:
    """Return the logarithm of the share of samples [T, S, 3] [m] with log-weights [T, S] in a box.

    Errors of the pose are no part of it. They lower the density in a region without extent along
    an axis, which is no evidence for a user elsewhere.
    """
    inside = np.all((positions >= bounds_m[0] - _TOLERANCE_M) & (
        positions <= bounds_m[1] + _TOLERANCE_M), axis=2)
    return log_sum(np.where(inside, logs, _NEVER).ravel()) - log_sum(logs.ravel())


def _has_mass(mixture: Mixture) -> np.ndarray:
    """Mark components with a mass; raise ValueError if there is none."""
    chosen: np.ndarray = np.isfinite(mixture.log_weights)
    if not chosen.any():
        raise ValueError('sightings: no density in the region, expected one')
    return chosen


def _moments(positions: np.ndarray, logs: np.ndarray) -> tuple[Mixture, np.ndarray]:
    """Return the averages, and the moments, of samples [T, S, 3] [m] with log-weights [T, S].

    Also returns the effective shares of the samples, from 0 to 1, [T].
    """
    weights, log_totals = mixture_weights(np.maximum(logs, _NEVER))
    means, covariances = moments(weights, positions)
    log_totals[np.isneginf(logs).all(axis=1)] = -np.inf
    return (Mixture._make((log_totals - np.log(logs.shape[1]), means, regular(covariances))),
            1 / (logs.shape[1] * np.einsum('ts,ts->t', weights, weights)))
