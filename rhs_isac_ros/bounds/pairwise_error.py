"""Error by confusion of distant positions, which the local Cramer-Rao bound does not include."""

import numpy as np

from rhs_isac_ros.bounds.average import Average
from rhs_isac_ros.model.los import checked_positions, los_gain
from rhs_isac_ros.model.scenario import Scenario


class PairwiseErrorCost(Average):
    """Mean squared error caused by the confusion of pairs of positions.

    A maximum-likelihood decision between two positions is wrong with probability Q(sqrt(q / 2)),
    where q = sum_i dmu_i^H Lambda_i^-1 dmu_i and dmu is the difference of the mean signals. The
    cost is the average of ``|p - p'|^2 Q(sqrt(q / 2))``, in m^2 like the bound. The quadratic
    form is that of Eq. (12), with the difference h(p) - h(p') instead of the derivative.

    Parameters
    ----------
    first_positions, second_positions
        The two positions of each pair, float64 [N, 3] [m].
    weights
        Weights of the pairs, float64 [N]; 1 by default.
    tolerance
        Relative error of the differences, see `CompressedRows`; 0 for exact ones.

    Raises
    ------
    ValueError
        If an argument has a wrong shape or a value that is not finite, there are no pairs, a
        weight is negative, or the tolerance is neither 0 nor large enough.
    """

    def __init__(
            self, scenario: Scenario, first_positions: np.ndarray, second_positions: np.ndarray,
            weights: np.ndarray | None = None, tolerance: float = 0.0) -> None:
        first_positions = checked_positions(first_positions)
        second_positions = checked_positions(second_positions)
        n = len(first_positions)
        if n == 0 or len(second_positions) != n:
            raise ValueError(
                f'second_positions: {len(second_positions)} positions, expected as many as '
                f'first_positions, {n}, and at least one')
        weights = np.ones(n) if weights is None else np.asarray(weights, dtype=float)
        if weights.shape != (n,) or not (weights >= 0).all():
            raise ValueError(
                f'weights: shape {weights.shape}, expected {(n,)}, none negative or NaN')
        self._costs = weights * np.sum((first_positions - second_positions)**2, axis=1)
        super().__init__(
            scenario,
            lambda block, band: (
                los_gain(scenario, first_positions[block], band)
                - los_gain(scenario, second_positions[block], band))[:, None],
            n, 1, self._confusion, tolerance)

    def _confusion(self, block: slice, forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cost times Q(sqrt(q / 2)) [n], and minus its derivative d/d(2 q), [n, 1, 1]."""
        from scipy.special import ndtr

        root = np.sqrt(forms[:, 0, 0])
        costs = self._costs[block]
        # The derivative is undefined for equal signals; the limit keeps it finite.
        slope = np.exp(-root**2 / 8) / (4 * np.sqrt(2 * np.pi) * np.maximum(root, 1e-9))
        return costs * ndtr(-root / 2), (costs * slope)[:, None, None]
