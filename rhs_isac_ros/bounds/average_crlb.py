"""Average Cramer-Rao bound over positions."""

import numpy as np

from rhs_isac_ros.bounds.average import Average, Combination, Gradient
from rhs_isac_ros.bounds.fisher import inverse_information
from rhs_isac_ros.bounds.measurement_rows import Pattern
from rhs_isac_ros.bounds.nuisance import marginal_information, region_information
from rhs_isac_ros.model.los import checked_positions, los_and_derivative, los_derivative
from rhs_isac_ros.model.nuisance import nuisance_parameters, nuisance_patterns
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

    Nuisance parameters and errors of the elements are taken into account as `crlb` does.

    Parameters
    ----------
    tolerance
        Relative error of the rows, see `CompressedRows`; 0 selects exact ones.
    region_prior
        Whether to add the information of the region of interest, as `crlb` does.

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array or holds no position, or the tolerance is
        neither 0 nor large enough.
    """

    def __init__(self, scenario: Scenario, positions: np.ndarray, tolerance: float = 0.0, *,
                 region_prior: bool = False) -> None:
        self.positions = checked_positions(positions)
        if not len(self.positions):
            raise ValueError('positions: none given, expected at least one')
        self._prior = region_information(scenario) if region_prior else np.zeros((3, 3))
        if not nuisance_parameters(scenario):
            super().__init__(
                scenario,
                lambda block, band: los_derivative(scenario, self.positions[block], band),
                len(self.positions), 3, self._trace_of_inverse, tolerance)
            return
        patterns, combination = _structure(scenario)

        def source(block: slice, band: int) -> np.ndarray:
            gain, derivative = los_and_derivative(scenario, self.positions[block], band)
            return np.concatenate([derivative, *[gain[:, None]] * len(patterns)], axis=1)

        super().__init__(
            scenario, source, len(self.positions), 3 + len(patterns), self._marginal_trace,
            tolerance, patterns, combination)

    def _trace_of_inverse(
            self, block: slice, information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Trace of the inverse [n] and its negative derivative [n, 3, 3]."""
        inverse = inverse_information(information + self._prior)
        values = np.trace(inverse, axis1=1, axis2=2)
        # Where the signals do not determine the position, the value is infinite and the slope
        # zero.
        finite = np.where(np.isfinite(values)[:, None, None], inverse, 0.0)
        return values, np.matmul(finite, finite)

    def _marginal_trace(
            self, block: slice, joint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Trace of the bound [n] and its negative derivative [n, 3 + Q, 3 + Q]."""
        values, by_marginal = self._trace_of_inverse(block, marginal_information(joint))
        # The Schur complement is W^T J W with W = [I; -(D + I)^-1 B^T] held fixed, because W
        # minimises it.
        regression = -np.linalg.solve(
            joint[:, 3:, 3:] + np.eye(joint.shape[1] - 3), joint[:, 3:, :3])
        identity = np.broadcast_to(np.eye(3), (len(joint), 3, 3))
        whole = np.concatenate([identity, regression], axis=1)
        return values, whole @ by_marginal @ np.swapaxes(whole, 1, 2)


def _structure(scenario: Scenario) -> tuple[list[Pattern], Combination]:
    """Rows of position and nuisance parameters from those of the derivative and of the gain.

    A parameter whose pattern is constant in each band multiplies the row of the gain; any other
    one has a row of its own.
    """
    parameters, all_patterns = nuisance_parameters(scenario), nuisance_patterns(scenario)
    patterns: list[Pattern] = [(slice(0, 4), None)]
    index, scale = [0, 1, 2], np.ones((scenario.n_bands, 3 + len(parameters)), complex)
    for row, (parameter, pattern) in enumerate(zip(parameters, all_patterns, strict=True), 3):
        if np.ptp(pattern, axis=1).any():
            index.append(3 + len(patterns))
            patterns.append((slice(index[-1], index[-1] + 1), pattern))
            scale[:, row] = parameter.std
        else:
            index.append(3)
            scale[:, row] = parameter.std * pattern[:, 0]
    return patterns, Combination(np.array(index), scale)
