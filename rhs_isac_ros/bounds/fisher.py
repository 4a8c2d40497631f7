"""The Cramer-Rao lower bound of positioning and what it is made of."""

import functools
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.los import checked_positions, los_derivative
from rhs_isac_ros.model.multipath import (
    frequency_correlation,
    multipath_covariance,
    time_correlation,
)
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, radiation_matrix

_BLOCK = 256
# Pivot of a normalised matrix that rounding alone may make.
_SINGULAR = 1e-14


class Factors(NamedTuple):
    """What the bounds and the likelihood need of a codebook, whatever the position.

    Attributes
    ----------
    patterns
        T_i, complex128 [N_B, N_SB F, N_E].
    whiteners
        L_i^-1 with L_i L_i^H = Lambda_i, lower triangular, complex128 [N_B, N_SB F, N_SB F].
    """

    patterns: np.ndarray
    whiteners: np.ndarray


def factor(scenario: Scenario, codebook: Beamforming) -> Factors:
    """Compute what depends on the codebook alone.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.

    Returns
    -------
    Factors
        Patterns and whitening matrices, for all calls with the same codebook.
    """
    patterns = radiation_matrix(scenario, codebook)
    return Factors(patterns, whitening_matrices(scenario, patterns))


def crlb(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray,
        factors: Factors | None = None) -> np.ndarray:
    """Implements Eq. (11). Cramer-Rao lower bound of the squared positioning error.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.
    positions
        Positions of the user, float64 [N, 3] [m].
    factors
        What `factor` returns for the codebook, if it is at hand.

    Returns
    -------
    numpy.ndarray
        Float64 [N] [m^2]; infinite where the signals do not determine the position.

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    information = fisher_information(scenario, codebook, positions, factors)
    return np.trace(inverse_information(information), axis1=1, axis2=2)


def inverse_information(information: np.ndarray) -> np.ndarray:
    """Invert Fisher information matrices.

    Parameters
    ----------
    information
        Float64 [N, 3, 3] [1/m^2].

    Returns
    -------
    numpy.ndarray
        Float64 [N, 3, 3] [m^2]; infinite on the diagonal where a matrix is singular.
    """
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    # With ones on the diagonal, rounding is the same whatever the units and directions.
    scale = scale[:, :, None] * scale[:, None, :]
    normal = information / scale
    # L D L^T by hand: as accurate as the condition allows, and much faster than a call for each.
    first, third = normal[:, 1, 0], normal[:, 2, 0]
    pivot = 1.0 - first**2
    regular = (diagonal > 0).all(axis=1) & (pivot > _SINGULAR)
    pivot = np.where(regular, pivot, 1.0)
    second = (normal[:, 2, 1] - first * third) / pivot
    last = normal[:, 2, 2] - third**2 - second**2 * pivot
    regular &= last > _SINGULAR * (1 + second**2)
    last = np.where(regular, last, 1.0)
    root = np.zeros_like(normal)
    root[:, 0, 0] = 1.0
    root[:, 1, 0], root[:, 1, 1] = -first, 1.0
    root[:, 2, 0], root[:, 2, 1], root[:, 2, 2] = first * second - third, -second, 1.0
    root[:, 1] /= np.sqrt(pivot)[:, None]
    root[:, 2] /= np.sqrt(last)[:, None]
    inverse = np.matmul(np.swapaxes(root, 1, 2), root) / scale
    inverse[~regular] = np.diag([np.inf] * 3)
    return inverse


def fisher_information(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray,
        factors: Factors | None = None) -> np.ndarray:
    """Implements Eq. (12). Fisher information of the received signals about the position.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.
    positions
        Positions of the user, float64 [N, 3] [m].
    factors
        What `factor` returns for the codebook, if it is at hand.

    Returns
    -------
    numpy.ndarray
        I_FIM, float64 [N, 3, 3] [1/m^2].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    positions = checked_positions(positions)
    factors = factors or factor(scenario, codebook)
    information = np.zeros((len(positions), 3, 3))
    for start in range(0, len(positions), _BLOCK):
        block = slice(start, start + _BLOCK)
        for band, (pattern, whitener) in enumerate(zip(*factors, strict=True)):
            slopes = los_derivative(scenario, positions[block], band)
            whitened = mean_derivative(slopes, pattern) @ whitener.T
            information[block] += information_of(whitened)
    return information


def information_of(whitened: np.ndarray) -> np.ndarray:
    """One band's share of Eq. (12), from the whitened derivatives of its mean.

    Parameters
    ----------
    whitened
        L^-1 dy_i/dp with L L^H = Lambda_i, complex128 [N, G, N_SB F] [1/m].

    Returns
    -------
    numpy.ndarray
        Float64 [N, G, G] [1/m^2]; G is 3.
    """
    # Re(a^H b) is the inner product of real and imaginary parts.
    parts = np.ascontiguousarray(whitened).view(float)
    return 2 * np.matmul(parts, np.swapaxes(parts, 1, 2))


def mean_derivative(slopes: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Implements Eq. (13). Derivative of one band's mean signal by the position.

    Parameters
    ----------
    slopes
        Derivative of the line-of-sight gains, complex128 [N, G, N_SB, N_E] [1/m]; G is 3. Other
        functions of the gains are possible, in any number.
    pattern
        T_i, complex128 [N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        Complex128 [N, G, N_SB F] [1/m], sub-band-major.
    """
    n, n_rows, n_subbands, n_elements = slopes.shape
    frames = pattern.reshape(n_subbands, -1, n_elements)
    # One matrix product a sub-band: [G N, N_E] with [N_E, F].
    stacked = np.moveaxis(slopes, 2, 0).reshape(n_subbands, n_rows * n, n_elements)
    products = np.matmul(stacked, np.swapaxes(frames, 1, 2))
    return np.moveaxis(products, 0, 1).reshape(n, n_rows, -1)


def covariance(scenario: Scenario, patterns: np.ndarray) -> np.ndarray:
    """Implements Eq. (14). Covariance of the received signals; independent of the position.

    Parameters
    ----------
    scenario
        The scenario.
    patterns
        T_i of every band, complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        Lambda_i, complex128 [N_B, N_SB F, N_SB F] [W].
    """
    spatial = multipath_covariance(scenario)
    scattered = np.matmul(np.matmul(patterns, spatial), np.conj(np.swapaxes(patterns, 1, 2)))
    noise = scenario.noise_power_w * np.eye(patterns.shape[1])
    return measurement_correlation(scenario) * scattered + noise


def whitening_matrices(scenario: Scenario, patterns: np.ndarray) -> np.ndarray:
    """Matrices that make the received signals' covariance the identity.

    Parameters
    ----------
    scenario
        The scenario.
    patterns
        T_i of every band, complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        L_i^-1 with L_i L_i^H = Lambda_i, lower triangular, complex128 [N_B, N_SB F, N_SB F].
    """
    return np.linalg.inv(np.linalg.cholesky(covariance(scenario, patterns)))


@functools.lru_cache(maxsize=16)
def correlation_matrices(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Implements Eq. (15). Correlation of the multipath over sub-bands and over frames.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    tuple of numpy.ndarray
        K_f, complex128 [N_B, N_SB, N_SB], and K_t, float64 [N_B, F, F]; read-only.
    """
    subbands, frames = np.arange(scenario.n_subbands), np.arange(scenario.n_frames)
    bands = range(scenario.n_bands)
    over_frequency = np.stack(
        [frequency_correlation(scenario, i, subbands[:, None], subbands) for i in bands])
    over_time = np.stack([time_correlation(scenario, i, frames[:, None], frames) for i in bands])
    over_frequency.flags.writeable = over_time.flags.writeable = False
    return over_frequency, over_time


@functools.lru_cache(maxsize=16)
def measurement_correlation(scenario: Scenario) -> np.ndarray:
    """Correlation of the multipath over all measurements of a band: the paper's K_ft.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    numpy.ndarray
        Complex128 [N_B, N_SB F, N_SB F], read-only.
    """
    pairs = zip(*correlation_matrices(scenario), strict=True)
    correlation = np.stack([np.kron(over_f, over_t) for over_f, over_t in pairs])
    correlation.flags.writeable = False
    return correlation
