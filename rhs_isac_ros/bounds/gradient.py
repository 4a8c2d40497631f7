"""The average bound over many positions and its gradients, in closed form."""

from collections.abc import Iterator

import numpy as np

from rhs_isac_ros.bounds.fisher import (
    factor,
    information_of,
    inverse_information,
    mean_derivative,
    measurement_correlation,
)
from rhs_isac_ros.model.los import checked_positions, los_derivative
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix

# Positions a block, and the memory that the derivatives of all blocks may keep.
_BLOCK = 128
_CACHE_BYTES = 1 << 30


def average_crlb(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Average bound over positions, Eq. (18), with its gradients by Propositions 2 and 3.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.
    positions
        Positions of the user, float64 [N, 3] [m].

    Returns
    -------
    value : float
        Average CRLB [m^2].
    grad_analog : numpy.ndarray
        Derivative by C, float64 [N_B, F, N_E] [m^2].
    grad_digital : numpy.ndarray
        d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K] [m^2/sqrt(W)].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    return AverageCrlb(scenario, positions)(codebook)


class AverageCrlb:
    """Average bound at fixed positions, to be evaluated for many codebooks.

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Positions of the user, float64 [N, 3] [m].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array, or holds no position.
    """

    def __init__(self, scenario: Scenario, positions: np.ndarray) -> None:
        self.scenario = scenario
        self.positions = checked_positions(positions)
        if not len(self.positions):
            raise ValueError('positions: none given, expected at least one')
        per_position = 3 * 16 * scenario.n_bands * scenario.n_subbands * scenario.n_elements
        keep = per_position * len(self.positions) <= _CACHE_BYTES
        self._kept = list(self._compute_blocks()) if keep else None

    def __call__(self, codebook: Beamforming) -> tuple[float, np.ndarray, np.ndarray]:
        """Evaluate the average bound and its gradients.

        Parameters
        ----------
        codebook
            Analog and digital beamforming.

        Returns
        -------
        tuple
            Value [m^2], grad_analog [N_B, F, N_E], grad_digital [N_B, N_SB, F, K], as
            `average_crlb` gives them.
        """
        patterns, whiteners = factor(self.scenario, codebook)
        total = 0.0
        by_mean = np.zeros_like(patterns)
        spread = np.zeros_like(whiteners)
        for slopes in self._kept or self._compute_blocks():
            total += _accumulate(slopes, patterns, whiteners, by_mean, spread)
        by_covariance = np.matmul(
            np.conj(measurement_correlation(self.scenario)) * spread,
            np.matmul(patterns, multipath_covariance(self.scenario)))
        by_pattern = 4 * (by_covariance - by_mean) / len(self.positions)
        return (total / len(self.positions),
                gradient_analog(self.scenario, codebook, by_pattern),
                gradient_digital(self.scenario, codebook, by_pattern))

    def _compute_blocks(self) -> Iterator[list[np.ndarray]]:
        """Derivatives of the line of sight, block after block: [n, 3, N_SB, N_E] for each band."""
        for start in range(0, len(self.positions), _BLOCK):
            block = self.positions[start:start + _BLOCK]
            # Sub-bands first in memory, so that every matrix product reads one run of it.
            yield [np.moveaxis(np.ascontiguousarray(np.moveaxis(
                los_derivative(self.scenario, block, band), 2, 0)), 0, 2)
                for band in range(self.scenario.n_bands)]


def _accumulate(
        slopes: list[np.ndarray], patterns: np.ndarray, whiteners: np.ndarray,
        by_mean: np.ndarray, spread: np.ndarray) -> float:
    """Add one block's share of the value and of its derivative by the patterns.

    With M = I_FIM^-2, zeta = Lambda^-1 dy/dp and w = M zeta: `by_mean` collects the sum of
    w conj(H-dot), and `spread` that of w zeta^H.
    """
    derivatives = [mean_derivative(*pair) for pair in zip(slopes, patterns, strict=True)]
    whitened = [d @ w.T for d, w in zip(derivatives, whiteners, strict=True)]
    inverse = inverse_information(sum(information_of(w) for w in whitened))
    # Where the signals do not determine the position, the value is infinite and has no slope.
    finite = np.where(np.isfinite(inverse).all(axis=(1, 2), keepdims=True), inverse, 0.0)
    squared = np.matmul(finite, finite)
    for band, whitener in enumerate(whiteners):
        zeta = whitened[band] @ np.conj(whitener)
        weighted = np.matmul(squared, zeta)
        rows = zeta.shape[-1]
        spread[band] += weighted.reshape(-1, rows).T @ np.conj(zeta.reshape(-1, rows))
        by_mean[band] += _outer_with_slopes(weighted, slopes[band])
    return float(np.trace(inverse, axis1=1, axis2=2).sum())


def _outer_with_slopes(weighted: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Sum over positions and coordinates of w conj(H-dot), row by row: [N_SB F, N_E]."""
    n, _, n_subbands, n_elements = slopes.shape
    stacked = np.moveaxis(slopes, 2, 0).reshape(n_subbands, 3 * n, n_elements)
    weights = np.conj(weighted).reshape(3 * n, n_subbands, -1).transpose(1, 2, 0)
    return np.conj(np.matmul(weights, stacked)).reshape(-1, n_elements)


def gradient_analog(
        scenario: Scenario, codebook: Beamforming, by_pattern: np.ndarray) -> np.ndarray:
    """Implements Proposition 2. Derivative by the configurations C_i.

    The paper writes the chain rule out for every pair of coordinates; here the pairs are summed
    first, in the derivative by T_i.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.
    by_pattern
        Derivative of the objective by T_i (d/dRe + i d/dIm), complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        Float64 [N_B, F, N_E].
    """
    weights = np.matmul(codebook.digital, onboard_matrix(scenario))
    by_pattern = by_pattern.reshape(weights.shape)
    return np.einsum('ijqm,ijqm->iqm', np.conj(by_pattern), weights).real


def gradient_digital(
        scenario: Scenario, codebook: Beamforming, by_pattern: np.ndarray) -> np.ndarray:
    """Implements Proposition 3. Derivative by the combining vectors S_{i,j}.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.
    by_pattern
        Derivative of the objective by T_i (d/dRe + i d/dIm), complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        d/dRe + i d/dIm, complex128 [N_B, N_SB, F, K].
    """
    onboard = onboard_matrix(scenario)
    n_bands, n_subbands, _, n_elements = onboard.shape
    by_pattern = by_pattern.reshape(n_bands, n_subbands, -1, n_elements)
    weighted = by_pattern * codebook.analog[:, None]
    return np.matmul(weighted, np.conj(np.swapaxes(onboard, 2, 3)))
