"""What an estimator returns, and what it must offer."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario

# Far above any received power [sqrt(W)]; its square still fits single precision after whitening.
_LARGEST = 1e3


class SignalError(ValueError):
    """Received signals cannot be used: wrong shape or not finite."""


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate:
    """Position and its uncertainty, or that there is none.

    Attributes
    ----------
    mean
        Position, float64 [3] or [N, 3] [m]; NaN where the signals tell none.
    covariance
        Its covariance, float64 [3, 3] or [N, 3, 3] [m^2]; NaN where there is no position.
    reason
        Why there is no position, and empty where there is one: a string, or N of them.
    """

    mean: np.ndarray
    covariance: np.ndarray
    reason: str | tuple[str, ...] = ''

    @property
    def fix(self) -> np.ndarray:
        """Whether there is a position, bool [] or [N]."""
        return np.isfinite(self.mean).all(axis=-1)


class Estimator(Protocol):
    """An estimator of positions, made for one scenario and codebook."""

    name: str

    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals.

        Parameters
        ----------
        received
            Complex128 [N_B, N_SB F], or [N, N_B, N_SB F] for N positions; sub-band-major.

        Returns
        -------
        Estimate
            With a leading N if the signals have one; without a position where they tell none.

        Raises
        ------
        SignalError
            If the shape is another one or a value is not finite.
        """
        ...


def estimate_each(
        scenario: Scenario, codebook: Codebook, received: np.ndarray,
        locate: Callable[[np.ndarray], Iterable[tuple[np.ndarray, np.ndarray, str]]]) -> Estimate:
    """Check signals, locate every phase, and give the result the form of the signals.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook they were taken with.
    received
        Complex128 [N_B, N_SB F] or [N, N_B, N_SB F].
    locate
        Function of checked signals [N, N_B, N_SB F] that yields mean, covariance and reason of
        each of them; if there is a reason, the others do not count.

    Returns
    -------
    Estimate
        With a leading N if the signals have one.

    Raises
    ------
    SignalError
        If the shape is another one or a value is not finite.
    """
    batch = checked_received(scenario, codebook, received)
    mean, covariance = np.full((len(batch), 3), np.nan), np.full((len(batch), 3, 3), np.nan)
    reasons = []
    for row, (position, spread, reason) in enumerate(locate(batch)):
        reasons.append(reason)
        if not reason:
            mean[row], covariance[row] = position, spread
    if np.ndim(received) == 2:
        return Estimate(mean[0], covariance[0], reasons[0])
    return Estimate(mean, covariance, tuple(reasons))


def checked_received(scenario: Scenario, codebook: Codebook, received: np.ndarray) -> np.ndarray:
    """Return received signals as [N, N_B, N_SB F] after checking them.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook they were taken with; fixes the shape.
    received
        Complex128 [N_B, N_SB F] or [N, N_B, N_SB F].

    Returns
    -------
    numpy.ndarray
        Complex128 [N, N_B, N_SB F].

    Raises
    ------
    SignalError
        If the shape is another one, or a value is not finite or absurdly large.
    """
    try:
        received = np.asarray(received, dtype=complex)
    except (TypeError, ValueError) as error:
        raise SignalError(f'received: {error}, expected complex numbers') from None
    n_bands, n_subbands, n_frames, _, _ = codebook.shape
    expected = (n_bands, n_subbands * n_frames)
    if received.ndim not in (2, 3) or received.shape[-2:] != expected:
        raise SignalError(
            f'received: shape {received.shape}, expected [N_B, N_SB F] = {expected}, '
            'or more of them')
    if not np.isfinite(received).all():
        raise SignalError('received: not finite, expected finite signals')
    if received.size and np.abs(received).max() > _LARGEST:
        raise SignalError(
            f'received: {np.abs(received).max():g}, expected magnitudes up to {_LARGEST:g}')
    return received.reshape(-1, *expected)
