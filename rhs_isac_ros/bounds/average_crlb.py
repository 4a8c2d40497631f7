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

    Takes positions of the user, float64 [N, 3] [m]. The value is in m^2, as is the derivative
    with respect to C; that with respect to S is in m^2/sqrt(W).

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array, or holds no position.
    """
    return AverageCrlb(scenario, positions)(codebook)


class AverageCrlb(Average):
    """Average bound at fixed positions, float64 [N, 3] [m], for evaluation with many codebooks.

    `tolerance` is the relative error of the line-of-sight derivatives, see `CompressedRows`; 0
    selects exact ones.

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
