"""The Cramer-Rao lower bound of positioning and what it is made of."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.los import checked_positions, los_derivative
from rhs_isac_ros.model.measurement import mean_derivative, whitening_matrices
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
