"""The position of a user from the signals of several surfaces of a site.

For each surface, the likelihood of a position is a sum of sheets, widened by the uncertainty of
the pose of the surface. The posterior is the product of these sums. Each of its components is the
product of one sheet of every surface.

The maximum of a product is found by Gauss-Newton steps. Weighted samples around it, in range and
direction cosines of the surface with the thinnest sheet, yield the moments in the region. Two
sheets of opposite curvature that touch have a product along a rim. Where few samples carry the
weight, all of the thinnest sheet is therefore sampled, and the likelihoods of the other surfaces
are raised to powers that increase to 1 from round to round.

To each likelihood, a constant is added: the user may be blocked from the surface, the search may
have missed a mode, or the surface may be elsewhere. A surface that disagrees with the others thus
makes the posterior broader. All masses are averages over the region, in as many dimensions as the
region has.

All surfaces together decide whether a user is outside of the region. The product for a user inside
is compared with the product of what each surface says about a user outside. A surface may see the
user beyond its own region, or in the part of it that is outside of the region of the site.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from rhs_isac_ros.model.arrays import log_sum, mixture_weights, untied
from rhs_isac_ros.model.gaussian import moments, step_to_maximum, symmetric
from rhs_isac_ros.model.geometry import jacobian, polar_derivative, to_polar, to_positions
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.positioning.alternatives import Outside, log_odds_of, rejection
from rhs_isac_ros.positioning.estimate import SITE, Estimate, Sighting, regular
from rhs_isac_ros.positioning.mixture import Mixture, log_volume
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.sheets import Inside, Sheets, move_inside
from rhs_isac_ros.positioning.templates import standard_normal
from rhs_isac_ros.support.threads import one_blas_thread


class _Limits(NamedTuple):
    """Numbers that trade the speed of a product for its accuracy; weights are logarithms."""

    # Products below the best by more than this, and any beyond a number, are discarded: by the
    # overlap of their sheets' moments, and after the Gauss-Newton steps.
    margins: tuple[float, float] = (25.0, 12.0)
    products: tuple[int, int] = (4000, 512)
    steps: int = 3
    # Numbers of samples of a sheet, of a product, and of all products together; and factor by
    # which samples are wider than a Gaussian.
    of_sheet: int = 64
    of_product: int = 128
    samples: int = 1 << 13
    spread: float = 1.2
    # Information of a uniform prior in the region that narrows Gaussians, as a share of it, and
    # smallest extent of the region along an axis, relative to the largest one.
    narrowing: float = 0.25
    extent: float = 1e-3
    # Share of the samples that have to be effective in products whose weight is within a margin of
    # the best: a little less than in a Gaussian. Share with which rounds end, share to which
    # powers of the likelihood are limited, and maximum number of rounds.
    gaussian: float = 0.75
    margin: float = 5.0
    effective: float = 0.4
    tempered: float = 0.15
    rounds: int = 8
    # Largest share of a variance that is the same in all phases.
    constant: float = 0.98
    # Logarithm of a likelihood of 0, and smallest standard deviation of samples [m].
    never: float = -1e9
    # Logarithm of the probability of the region for a surface up to which only the tails of its
    # sheets reach the region.
    tail: float = -9.0
    least_m: float = 1e-6


_LIMITS = _Limits()
# Powers of the likelihoods.
_POWERS = 0.5**np.arange(24)


def fuse(sightings: Sequence[Sighting], bounds_m: np.ndarray, outside_probability: float = 0.0
         ) -> Estimate:
    """Multiply the likelihoods of the surfaces, for a user between the bounds of the region.

    The bounds, float64 [2, 3] [m], and the result are in the frame of the site. The prior
    probability of a user outside of the region is from 0 to less than 1. If that of all sightings
    exceeds `alternatives.LIMIT`, the result is a reason; with 0, users are inside. Raises
    ValueError without sightings, or if one has no density in the region.
    """
    return Fuser(bounds_m, outside_probability).fuse(sightings)


class Fuser:
    """Products of the sightings of one user, each of which is computed once.

    The products of sightings that begin in the same way share their first factors.
    """

    def __init__(self, bounds_m: np.ndarray, outside_probability: float = 0.0) -> None:
        """Take the bounds of the region and the prior probability; see the function `fuse`."""
        self._bounds_m, self._outside_probability = bounds_m, outside_probability
        self._factor = functools.cache(lambda one: _Factor.of(one, bounds_m))
        self._product = functools.cache(self._multiply)
        self._fused = functools.cache(self._locate)

    @one_blas_thread
    def fuse(self, sightings: Sequence[Sighting]) -> Estimate:
        """Multiply likelihoods; see the function `fuse`."""
        if not sightings:
            raise ValueError('sightings: none, expected at least one')
        return self._fused(tuple(sightings))

    def _multiply(self, sightings: tuple[Sighting, ...]) -> '_Products':
        if len(sightings) == 1:
            return _Products.of(self._factor(sightings[0]))
        return self._product(sightings[:-1]).times(
            [self._factor(one) for one in sightings], self._bounds_m)

    def _locate(self, sightings: tuple[Sighting, ...]) -> Estimate:
        factors = [self._factor(one) for one in sightings]
        if self._outside_probability and all(one.log_share <= _LIMITS.tail for one in factors):
            return Estimate.without_fix(
                rejection(Outside, 1.0, 0.0), frame=SITE, outside_probability=1.0,
                log_agreement=float(np.log([one.missing for one in sightings]).sum()))
        products = self._product(sightings).inside(factors, self._bounds_m)
        constant = products.constant(factors)
        log_agreement = products.moments.log_mass
        common: dict[str, Any] = {'log_agreement': log_agreement, 'frame': SITE}
        log_ratios = np.array([one.outside_log_ratio for one in sightings])
        if self._outside_probability and not np.isnan(log_ratios).all():
            log_missing = np.log([one.missing for one in sightings])
            beyond = np.maximum(-np.expm1([one.log_share for one in factors]), 1e-9)
            # Beyond the region of the surface, or in the part of it outside of that of the site.
            log_outside = np.logaddexp(log_missing, np.log1p(-np.exp(log_missing)) + np.logaddexp(
                np.nan_to_num(log_ratios), np.log(beyond))).sum()
            # A user inside, too, may be seen by no surface.
            log_inside = np.logaddexp(log_agreement, log_missing.sum())
            probability = float(np.exp(-np.logaddexp(
                0.0, log_inside - log_outside - log_odds_of(self._outside_probability))))
            common['outside_probability'] = probability
            if reason := rejection(Outside, probability, 1 - probability):
                return Estimate.without_fix(reason, **common)
        mixture = products.moments.widened(-constant).reduce(_LIMITS.products[1]).normalised()
        mixture = mixture.shared(np.tensordot(products.moments.probabilities, constant, axes=1))
        return Estimate(*mixture.moments(), density=mixture, **common)


def _log_share_of(mixture: Mixture, bounds_m: np.ndarray) -> float:
    """Return the logarithm of the probability of a region, or minus infinity."""
    free = np.ptp(bounds_m, axis=0) > 0
    positions = mixture.means[:, None] + np.matmul(
        standard_normal(_LIMITS.of_sheet),
        np.swapaxes(np.linalg.cholesky(mixture.covariances), 1, 2))
    within = ((positions >= bounds_m[0]) & (positions <= bounds_m[1]))[..., free].all(axis=-1)
    with np.errstate(divide='ignore'):
        return float(np.log(mixture.probabilities @ within.mean(axis=1)))


class _Factor(NamedTuple):
    """The likelihood of one surface: C sheets and, as the last row, a constant.

    Its average over the region of the surface, which contains that of the site, is 1.
    """

    pose: Pose
    points: np.ndarray  # Maxima, (r [m], u, v), float64 [C + 1, 3].
    curvature: np.ndarray  # Float64 [C + 1, 3, 3].
    log_peaks: np.ndarray  # Float64 [C + 1].
    moments: Mixture  # Averages and moments inside the region, in the frame of the site.
    log_share: float  # Logarithm of the surface's probability of the region of the site.

    @classmethod
    def of(cls, sighting: Sighting, bounds_m: np.ndarray) -> '_Factor':
        """Widen sheets by the errors of the pose; this does not change their masses."""
        pose, sheets = sighting.pose, sighting.likelihood
        best = sheets.inside(bounds_m, pose).nearest()
        derivative = polar_derivative(to_polar(pose.to_surface(best))) @ pose.rotation.T
        sheets = sheets.widened(symmetric(
            derivative @ pose.spread(best) @ np.swapaxes(derivative, 1, 2)))
        gaussians = sheets.inside(bounds_m, pose)
        positions, log_ratio = gaussians.sample(standard_normal(_LIMITS.of_sheet))
        logs = gaussians.logarithm(positions) + log_ratio
        sheets, inside = select(sheets, _has_mass(logs)), _moments(positions, logs)
        centre, size = bounds_m.mean(axis=0), np.ptp(bounds_m, axis=0)
        log_share = _log_share_of(sighting.mixture, bounds_m)
        if log_share > _LIMITS.tail:
            log_total = inside.log_mass - log_share
        else:
            # Samples of tails far from all maxima have too little weight.
            log_total = log_sum(sheets.as_density().log_weights) - np.log(size[size > 0]).sum()
        log_total -= np.log1p(-sighting.missing)
        return cls(
            pose, np.append(sheets.means, sheets.means[:1], axis=0),
            np.append(np.linalg.inv(sheets.covariances), np.zeros((1, 3, 3)), axis=0),
            np.append(sheets.log_peaks - log_total, np.log(sighting.missing)),
            Mixture._make((
                np.append(inside.log_weights - log_total, np.log(sighting.missing)),
                np.append(inside.means, centre[None], axis=0),
                np.append(inside.covariances, regular(np.diag(size**2 / 12))[None], axis=0))),
            log_share)

    def logarithm(self, rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Evaluate rows [T] at positions [T, S, 3] [m], float64 [T, S]."""
        local, curvature = self.pose.to_surface(positions), self.curvature[rows]
        offsets = to_polar(local) - self.points[rows, None]
        values = self.log_peaks[rows, None] - np.sum(
            np.matmul(offsets, curvature) * offsets, axis=-1) / 2
        # No user behind the surface is in sight.
        behind = (local[..., 0] <= 0) & (rows < len(self.points) - 1)[:, None]
        return np.where(behind, -np.inf, values)

    def expanded(self, rows: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient [T, 3] and curvature [T, 3, 3] at positions [T, 3] [m]."""
        points = to_polar(self.pose.to_surface(positions))
        derivative = polar_derivative(points) @ self.pose.rotation.T
        offsets = points - self.points[rows]
        slope = np.matmul(np.swapaxes(derivative, 1, 2), self.curvature[rows])
        return -np.matmul(slope, offsets[..., None])[..., 0], np.matmul(slope, derivative)


# A factor and the rows in it, int [T], of each surface.
_Terms: TypeAlias = list[tuple[_Factor, np.ndarray]]


class _Products(NamedTuple):
    """T products, each of one row of every factor so far."""

    rows: np.ndarray  # Int [T, number of factors].
    # Averages over the region, maxima or means, and covariances, in the frame of the site.
    moments: Mixture

    @classmethod
    def of(cls, factor: _Factor) -> '_Products':
        """Return the rows of one factor."""
        return cls(np.arange(len(factor.points))[:, None], factor.moments)

    def times(self, factors: Sequence[_Factor], bounds_m: np.ndarray) -> '_Products':
        """Multiply each product by each row of the last factor; keep the heaviest."""
        size, last = np.ptp(bounds_m, axis=0), factors[-1].moments
        free = size > 0
        one, other = (mixture._replace(
            means=mixture.means[:, free], covariances=mixture.covariances[:, free][:, :, free])
            for mixture in (self.moments, last))
        pairs = one.heaviest_pairs(other, _LIMITS.products[0], _LIMITS.margins[0])
        found = _Products(
            np.column_stack([self.rows[pairs[0]], pairs[1]]),
            select(self.moments, pairs[0]).updated(select(last, pairs[1])))
        return found.climbed(factors, bounds_m).heaviest(
            _LIMITS.products[1], _LIMITS.margins[1], factors)

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
            self.rows == [len(one.points) - 1 for one in factors]).all(axis=1)
        return constant

    def climbed(self, factors: Sequence[_Factor], bounds_m: np.ndarray) -> '_Products':
        """Move to the maxima in the region by Gauss-Newton steps."""
        log_weights, places, covariances = map(np.empty_like, self.moments)
        for mine, terms in self._by_reference(factors):
            around = terms[0][0].pose
            place = np.clip(self.moments.means[mine], *bounds_m)
            for _ in range(_LIMITS.steps):
                points, gradient, curvature = _expanded(terms, place, bounds_m)
                place = around.to_site(to_positions(move_inside(
                    points + step_to_maximum(curvature, gradient), curvature, bounds_m, around)))
            points, _, curvature = _expanded(terms, place, bounds_m)
            derivative = polar_derivative(points) @ around.rotation.T
            places[mine] = place
            covariances[mine] = np.linalg.inv(
                np.swapaxes(derivative, 1, 2) @ curvature @ derivative)
            log_weights[mine] = _logarithm(terms, place[:, None])[:, 0]
        return _Products(self.rows, Mixture._make((
            log_weights + log_volume(covariances), places, covariances)))

    def _by_reference(self, factors: Sequence[_Factor]
                      ) -> Iterator[tuple[np.ndarray, _Terms]]:
        """Yield indices of products, and their rows in the factors, the thinnest sheet first."""
        knowledge = np.column_stack([one.curvature[rows, 0, 0] for one, rows in zip(
            factors, self.rows.T, strict=True)])
        thinnest = np.argmin(untied(-knowledge), axis=1)
        for number in range(len(factors)):
            mine = np.flatnonzero(thinnest == number)
            if len(mine):
                terms = list(zip(factors, self.rows[mine].T, strict=True))
                yield mine, [terms.pop(number), *terms]

    def inside(self, factors: Sequence[_Factor], bounds_m: np.ndarray) -> '_Products':
        """Return the products with averages over the region and moments in it."""
        found = self.select(~self.are_constant(factors))
        n = min(max(_LIMITS.samples // len(found.rows), 16), _LIMITS.of_product)
        normal = standard_normal(1 << (n.bit_length() - 1))
        shape = len(found.rows), len(normal)
        positions, logs = np.empty((*shape, 3)), np.empty(shape)
        parts = list(found._by_reference(factors))
        for mine, terms in parts:
            points, gradient, curvature = _expanded(terms, found.moments.means[mine], bounds_m)
            wide = 1 / _LIMITS.spread**2
            positions[mine], logs[mine] = _sampled(terms, Inside.of(
                points, wide * gradient, wide * curvature, bounds_m, terms[0][0].pose), normal)
        effective, totals = _effective(logs), logs.max(axis=1)
        poor = (effective < _LIMITS.gaussian) & (totals >= totals.max() - _LIMITS.margin)
        for mine, terms in parts:
            rows = np.flatnonzero(poor[mine])
            if len(rows):
                again = mine[rows]
                positions[again], logs[again] = _annealed(
                    [(one, which[rows]) for one, which in terms], bounds_m, normal)
        return _Products(found.rows[_has_mass(logs)], _moments(positions, logs))

    def constant(self, factors: Sequence[_Factor]) -> np.ndarray:
        """Return the parts of the covariances that errors of poses cause, float64 [T, 3, 3] [m^2].

        If a pose moves a sheet, the product moves by its own covariance times the information of
        the sheet.
        """
        means, covariances = self.moments.means, self.moments.covariances
        pulls = np.zeros_like(covariances)
        for one, rows in zip(factors, self.rows.T, strict=True):
            _, curvature = one.expanded(rows, means)
            pulls += curvature @ one.pose.spread(means) @ curvature
        # Where a product is no Gaussian, its covariance may exceed the inverse of the information.
        roots = np.linalg.cholesky(covariances)
        shares, axes = np.linalg.eigh(np.swapaxes(roots, 1, 2) @ pulls @ roots)
        moves = roots @ axes * np.sqrt(np.clip(shares, 0.0, _LIMITS.constant))[:, None]
        return moves @ np.swapaxes(moves, 1, 2)


def _logarithm(terms: _Terms, positions: np.ndarray) -> np.ndarray:
    """Evaluate products at positions [T, S, 3] [m], float64 [T, S]."""
    return np.sum([one.logarithm(rows, positions) for one, rows in terms], axis=0)


def _expanded(terms: _Terms, positions: np.ndarray, bounds_m: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (r, u, v) around the first surface, and gradient and curvature with respect to it.

    The curvature includes a part of the information of a uniform prior.
    """
    size = np.ptp(bounds_m, axis=0)
    size = np.maximum(size, _LIMITS.extent * size.max())
    pose = terms[0][0].pose
    points = to_polar(pose.to_surface(positions))
    by_point = pose.rotation @ jacobian(points)
    gradient, curvature = (np.sum(parts, axis=0) for parts in zip(*(
        one.expanded(rows, positions) for one, rows in terms), strict=True))
    transposed = np.swapaxes(by_point, 1, 2)
    return (points, np.matmul(transposed, gradient[..., None])[..., 0],
            symmetric(transposed @ (curvature + np.diag(
                12 * _LIMITS.narrowing / size**2)) @ by_point))


def _sampled(terms: _Terms, proposal: Inside, normal: np.ndarray
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return samples [T, S, 3] [m], and products relative to their density, [T, S]."""
    positions, log_ratio = proposal.sample(normal)
    return positions, _logarithm(terms, positions) + log_ratio


def _annealed(terms: _Terms, bounds_m: np.ndarray, normal: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray]:
    """Sample the first sheet, and then Gaussians of the samples as the others gain weight."""
    (first, rows), others = terms[0], terms[1:]
    pose, size = first.pose, np.ptp(bounds_m, axis=0)
    # A Gaussian has an extent along an axis along which the region has none.
    least = np.diag(np.where(size > 0, _LIMITS.least_m, 1.0)**2)
    sheets = Sheets._make((
        first.log_peaks[rows], first.points[rows], np.linalg.inv(first.curvature[rows])))
    best = np.zeros(len(rows)), np.empty((len(rows), *normal.shape)), np.full(
        (len(rows), len(normal)), -np.inf)
    for _ in range(_LIMITS.rounds):
        positions, log_ratio = sheets.inside(bounds_m, pose).sample(normal)
        logs = first.logarithm(rows, positions) + log_ratio
        rest = _logarithm(others, positions) if others else np.zeros_like(logs)
        effective = _effective(logs + rest)
        better = effective > best[0]
        for kept, new in zip(best, (effective, positions, logs + rest), strict=True):
            kept[better] = new[better]
        if (best[0] >= _LIMITS.effective).all():
            break
        rest = np.where(np.isfinite(rest), rest, _LIMITS.never)
        # The highest power of the other likelihoods for which enough samples are effective.
        shares = _effective(logs[:, None] + _POWERS[:, None] * rest[:, None])
        enough = shares >= np.minimum(_LIMITS.tempered, shares.max(axis=1, keepdims=True))
        power = _POWERS[np.argmax(enough, axis=1)]
        weights, _ = mixture_weights(logs + power[:, None] * rest)
        points = to_polar(pose.to_surface(positions))
        means, covariances = moments(weights, points)
        derivative = polar_derivative(means) @ pose.rotation.T
        # Few samples have moments in fewer dimensions than the product.
        few = np.sum(weights**2, axis=1)[:, None, None]**2
        covariances += few * sheets.covariances + derivative @ least @ np.swapaxes(
            derivative, 1, 2)
        sheets = Sheets._make((
            np.zeros(len(rows)), means, symmetric(_LIMITS.spread**2 * covariances)))
    return best[1], best[2]


def _effective(logs: np.ndarray) -> np.ndarray:
    """Return the effective share of samples with log-weights [..., S], from 0 to 1, [...]."""
    highest = logs.max(axis=-1, keepdims=True)
    weights = np.exp(logs - np.where(np.isfinite(highest), highest, 0.0))
    squares = np.sum(weights**2, axis=-1)
    share: np.ndarray = np.sum(weights, axis=-1)**2 / np.maximum(squares, 1e-300)
    return share / logs.shape[-1]


def _has_mass(logs: np.ndarray) -> np.ndarray:
    """Mark products with a finite log-weight [T, S]; raise ValueError if there is none."""
    chosen: np.ndarray = np.isfinite(logs).any(axis=1)
    if not chosen.any():
        raise ValueError('sightings: no density in the region, expected one')
    return chosen


def _moments(positions: np.ndarray, logs: np.ndarray) -> Mixture:
    """Return the averages and moments of weighted samples [T, S, 3] [m] of those with a mass."""
    chosen = _has_mass(logs)
    weights, log_totals = mixture_weights(logs[chosen])
    means, covariances = moments(weights, positions[chosen])
    return Mixture._make((log_totals - np.log(logs.shape[1]), means, regular(covariances)))
