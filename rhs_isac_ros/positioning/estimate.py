"""The interface of estimators: received signals in, positions with their uncertainty out."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Pose
from rhs_isac_ros.model.arrays import numbers, position_problem
from rhs_isac_ros.model.gaussian import symmetric
from rhs_isac_ros.positioning.mixture import Mixture, with_velocities
from rhs_isac_ros.positioning.sheets import Sheets
from rhs_isac_ros.support.fields import finite
from rhs_isac_ros.support.plugins import PluginError, calling

# Limit far above any received amplitude [sqrt(W)]. The square of a whitened amplitude is still
# finite in single precision.
_MAX_MAGNITUDE = 1e3
# Standard deviation that every coordinate of a position has, so that covariances have inverses.
_MIN_STD_M = 1e-5
# Probability that modes do not contain the position of a user in sight.
MISS_PROBABILITY = 1e-3
_OF_SITE = Pose()
# Frames of an estimate.
SURFACE, SITE = 'surface', 'site'


class SignalError(ValueError):
    """Received signals cannot be used: wrong type or shape, not finite, or too large."""


class Places(NamedTuple):
    """The likelihood of positions outside of the region, relative to the average inside.

    It is the sum of Gaussians and a constant. Positions inside, which may be outside of the region
    of a site, have the `Sighting.mixture`.
    """

    gaussians: Mixture  # In the frame of the site, D = 3; log-weights are those of integrals.
    log_rest: float  # Logarithm of the constant.
    # Largest range of positions, whose prior is uniform in range and solid angle [m].
    farthest_m: float
    log_volume: float  # Logarithm of the volume of the region [m^3].


@dataclasses.dataclass(frozen=True, eq=False)
class Sighting:
    """What the signals of one surface say about a position, for a user in the region.

    Raises ValueError if `missing` is not between 0 and 1.
    """

    pose: Pose
    #: Likelihood as a density with moments in the frame of the site, D = 3, as if the pose were
    #: exact; D = 6, with the declared density of velocities, if users move. With `sheets`, the
    #: moments are those in the region. Without, its Gaussians touch the sheets at their maxima.
    mixture: Mixture
    #: Probability that the mixture does not contain the position of the user.
    missing: float = MISS_PROBABILITY
    sheets: Sheets | None = None  #: The likelihood around the surface, without limits.
    #: Logarithms of likelihoods relative to a user in the region and in sight, whatever the prior
    #: probabilities; NaN if unknown: user outside of the region, no direct path, and signals that
    #: fit no position.
    outside_log_ratio: float = np.nan
    blocked_log_ratio: float = np.nan
    misfit_log_ratio: float = np.nan
    #: Where a user outside may be; None if all places are equally likely.
    places: Places | None = None
    #: Bounds of the region of the surface in its frame, float64 [2, 3] [m]; by default, those of
    #: the smallest box that contains the region in which the likelihoods are multiplied.
    region_m: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check the probability."""
        if not 0 < finite('missing', self.missing) < 1:
            raise ValueError(f'missing: {self.missing}, expected a probability between 0 and 1')

    @property
    def likelihood(self) -> Sheets:
        """The sheets; raises ValueError if those of the mixture are behind the surface."""
        return self.sheets or Sheets.tangent(self.mixture.position(), self.pose)

    def at(self, pose: Pose) -> 'Sighting':
        """Return what the same signals say if the surface has another pose."""
        if pose == self.pose:
            return self
        places = self.places and self.places._replace(
            gaussians=self.places.gaussians.moved(self.pose, pose))
        return dataclasses.replace(self, pose=pose, places=places,
                                   mixture=self.mixture.moved(self.pose, pose))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Estimate:
    """A position with its uncertainty, or the reason why there is none; or N of these.

    Estimators, tracks, the fusion and sites return estimates. Mean and covariance always apply to
    a user in the region and in sight. ``estimate[n]`` is the n-th of N estimates.
    """

    mean: np.ndarray  #: Position, float64 [3] or [N, 3] [m]; NaN if there is none.
    covariance: np.ndarray  #: Float64 [3, 3] or [N, 3, 3] [m^2]; NaN without a position.
    #: Reason why there is no position, '' if there is one; a string, or N strings.
    reason: str | tuple[str, ...] = ''
    #: Energy of the whitened residual at the best position, float64 [] or [N]; or NaN.
    residual: float | np.ndarray = np.nan
    #: Expected `residual` of signals that match the model, float64 [] or [N]; NaN without one, if
    #: the user may be outside or blocked, or if the signals are weaker than the multipath.
    expected_residual: float | np.ndarray = np.nan
    #: Probability that the user is outside of the region, float64 [] or [N]; NaN if the estimator
    #: assumes a user inside, or if the signals are weaker than noise.
    outside_probability: float | np.ndarray = np.nan
    #: Probability that there is no direct path, float64 [] or [N]; NaN if the estimator assumes a
    #: direct path, or if the signals are weaker than noise.
    blocked_probability: float | np.ndarray = np.nan
    #: Logarithm of the density of the signals of several surfaces for one user, relative to that
    #: for a different user at each surface, float64 [] or [N]; NaN for one surface.
    log_agreement: float | np.ndarray = np.nan
    #: Velocity, float64 [..., 3] [m/s], its covariance, [..., 3, 3], and its covariance with the
    #: position (rows), [..., 3, 3] [m^2/s]; NaN unless users move or a track returns the estimate.
    velocity: np.ndarray = dataclasses.field(default_factory=lambda: np.full(3, np.nan))
    velocity_covariance: np.ndarray = dataclasses.field(
        default_factory=lambda: np.full((3, 3), np.nan))
    cross_covariance: np.ndarray = dataclasses.field(
        default_factory=lambda: np.full((3, 3), np.nan))
    #: Number of phases of the track in the estimate, int [] or [N]; 0 without a track.
    n_phases: int | np.ndarray = 0
    #: Whether the position is a prediction for a blocked user, bool [] or [N].
    is_predicted: bool | np.ndarray = False
    #: Whether a mode beside the prior explains the signals better than all modes near it.
    is_elsewhere: bool | np.ndarray = False
    #: The `mixture`, or a function that returns it. This and the next two fields are tuples of N
    #: for N estimates.
    density: Callable[[], Mixture] | Mixture | None = None
    #: Posterior without regard to the limits of the region, from which a track continues.
    unbounded: Mixture | None = None
    #: The `sighting`, or a function that returns it.
    see: Callable[[], Sighting] | Sighting | None = None
    frame: str = SURFACE  #: ``surface`` or ``site``: the frame of the mean and the velocity.

    def __post_init__(self) -> None:
        """Raise PluginError, a ValueError, unless the shapes of mean and covariance agree."""
        mean = numbers('mean', self.mean, error=PluginError, shapes=[(3,), ('N', 3)], finite=False)
        covariance = numbers('covariance', self.covariance, error=PluginError,
                             shapes=[(*mean.shape, 3)], finite=False)
        object.__setattr__(self, 'mean', mean)
        object.__setattr__(self, 'covariance', covariance)

    def __repr__(self) -> str:
        """Return position, standard deviations and reason, or how many of N have a position."""
        if self.mean.ndim > 1:
            n_fixes = int(np.isfinite(self.mean[:, 0]).sum())
            return f'<{len(self.mean)} estimates, {n_fixes} with a position>'
        std = np.sqrt(np.diagonal(self.covariance))
        return f'Estimate(mean={self.mean}, std={std}, reason={self.reason!r})'

    @property
    def mixture(self) -> Mixture | None:
        """Posterior, normalised, in the frame of the site.

        Its moments are mean and covariance, except for `ml` without a prior, whose mean is the
        most likely position, and whose covariance is the mean squared error about it.
        None without a position, and unless `posterior`, a track, `fuse` or a site returned the
        estimate. D = 6 with velocities. It is computed when it is first read. N estimates have a
        tuple of N.
        """
        return self._computed('density')

    @property
    def sighting(self) -> Sighting | None:
        """What the signals of one shot alone say; None unless `posterior` returned the estimate.

        Without a position, it is None, too, unless the reason is a user outside of the region,
        which is evidence. N estimates have a tuple of N.
        """
        return self._computed('see')

    def _computed(self, name: str) -> Any:
        """Return the value of a field that may be a function, or N values."""
        if isinstance(self.reason, tuple):
            return tuple(self[n]._computed(name) for n in range(len(self.reason)))
        value = getattr(self, name)
        return value() if callable(value) else value

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields for a copy or a pickle, with values in place of functions."""
        return {**vars(self), 'density': self.mixture, 'see': self.sighting}

    @classmethod
    def without_fix(cls, reason: str, **statistics: Any) -> 'Estimate':
        """Return an estimate of one shot that has a reason in place of a position."""
        return cls(np.full(3, np.nan), np.full((3, 3), np.nan), reason, **statistics)

    @classmethod
    def of_each(cls, estimates: Sequence['Estimate'], frame: str = SURFACE) -> 'Estimate':
        """Combine the estimates of N shots."""
        shapes = {name: (3, 3)[:2 - (name in ('mean', 'velocity'))] for name in (
            'mean', 'covariance', 'velocity', 'velocity_covariance', 'cross_covariance')}
        found: dict[str, Any] = {}
        for field in dataclasses.fields(cls):
            values = [getattr(one, field.name) for one in estimates]
            if field.name in _OBJECTS:
                found[field.name] = tuple(values)
            elif field.name != 'frame':
                found[field.name] = np.reshape(
                    np.array(values), (len(values), *shapes.get(field.name, ())))
        return cls(**found, frame=estimates[0].frame if estimates else frame)

    def __getitem__(self, n: int) -> 'Estimate':
        """Return one of several estimates."""
        return type(self)(**{
            field.name: getattr(self, field.name)[n] for field in dataclasses.fields(self)
            if field.name != 'frame'}, frame=self.frame)

    @property
    def joint_covariance(self) -> np.ndarray:
        """Covariance of position and velocity, float64 [..., 6, 6] [m, m/s]."""
        cross = self.cross_covariance
        return np.concatenate([
            np.concatenate([self.covariance, cross], axis=-1),
            np.concatenate([np.swapaxes(cross, -1, -2), self.velocity_covariance], axis=-1)],
            axis=-2)

    @property
    def fix(self) -> np.ndarray:
        """Whether there is a position, bool [] or [N]."""
        return np.isfinite(self.mean).all(axis=-1)

    def with_velocities(self, others: Sequence[Mixture], variance: np.ndarray) -> 'Estimate':
        """Add those of the mixtures that have velocities; see the function `with_velocities`."""
        moving = [one for one in others if one.means.shape[1] > 3]
        if not moving or self.mixture is None:
            return self
        return self.described(with_velocities(self.mixture, moving, variance))

    def described(self, mixture: Mixture, pose: Pose = _OF_SITE) -> 'Estimate':
        """Return the estimate with a mixture and its moments, in the frame of a surface."""
        mean, covariance = mixture.moments()
        found = dataclasses.replace(
            self, mean=pose.to_surface(mean[:3]), density=mixture,
            covariance=pose.covariances_to_surface(covariance[:3, :3]))
        if len(mean) == 3:
            return found
        return dataclasses.replace(
            found, velocity=pose.vectors_to_surface(mean[3:]),
            velocity_covariance=pose.covariances_to_surface(covariance[3:, 3:]),
            cross_covariance=pose.covariances_to_surface(covariance[:3, 3:]))

    def to_site(self, pose: Pose) -> 'Estimate':
        """Convert from the frame of a surface to that of the site, with the errors of its pose.

        The errors also widen the `mixture`.
        """
        if isinstance(self.reason, tuple):
            return self.of_each([self[n].to_site(pose) for n in range(len(self.reason))], SITE)
        mean, velocity = pose.to_site(self.mean), pose.vectors_to_site(self.velocity)
        spread = pose.scatter(mean)

        def widened() -> Mixture:
            assert self.mixture is not None
            return self.mixture.shared(spread)
        return dataclasses.replace(
            self, mean=mean, covariance=pose.covariances_to_site(self.covariance) + spread,
            velocity=velocity, cross_covariance=pose.covariances_to_site(self.cross_covariance),
            velocity_covariance=pose.covariances_to_site(
                self.velocity_covariance) + pose.spread_of_vectors(velocity),
            density=self.density and widened, frame=SITE)


# Sizes of the numbers in an estimate, apart from its position; see `Estimate`.
_SIZES: dict[str, tuple[int, ...]] = {
    'velocity': (3,), 'velocity_covariance': (3, 3), 'cross_covariance': (3, 3), **dict.fromkeys((
        'residual', 'expected_residual', 'outside_probability', 'blocked_probability',
        'log_agreement', 'n_phases', 'is_predicted', 'is_elsewhere'), ())}
# Fields of an estimate that are no numbers.
_OBJECTS = ('reason', 'density', 'unbounded', 'see')


class Fit(NamedTuple):
    """The posterior of one shot, for a user who is inside the region and in sight."""

    # Of the position [m]; if the velocity is unknown, of both [m, m/s]: float64 [D] and [D, D].
    mean: np.ndarray
    covariance: np.ndarray
    log_evidence: float  # Logarithm of the likelihood averaged over the region.
    # The same, with failures of elements averaged over all surfaces.
    averaged_evidence: float
    residual: float  # Energy of the whitened residual at the best position.
    expected: float  # Expected residual of signals that match the model.
    gain: float  # Gain of the signals at the best position [nepers].
    # Returns the posterior as a mixture in the frame of the surface, and the likelihood.
    describe: Callable[[], tuple[Mixture, Sheets]]


@runtime_checkable
class Estimator(Protocol):
    """An estimator of positions for one scenario and codebook."""

    name: str

    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals; raise `SignalError` if they are unusable.

        The signals are complex128 [N_B, N_SB F], or [N, N_B, N_SB F] for N positions,
        sub-band-major; the estimate has a leading dimension N if the signals have one. An
        estimate in a batch is that of the same shot alone, apart from rounding.
        """
        ...


def estimate_of(estimator: Estimator, received: np.ndarray) -> Estimate:
    """Return the estimate of an estimator; see `Estimator.estimate`.

    Raises SignalError as the estimator does, and PluginError if it raises anything else, or
    returns anything but an `Estimate` with one position for each shot.
    """
    with calling(f'{type(estimator).__name__}.estimate', SignalError):
        found = estimator.estimate(received)
        expected = (*np.shape(received)[:-2], 3)
        if not isinstance(found, Estimate) or found.mean.shape != expected:
            raise PluginError(f'{found!r}, expected an Estimate with means {list(expected)}')
        for name, sizes in _SIZES.items():
            numbers(name, getattr(found, name), error=PluginError, finite=False,
                    shapes=[sizes, (*expected[:-1], *sizes)])
    return found


def regular(covariances: np.ndarray) -> np.ndarray:
    """Return symmetric covariances of positions [..., D, D] [m^2] that have an inverse."""
    # In a region without extent along an axis, the variance along it is 0.
    return symmetric(covariances) + _MIN_STD_M**2 * np.eye(covariances.shape[-1])


def estimate_each(
        codebook: Codebook, received: np.ndarray,
        locate: Callable[[np.ndarray], Iterable[Estimate]]) -> Estimate:
    """Check received signals, locate every shot, and return an estimate of matching shape.

    `locate` takes checked signals, [N, N_B, N_SB F], and yields an `Estimate` for each shot. A
    position that no user can have becomes a reason. Raises SignalError if the shape is wrong, a
    value is not a finite number, or a magnitude exceeds 1000.
    """
    found = list(map(_possible, locate(checked_received(codebook, received))))
    return found[0] if np.ndim(received) == 2 else Estimate.of_each(found)


def _possible(estimate: Estimate) -> Estimate:
    """Return an estimate without its position if it has a reason, or if no user can be there."""
    if not isinstance(estimate, Estimate) or estimate.mean.ndim > 1:
        raise PluginError(f'{estimate!r}, expected the Estimate of one position')
    # A network or a plug-in may return any position.
    reason = estimate.reason or ((problem := position_problem(estimate.mean))
                                 and f'position: {problem}')
    if not reason:
        return estimate
    return dataclasses.replace(
        estimate, mean=np.full(3, np.nan), covariance=np.full((3, 3), np.nan), reason=reason)


def checked_received(codebook: Codebook, received: np.ndarray) -> np.ndarray:
    """Return received signals as complex128 [N, N_B, N_SB F], or raise `SignalError`."""
    n_bands, n_subbands, n_frames, _, _ = codebook.shape
    expected = (n_bands, n_subbands * n_frames)
    received = numbers(
        'received', received, complex, SignalError, shapes=[expected, ('N', *expected)])
    if received.size and np.abs(received).max() > _MAX_MAGNITUDE:
        raise SignalError(
            f'received: {np.abs(received).max():g}, expected magnitudes up to {_MAX_MAGNITUDE:g}')
    return received.reshape(-1, *expected)
