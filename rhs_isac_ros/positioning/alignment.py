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
from rhs_isac_ros.model.arrays import cross, log_size, mixture_weights
from rhs_isac_ros.model.gaussian import likelihood_loss, moments, step_to_maximum, symmetric
from rhs_isac_ros.positioning.estimate import Sighting
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.segments import Segments, select
from rhs_isac_ros.positioning.templates import standard_normal
from rhs_isac_ros.support.threads import one_blas_thread

# Smallest number of places of common users. A pose has six unknowns, and a place yields up to
# three numbers.
MIN_USERS = 10
# Standard deviations by which mixtures are widened in successive steps [m]; from a pose in the
# neighbourhood of the first result, only the last ones.
_WIDTHS_M = tuple((3.0 * 0.7**np.arange(16)).tolist())
_NEAR_WIDTHS = 5
# Number of poses in the neighbourhood, and their standard deviations [m] and [rad]. Positions have
# ambiguities half a metre apart, so the likelihood of a pose has several maxima.
_NEAR = 64
_NEAR_STD = (0.3, float(np.deg2rad(1.0)))
# Maximum number of steps with the mixtures as they are; they end when no element of the error
# changes by more than the second number [m] or [rad].
_STEPS = 50
_CHANGE = 1e-5
# Logarithm of the smallest probability of a candidate; others only cost time.
_LOG_WEIGHT = -6.0
# Smallest share of a pair in the information; others only cost time.
_SHARE = 1e-9
# Maximum number of maxima around which errors are sampled, distance of maxima that are the same
# one [m] and [rad], number of samples of each, a power of two, and factor by which they are wider
# than a Gaussian.
_MAXIMA = 4
_SAME = 1e-3
_SAMPLES = 128
_SPREAD = 1.5
# Largest standard deviations of a result [m] and [rad]: beyond them, users do not determine the
# pose.
_STD_M = 2.0
_STD_RAD = 0.2
# Smallest share of the apparent information about an error that is not due to the errors of the
# places.
_CERTAIN = 0.5
# Squared Mahalanobis distance of users who are at one place.
_SAME_PLACE = 2.0
# Information of a prior that keeps undetermined errors finite: 10 m and 1 rad.
_PRIOR = np.diag(1 / np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])**2)
# Cross products of the unit vectors, [3, 3, 3].
_CROSS = cross(np.eye(3)[:, None], np.eye(3))


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
        If the numbers of sightings differ or are below `MIN_USERS`, if the users are at fewer
        places, or if they do not determine the pose, for example because all are on one line.

    Notes
    -----
    Users whose positions differ by less than their errors are at one place, such as a user at rest
    in several cycles. Their errors may be the same, so they count as one user. Users determine the
    pose if they spread by more than their own errors in at least two directions.
    """
    if len(reference) != len(other) or len(other) < MIN_USERS:
        raise PoseError(f'sightings: {len(reference)} and {len(other)}, expected equal numbers, '
                        f'at least {MIN_USERS}')
    pairs = _Pairs.of(reference, other, bounds_m)
    pose = pairs.climb(other[0].pose, _WIDTHS_M)[1]
    pairs, n_places = pairs.by_place(pose)
    if n_places < MIN_USERS:
        raise PoseError(f'users: {n_places} places that differ by more than the errors of the '
                        f'positions, expected users at more different places, {MIN_USERS}')
    near = [pairs.climb(pose.displaced(error), _WIDTHS_M[-_NEAR_WIDTHS:])
            for error in standard_normal(_NEAR, 6) * np.repeat(_NEAR_STD, 3)]
    score, pose = max(near, key=lambda found: found[0].value)
    if score.certain_share() < _CERTAIN:
        raise PoseError('users: they spread by less than the errors of their positions, except '
                        'along a line, expected users at more different places')
    mean, covariance = _moments(pairs, pose, near)
    # The likelihood takes the errors of a place for a part of its lever arm.
    covariance = symmetric(covariance + covariance @ score.noise @ covariance)
    # Without any pair, the samples do not represent the likelihood.
    std = np.sqrt(np.diagonal(np.maximum(covariance, score.covariance())))
    if not (std[:3].max() <= _STD_M and std[3:].max() <= _STD_RAD):
        raise PoseError(
            f'users: standard deviations of the pose up to {std[:3].max():.2g} m and '
            f'{np.rad2deg(std[3:].max()):.2g} deg, expected users at more different places')
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
        if not any(np.abs(error - known).max() < _SAME for _, known, _ in components):
            covariance = score.covariance()
            log_weight = score.value + np.linalg.slogdet(covariance)[1] / 2
            components.append((log_weight, error, covariance))
    components = sorted(components, key=lambda one: -one[0])[:_MAXIMA]
    proposal = Mixture(*map(np.array, zip(*components, strict=True))).normalised()
    proposal = proposal._replace(covariances=_SPREAD**2 * proposal.covariances)
    normal = standard_normal(_SAMPLES, 6)
    errors = np.concatenate([mean + normal @ root.T for mean, root in zip(
        proposal.means, np.linalg.cholesky(proposal.covariances), strict=True)])
    density = proposal._replace(log_weights=np.zeros(len(components))).log_density(errors)
    values = np.array([pairs.value(pose.displaced(error)) for error in errors])
    weights, _ = mixture_weights(values - density)
    return moments(weights, errors)


def _candidates(sighting: Sighting) -> Mixture:
    """Return the probable candidates, normalised, in the frame of the surface."""
    mixture = sighting.likelihood.to_mixture(Pose()).normalised()
    return select(mixture, mixture.log_weights >= _LOG_WEIGHT)


def _inverses(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inverses [P, 3, 3] of covariances, and logarithms of their determinants [P].

    For many small matrices, the cofactors take a third of the time of a decomposition of each.
    """
    cofactors = cross(covariances[:, [1, 2, 0]], covariances[:, [2, 0, 1]])
    determinants = np.einsum('pq,pq->p', covariances[:, 0], cofactors[:, 0])
    return cofactors / determinants[:, None, None], np.log(determinants)


class _Score(NamedTuple):
    """Log-likelihood of a pose for N users, and its derivatives with respect to an error."""

    value: float
    gradient: np.ndarray  # Float64 [6].
    paired: np.ndarray  # Information for known pairs of candidates, float64 [6, 6].
    lost: np.ndarray  # Part of this information that is lost, as pairs are uncertain, [6, 6].
    noise: np.ndarray  # Part that is due to errors of the places, float64 [6, 6].

    def covariance(self) -> np.ndarray:
        """Return the covariance of the maximum, float64 [6, 6]."""
        inverse = np.linalg.inv(self.paired - self.lost - self.noise + _PRIOR)
        return symmetric(inverse @ (self.paired + _PRIOR) @ inverse)

    def certain_share(self) -> float:
        """Return the smallest share of the information that is not due to errors of places."""
        shares = np.linalg.eigvals(np.linalg.solve(self.paired + _PRIOR, self.noise))
        return 1 - float(shares.real.max())


class _Pairs(NamedTuple):
    """All P pairs of a candidate of the reference and one of the other surface, for N users."""

    of_user: Segments
    weights: np.ndarray  # Weights of the users, float64 [N].
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
            here, there = _candidates(one), _candidates(two)
            first, second = np.indices((len(here.means), len(there.means))).reshape(2, -1)
            columns.append((
                here.log_weights[first] + there.log_weights[second]
                + np.log1p(-one.missing) + np.log1p(-two.missing),
                one.pose.to_site(here.means)[first],
                one.pose.covariances_to_site(here.covariances)[first],
                there.means[second], there.covariances[second]))
        log_weights, *others = map(np.concatenate, zip(*columns, strict=True))
        missing = np.array([one.missing + two.missing - one.missing * two.missing
                            for one, two in zip(reference, other, strict=True)])
        log_outlier = np.log(missing) - log_size(bounds_m)
        counts = np.array([len(column[0]) for column in columns])
        return cls(Segments.of_counts(counts), np.ones(len(counts)), log_weights, log_outlier,
                   *others)

    def by_place(self, pose: Pose) -> tuple['_Pairs', int]:
        """Give each place a weight of 1, which its users share; return also the number of places.

        The position of a user is that of the most probable pair.
        """
        _, offsets, precisions, logs = self._compared(pose, 0.0)
        best = np.array([rows.start + np.argmax(logs[rows]) for rows in self.of_user.slices])
        places_m, covariances = self._places(best, offsets, precisions)
        left, weights, n_places = np.arange(len(best)), np.ones(len(best)), 0
        while len(left):
            both, _ = _inverses(covariances[left] + covariances[left[0]])
            loss = likelihood_loss(places_m[left] - places_m[left[0]], both)
            is_near = 2 * loss <= _SAME_PLACE
            weights[left[is_near]] = 1 / np.count_nonzero(is_near)
            left, n_places = left[~is_near], n_places + 1
        return self._replace(weights=weights), n_places

    def climb(self, pose: Pose, widths_m: Sequence[float]) -> tuple[_Score, Pose]:
        """Return the nearest maximum of the likelihood, and the derivatives there."""
        for width_m in (*widths_m, *(0.0,) * _STEPS):
            score = self.score(pose, width_m)
            step = step_to_maximum(score.paired + _PRIOR, score.gradient)
            pose = pose.displaced(step)
            if not width_m and np.abs(step).max() < _CHANGE:
                break
        return self.score(pose, 0.0), pose

    def score(self, pose: Pose, width_m: float) -> _Score:
        """Return derivatives at a pose, with mixtures widened by a standard deviation [m]."""
        turned, offsets, precisions, logs = self._compared(pose, width_m)
        shares, values = self._shares(logs)
        pulls = np.matmul(precisions, offsets[..., None])[..., 0]
        # An error of the pose moves candidates by its shift and by the turn times their offset.
        slopes = np.concatenate([pulls, cross(turned, pulls)], axis=1)
        gradients = self.of_user.sum(shares[:, None] * slopes)
        weights = shares * self.of_user.repeat(self.weights)
        lost = slopes.T @ (weights[:, None] * slopes) - (
            gradients.T @ (self.weights[:, None] * gradients))
        (likely,) = np.nonzero(shares > _SHARE)
        places_m, covariances = self._places(likely, offsets, precisions)
        weights, precisions = weights[likely], precisions[likely]
        crosses = cross(np.eye(3), (places_m - pose.origin)[:, None])
        moves = np.concatenate([np.broadcast_to(np.eye(3), crosses.shape), crosses], axis=1)
        paired = np.tensordot(weights, moves @ precisions @ np.swapaxes(moves, 1, 2), axes=1)
        # The mean of `paired` over the errors of the places, less that without them.
        both = np.tensordot(weights[:, None, None] * covariances, precisions, axes=(0, 0))
        noise = np.zeros((6, 6))
        noise[3:, 3:] = np.einsum('aki,blj,klij->ab', _CROSS, _CROSS, both)
        return _Score(
            float(self.weights @ values), self.weights @ gradients, paired, lost, noise)

    def value(self, pose: Pose) -> float:
        """Return the log-likelihood of a pose."""
        *_, logs = self._compared(pose, 0.0)
        return float(self.weights @ self._shares(logs)[1])

    def _shares(self, logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the probabilities of pairs, [P], and the log-likelihood for each user, [N]."""
        highest = np.maximum(self.of_user.max(logs), self.log_outlier)
        densities = np.exp(logs - self.of_user.repeat(highest))
        totals = self.of_user.sum(densities) + np.exp(self.log_outlier - highest)
        return densities / self.of_user.repeat(totals), highest + np.log(totals)

    def _compared(self, pose: Pose, width_m: float) -> tuple[np.ndarray, ...]:
        """Compare the candidates of all pairs for a pose.

        Returns candidates of the other surface relative to it and the offsets from them, in the
        frame of the site, [P, 3], the precisions of the offsets, [P, 3, 3], and log-weights [P].
        """
        turned = pose.vectors_to_site(self.local_m)
        offsets = self.means_m - turned - pose.origin
        covariances = self.covariances + pose.covariances_to_site(self.local_covariances)
        precisions, log_dets = _inverses(covariances + width_m**2 * np.eye(3))
        logs = (self.log_weights - likelihood_loss(offsets, precisions) - log_dets / 2
                - 1.5 * np.log(2 * np.pi))
        return turned, offsets, precisions, logs

    def _places(self, rows: np.ndarray, offsets: np.ndarray, precisions: np.ndarray
                ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean [T, 3] and covariance [T, 3, 3] of the positions that pairs agree on."""
        covariances = self.covariances[rows]
        gains = covariances @ precisions[rows]
        means_m = self.means_m[rows] - np.matmul(gains, offsets[rows, :, None])[..., 0]
        return means_m, covariances - gains @ covariances
