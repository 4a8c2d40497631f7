"""Estimation of the pose of a surface from users that another surface also locates.

Each surface yields a mixture of candidate positions for every user. For the right pose, a
candidate of one mixture is at the same place as one of the other mixture. The pose follows by
expectation maximisation: candidates are paired by their probabilities for the latest pose, and a
Gauss-Newton step improves the pose for these pairs. A pose that is off by a metre would pair wrong
candidates. The first steps therefore use mixtures that are widened by a few metres.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import Pose
from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.gaussian import likelihood_loss, moments, step_to_maximum, symmetric
from rhs_isac_ros.positioning.fusion import Sighting
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.segments import Segments, select
from rhs_isac_ros.positioning.templates import standard_normal
from rhs_isac_ros.support.threads import one_blas_thread

# Smallest number of common users. A pose has six unknowns, and a user yields up to three numbers.
MIN_USERS = 10


class _Limits(NamedTuple):
    """Numbers that trade the speed of the search for a pose for its reliability."""

    # Standard deviations by which mixtures are widened in successive steps [m]; from a pose in the
    # neighbourhood of the first result, only the last ones.
    widths_m: tuple[float, ...] = tuple((3.0 * 0.7**np.arange(16)).tolist())
    near_widths: int = 5
    # Number of poses in the neighbourhood, and their standard deviations [m] and [rad]. Positions
    # have ambiguities half a metre apart, so the likelihood of a pose has several maxima.
    near: int = 64
    near_std: tuple[float, float] = (0.3, float(np.deg2rad(1.0)))
    # Maximum number of steps with the mixtures as they are; they end when no element of the error
    # changes by more than the second number [m] or [rad].
    steps: int = 50
    change: float = 1e-5
    # Logarithm of the smallest probability of a candidate; others only cost time.
    log_weight: float = -6.0
    # Smallest share of a pair in the information; others only cost time.
    share: float = 1e-9
    # Maximum number of maxima around which errors are sampled, distance of maxima that are the
    # same one [m] and [rad], number of samples of each, a power of two, and factor by which they
    # are wider than a Gaussian.
    maxima: int = 4
    same: float = 1e-3
    samples: int = 128
    spread: float = 1.5
    # Largest standard deviations of a result [m] and [rad]: beyond them, users do not determine
    # the pose.
    std_m: float = 2.0
    std_rad: float = 0.2


_LIMITS = _Limits()
# Information of a prior that keeps undetermined errors finite: 10 m and 1 rad.
_PRIOR = np.diag(1 / np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])**2)


class PoseError(ValueError):
    """The pose of a surface cannot be estimated from the given users."""


@one_blas_thread
def estimate_pose(
        reference: Sequence[Sighting], other: Sequence[Sighting], bounds_m: np.ndarray) -> Pose:
    """Estimate the pose of a surface in the frame of the pose of a reference surface.

    Parameters
    ----------
    reference, other
        Sightings of the same users at the same times by the two surfaces. The pose of the other
        surface in them is the start of the search; it may be off by a metre and ten degrees.
    bounds_m
        Bounds of the region of interest in the frame of the site, float64 [2, 3] [m].

    Returns
    -------
    Pose
        Its `uncertainty` is the covariance of the estimate for an exact pose of the reference.

    Raises
    ------
    PoseError
        If the numbers of sightings differ or are below `MIN_USERS`, or if the users do not
        determine the pose, for example because all are at one place.
    """
    if len(reference) != len(other) or len(other) < MIN_USERS:
        raise PoseError(f'sightings: {len(reference)} and {len(other)}, expected equal numbers, '
                        f'at least {MIN_USERS}')
    pairs = _Pairs.of(reference, other, bounds_m)
    pose = pairs.climb(other[0].pose, _LIMITS.widths_m)[1]
    near = [pairs.climb(pose.displaced(error), _LIMITS.widths_m[-_LIMITS.near_widths:])
            for error in standard_normal(_LIMITS.near, 6) * np.repeat(_LIMITS.near_std, 3)]
    score, pose = max(near, key=lambda found: found[0].value)
    std = np.sqrt(np.diagonal(score.covariance()))
    if not (std[:3].max() <= _LIMITS.std_m and std[3:].max() <= _LIMITS.std_rad):
        raise PoseError(
            f'users: standard deviations of the pose up to {std[:3].max():.2g} m and '
            f'{np.rad2deg(std[3:].max()):.2g} deg, expected users at more different places')
    mean, covariance = _moments(pairs, pose, near)
    pose = pose.displaced(mean)
    return Pose(pose.position_m, pose.quaternion, tuple(map(tuple, covariance.tolist())))


def _moments(pairs: '_Pairs', pose: Pose, found: Sequence[tuple['_Score', Pose]]
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return mean [6] and covariance [6, 6] of the error of a pose, from samples around maxima.

    Away from a maximum, the likelihood falls more slowly than its curvature suggests.
    """
    components: list[tuple[float, np.ndarray, np.ndarray]] = []
    for score, maximum in found:
        error = pose.error_of(maximum)
        if not any(np.abs(error - known).max() < _LIMITS.same for _, known, _ in components):
            covariance = score.covariance()
            log_weight = score.value + np.linalg.slogdet(covariance)[1] / 2
            components.append((log_weight, error, covariance))
    components = sorted(components, key=lambda one: -one[0])[:_LIMITS.maxima]
    proposal = Mixture(*map(np.array, zip(*components, strict=True))).normalised()
    proposal = proposal._replace(covariances=_LIMITS.spread**2 * proposal.covariances)
    normal = standard_normal(_LIMITS.samples, 6)
    errors = np.concatenate([mean + normal @ root.T for mean, root in zip(
        proposal.means, np.linalg.cholesky(proposal.covariances), strict=True)])
    density = proposal._replace(log_weights=np.zeros(len(components))).log_density(errors)
    values = np.array([pairs.score(pose.displaced(error), 0.0).value for error in errors])
    weights, _ = mixture_weights(values - density)
    return moments(weights, errors)


def _thickened(sighting: Sighting) -> Mixture:
    """Return the probable candidates, normalised, in the frame of the surface.

    A component is a sheet that bends around the surface. At an offset d across the line of sight,
    it is nearer by d^2 / (2 r), whose mean and variance are added to the Gaussian.
    """
    pose, mixture = sighting.pose, sighting.mixture.normalised()
    mixture = select(mixture, mixture.log_weights >= _LIMITS.log_weight)
    means = pose.to_surface(mixture.means)
    covariances = pose.covariances_to_surface(mixture.covariances)
    range_m = np.linalg.norm(means, axis=1)
    sight = means / range_m[:, None]
    along = sight[:, :, None] * sight[:, None, :]
    across = (np.eye(3) - along) @ covariances @ (np.eye(3) - along)
    nearer = np.trace(across, axis1=1, axis2=2) / (2 * range_m)
    variance = np.einsum('cpq,cpq->c', across, across) / (2 * range_m**2)
    return mixture._replace(
        means=means - nearer[:, None] * sight,
        covariances=covariances + variance[:, None, None] * along)


def _inverses(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inverses [P, 3, 3] of covariances, and logarithms of their determinants [P].

    For many small matrices, the cofactors take a third of the time of a decomposition of each.
    """
    first, second, third = np.moveaxis(covariances, 1, 0)
    cofactors = np.stack(
        [np.cross(second, third), np.cross(third, first), np.cross(first, second)], axis=1)
    determinants = np.einsum('pq,pq->p', first, cofactors[:, 0])
    return cofactors / determinants[:, None, None], np.log(determinants)


class _Score(NamedTuple):
    """Log-likelihood of a pose for N users, and its derivatives with respect to an error."""

    value: float
    gradients: np.ndarray  # Float64 [N, 6].
    paired: np.ndarray  # Information for known pairs of candidates, float64 [6, 6].
    lost: np.ndarray  # Part of this information that is lost, as pairs are uncertain, [6, 6].

    def covariance(self) -> np.ndarray:
        """Return the covariance of the maximum, float64 [6, 6], from the scatter of the users."""
        # As in a jackknife, the factor makes up for the six unknowns that the users determine.
        n = len(self.gradients)
        inverse = np.linalg.inv(self.paired - self.lost + _PRIOR)
        scatter = self.gradients.T @ self.gradients * (n / (n - 6))**2 + _PRIOR
        return symmetric(inverse @ scatter @ inverse)


class _Pairs(NamedTuple):
    """All P pairs of a candidate of the reference and one of the other surface, for N users."""

    of_user: Segments
    log_weights: np.ndarray  # Float64 [P].
    log_outlier: np.ndarray  # Logarithm of the density of a user without a right pair, [N].
    means_m: np.ndarray  # Candidates of the reference in the frame of the site, [P, 3].
    covariances: np.ndarray  # Float64 [P, 3, 3] [m^2].
    local_m: np.ndarray  # Candidates of the other surface in its own frame, [P, 3].
    local_covariances: np.ndarray  # Float64 [P, 3, 3] [m^2].

    @classmethod
    def of(cls, reference: Sequence[Sighting], other: Sequence[Sighting], bounds_m: np.ndarray
           ) -> '_Pairs':
        """Pair all candidates of every user."""
        columns = []
        for one, two in zip(reference, other, strict=True):
            here, there = _thickened(one), _thickened(two)
            first, second = np.divmod(
                np.arange(len(here.means) * len(there.means)), len(there.means))
            columns.append((
                here.log_weights[first] + there.log_weights[second]
                + np.log1p(-one.missing) + np.log1p(-two.missing),
                one.pose.to_site(here.means)[first],
                one.pose.covariances_to_site(here.covariances)[first],
                there.means[second], there.covariances[second]))
        log_weights, *others = map(np.concatenate, zip(*columns, strict=True))
        missing = np.array([one.missing + two.missing - one.missing * two.missing
                            for one, two in zip(reference, other, strict=True)])
        log_outlier = np.log(missing) - np.log(np.ptp(bounds_m, axis=0)).sum()
        counts = np.array([len(column[0]) for column in columns])
        return cls(Segments.of_counts(counts), log_weights, log_outlier, *others)

    def climb(self, pose: Pose, widths_m: Sequence[float]) -> tuple[_Score, Pose]:
        """Return the nearest maximum of the likelihood, and the derivatives there."""
        for width_m in (*widths_m, *(0.0,) * _LIMITS.steps):
            score = self.score(pose, width_m)
            step = step_to_maximum(score.paired + _PRIOR, score.gradients.sum(axis=0))
            pose = pose.displaced(step)
            if not width_m and np.abs(step).max() < _LIMITS.change:
                break
        return self.score(pose, 0.0), pose

    def score(self, pose: Pose, width_m: float) -> _Score:
        """Return derivatives at a pose, with mixtures widened by a standard deviation [m]."""
        turned = pose.vectors_to_site(self.local_m)
        offsets = self.means_m - turned - pose.origin
        covariances = self.covariances + pose.covariances_to_site(self.local_covariances)
        precisions, log_dets = _inverses(covariances + width_m**2 * np.eye(3))
        logs = (self.log_weights - likelihood_loss(offsets, precisions) - log_dets / 2
                - 1.5 * np.log(2 * np.pi))
        highest = np.maximum(self.of_user.max(logs), self.log_outlier)
        densities = np.exp(logs - self.of_user.repeat(highest))
        totals = self.of_user.sum(densities) + np.exp(self.log_outlier - highest)
        shares = densities / self.of_user.repeat(totals)
        pulls = np.matmul(precisions, offsets[..., None])[..., 0]
        # An error of the pose moves candidates by its shift and by the turn times their offset.
        slopes = np.concatenate([pulls, np.cross(turned, pulls)], axis=1)
        likely = shares > _LIMITS.share
        crosses = np.cross(np.eye(3), turned[likely, None])
        moves = np.concatenate([np.broadcast_to(np.eye(3), crosses.shape), crosses], axis=1)
        information = moves @ precisions[likely] @ np.swapaxes(moves, 1, 2)
        gradients = self.of_user.sum(shares[:, None] * slopes)
        squares = slopes.T @ (shares[:, None] * slopes)
        value = float((highest + np.log(totals)).sum())
        return _Score(value, gradients, np.tensordot(shares[likely], information, axes=1),
                      squares - gradients.T @ gradients)
