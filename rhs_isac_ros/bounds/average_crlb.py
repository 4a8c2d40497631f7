"""The average bound over many positions."""

import numpy as np

from rhs_isac_ros.bounds.average import Average, Gradient
from rhs_isac_ros.bounds.fisher import inverse_information
from rhs_isac_ros.model.los import checked_positions, los_derivative
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming


def average_crlb(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray) -> Gradient:
    """Average bound over positions, Eq. (17), with its gradients by Propositions 2 and 3.

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
    Gradient
        A tuple: average CRLB [m^2]; derivative by C, float64 [N_B, F, N_E] [m^2]; and
        d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K] [m^2/sqrt(W)].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    return AverageCrlb(scenario, positions)(codebook)


class AverageCrlb(Average):
    """Average bound at fixed positions, to be evaluated for many codebooks.

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Positions of the user, float64 [N, 3] [m].
    tolerance
        Relative error of the line-of-sight derivatives, see `CompressedRows`; 0 for exact ones.

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array, or holds no position.
    """

    def __init__(
            self, scenario: Scenario, positions: np.ndarray, tolerance: float = 0.0) -> None:
        self.positions = checked_positions(positions)
        if not len(self.positions):
            raise ValueError('positions: none given, expected at least one')
        super().__init__(
            scenario,
            lambda start, stop, band: los_derivative(
                scenario, self.positions[start:stop], band),
            len(self.positions), 3, _bound, tolerance)


def _bound(block: slice, information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trace of the inverse, and minus its derivative."""
    inverse = inverse_information(information)
    values = np.trace(inverse, axis1=1, axis2=2)
    # Where the signals do not determine the position, the value is infinite and has no slope.
    finite = np.where(np.isfinite(values)[:, None, None], inverse, 0.0)
    return values, np.matmul(finite, finite)
