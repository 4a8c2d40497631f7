"""How often far positions are taken for one another, which no local bound tells."""

import numpy as np

from rhs_isac_ros.bounds.average import Average
from rhs_isac_ros.model.los import checked_positions, los_gain
from rhs_isac_ros.model.scenario import Scenario


class PairwiseErrorCost(Average):
    """Mean squared error that the confusion of pairs of positions causes.

    With q = sum_i dmu_i^H Lambda_i^-1 dmu_i, dmu being the difference of the mean signals, the
    likelier of two positions is the wrong one with probability Q(sqrt(q / 2)); the average of
    ``|p - p'|^2 Q(sqrt(q / 2))`` is in square metres, as the bound is. The quadratic form is that
    of Eq. (12), with the difference h(p) - h(p') in the place of the derivative.

    Parameters
    ----------
    scenario
        The scenario.
    firsts, seconds
        The two positions of each pair, float64 [N, 3] [m].
    weights
        Weights of the pairs, float64 [N]; by default 1.
    tolerance
        Relative error of the differences, see `CompressedRows`; 0 for exact ones.

    Raises
    ------
    ValueError
        If the positions are not finite [N, 3] arrays of the same length, there are none, or a
        weight is negative or missing.
    """

    def __init__(
            self, scenario: Scenario, firsts: np.ndarray, seconds: np.ndarray,
            weights: np.ndarray | None = None, tolerance: float = 0.0) -> None:
        firsts, seconds = checked_positions(firsts), checked_positions(seconds)
        if not len(firsts) or firsts.shape != seconds.shape:
            raise ValueError(
                f'seconds: {len(seconds)} positions, expected as many as firsts, {len(firsts)}, '
                'and at least one')
        weights = np.ones(len(firsts)) if weights is None else np.asarray(weights, dtype=float)
        if weights.shape != (len(firsts),) or not (weights >= 0).all():
            raise ValueError(
                f'weights: shape {weights.shape}, expected {(len(firsts),)}, none negative or NaN')
        self._costs = weights * np.sum((firsts - seconds)**2, axis=1)
        super().__init__(
            scenario,
            lambda start, stop, band: (
                los_gain(scenario, firsts[start:stop], band)
                - los_gain(scenario, seconds[start:stop], band))[:, None],
            len(firsts), 1, self._confusion, tolerance)

    def _confusion(self, block: slice, forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cost times Q(sqrt(q / 2)), and minus its derivative by the form, which is 2 q."""
        from scipy.special import ndtr

        root = np.sqrt(forms[:, 0, 0])
        costs = self._costs[block]
        # Two equal signals have no slope towards either side.
        slope = np.exp(-root**2 / 8) / (4 * np.sqrt(2 * np.pi) * np.maximum(root, 1e-9))
        return costs * ndtr(-root / 2), (costs * slope)[:, None, None]
