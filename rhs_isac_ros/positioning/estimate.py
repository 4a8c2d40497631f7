"""The interface of estimators: received signals in, positions with their uncertainty out."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Pose
from rhs_isac_ros.model.arrays import numbers, position_problem
from rhs_isac_ros.model.gaussian import symmetric

# Limit far above any received amplitude [sqrt(W)]. The square of a whitened amplitude is still
# finite in single precision.
_MAX_MAGNITUDE = 1e3
# Standard deviation that every coordinate of a position has, so that covariances have inverses.
_MIN_STD_M = 1e-5
_EstimateT = TypeVar('_EstimateT', bound='Estimate')


class SignalError(ValueError):
    """Received signals cannot be used: wrong type or shape, not finite, or too large."""


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate:
    """A position with its uncertainty, or the reason why there is none; or N of these.

    Mean and covariance always apply to a user in the region and in sight.
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

    @classmethod
    def without_fix(cls, reason: str, **statistics: float) -> 'Estimate':
        """Return an estimate of one shot that has a reason in place of a position."""
        return cls(np.full(3, np.nan), np.full((3, 3), np.nan), reason, **statistics)

    @classmethod
    def of_each(cls, estimates: Sequence['Estimate']) -> 'Estimate':
        """Combine the estimates of N shots."""
        of = {field.name: [getattr(one, field.name) for one in estimates]
              for field in dataclasses.fields(Estimate)}
        mean, covariance, reason = of.pop('mean'), of.pop('covariance'), of.pop('reason')
        return cls(
            np.reshape(mean, (-1, 3)), np.reshape(covariance, (-1, 3, 3)), tuple(reason),
            **{name: np.array(values, float) for name, values in of.items()})

    @property
    def fix(self) -> np.ndarray:
        """Whether there is a position, bool [] or [N]."""
        return np.isfinite(self.mean).all(axis=-1)

    def to_site(self: _EstimateT, pose: Pose) -> _EstimateT:
        """Convert from the frame of a surface with the given pose to that of the site."""
        return dataclasses.replace(
            self, mean=pose.to_site(self.mean),
            covariance=pose.covariances_to_site(self.covariance))


class Fit(NamedTuple):
    """The posterior of one shot, for a user who is inside the region and in sight."""

    mean: np.ndarray  # Float64 [3] [m].
    covariance: np.ndarray  # Float64 [3, 3] [m^2].
    log_evidence: float  # Logarithm of the likelihood averaged over the region.
    residual: float  # Energy of the whitened residual at the best position.
    expected: float  # Expected residual of signals that match the model.
    gain: float  # Gain of the signals at the best position [nepers].


class Estimator(Protocol):
    """An estimator of positions for one scenario and codebook."""

    name: str

    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals; raise `SignalError` if they are unusable.

        The signals are complex128 [N_B, N_SB F], or [N, N_B, N_SB F] for N positions,
        sub-band-major; the estimate has a leading dimension N if the signals have one. An
        estimate in a batch may differ from the estimate of the same shot alone, but rarely by
        more than a few hundredths of a standard deviation.
        """
        ...


def regular(covariances: np.ndarray) -> np.ndarray:
    """Return symmetric covariances of positions [..., 3, 3] [m^2] that have an inverse."""
    # In a region without extent along an axis, the variance along it is 0.
    return symmetric(covariances) + _MIN_STD_M**2 * np.eye(3)


def estimate_each(
        codebook: Codebook, received: np.ndarray,
        locate: Callable[[np.ndarray], Iterable[Estimate]]) -> Estimate:
    """Check received signals, locate every shot, and return an estimate of matching shape.

    `locate` takes checked signals, [N, N_B, N_SB F], and yields an `Estimate` for each shot. A
    position that no user can have becomes a reason. Raises SignalError if the shape is wrong, a
    value is not a finite number, or a magnitude exceeds 1000.
    """
    found = list(map(_possible, locate(checked_received(codebook, received))))
    if np.ndim(received) == 2:
        return found[0]
    return Estimate.of_each(found)


def _possible(estimate: Estimate) -> Estimate:
    """Return an estimate without its position if it has a reason, or if no user can be there."""
    # A network or a plug-in may return any position.
    reason = estimate.reason or ((problem := position_problem(estimate.mean))
                                 and f'position: {problem}')
    if not reason:
        return estimate
    return dataclasses.replace(
        estimate, mean=np.full(3, np.nan), covariance=np.full((3, 3), np.nan), reason=reason)


def checked_received(codebook: Codebook, received: np.ndarray) -> np.ndarray:
    """Return received signals as complex128 [N, N_B, N_SB F], or raise `SignalError`."""
    received = numbers('received', received, complex, SignalError, finite=False)
    n_bands, n_subbands, n_frames, _, _ = codebook.shape
    expected = (n_bands, n_subbands * n_frames)
    if received.ndim not in (2, 3) or received.shape[-2:] != expected:
        raise SignalError(
            f'received: shape {received.shape}, expected [N_B, N_SB F] = {expected}, '
            'or [N, N_B, N_SB F]')
    if not np.isfinite(received).all():
        raise SignalError('received: not finite, expected finite signals')
    if received.size and np.abs(received).max() > _MAX_MAGNITUDE:
        raise SignalError(
            f'received: {np.abs(received).max():g}, expected magnitudes up to {_MAX_MAGNITUDE:g}')
    return received.reshape(-1, *expected)
