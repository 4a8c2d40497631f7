"""Average Cramer-Rao bound over positions."""

import numpy as np

from rhs_isac_ros.bounds.average import Average, Gradient
from rhs_isac_ros.bounds.fisher import inverse_information
from rhs_isac_ros.model.los import checked_positions, los_derivative
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming


def average_crlb(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray) -> Gradient:
    """Compute the average bound, Eq. (17), with its gradients by Propositions 2 and 3.

    Parameters
    ----------
    positions
        Positions of the user, float64 [N, 3] [m].

    Returns
    -------
    Gradient
        A tuple: average CRLB [m^2]; derivative with respect to C, float64 [N_B, F, N_E] [m^2];
        and d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K] [m^2/sqrt(W)].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array, or holds no position.
    """
    return AverageCrlb(scenario, positions)(codebook)


class AverageCrlb(Average):
    """Average bound at fixed positions, for evaluation with many codebooks.

    Parameters
    ----------
    positions
        Positions of the user, float64 [N, 3] [m].
    tolerance
        Relative error of the line-of-sight derivatives, see `CompressedRows`; 0 for exact ones.

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array or holds no position, or the tolerance is
        neither 0 nor large enough.
    """

    def __init__(
            self, scenario: Scenario, positions: np.ndarray, tolerance: float = 0.0) -> None:
        self.positions = checked_positions(positions)
        if not len(self.positions):
            raise ValueError('positions: none given, expected at least one')
        super().__init__(
            scenario,
            lambda block, band: los_derivative(scenario, self.positions[block], band),
            len(self.positions), 3, _trace_of_inverse, tolerance)


def _trace_of_inverse(block: slice, information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trace of the inverse [n] and its negative derivative [n, 3, 3]."""
    inverse = inverse_information(information)
    values = np.trace(inverse, axis1=1, axis2=2)
    # Where the signals do not determine the position, the value is infinite and the slope zero.
    finite = np.where(np.isfinite(values)[:, None, None], inverse, 0.0)
    return values, np.matmul(finite, finite)
