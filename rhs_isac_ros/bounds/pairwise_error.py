"""Error from confusing distant positions, which the local Cramer-Rao bound does not include.

The phases of the bands may be unknown: theta = A z, where z has the information P of its prior.
The distance between whitened signals is then the minimum over z of ``sum_i 2 |a_i exp(i theta_i) -
b_i|^2 + z^T P z``. For close positions, it agrees with the marginal Fisher information. If the
signals differ only in the phases of their bands, at most the cost ``z^T P z`` remains.
"""

import copy

import numpy as np

from rhs_isac_ros.bounds.average import Average, Combination
from rhs_isac_ros.bounds.rows import CompressedRows, RowSource, Tick, no_tick
from rhs_isac_ros.model.arrays import checked_positions, numbers
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming

# Share of a sample that is drawn uniformly. It limits the weight of a pair whose cost grows while
# the codebook changes.
_UNIFORM_SHARE = 0.05
# Steps of the minimisation over the phases; none increases the distance.
_STEPS = 40


class PairwiseErrorCost(Average):
    """Mean squared error from confusing pairs of positions.

    A maximum-likelihood decision between two positions is wrong with probability Q(sqrt(q / 2)),
    where q = sum_i dmu_i^H Lambda_i^-1 dmu_i and dmu is the difference of the mean signals. The
    cost is the average of ``w |p - p'|^2 Q(sqrt(q / 2))`` [m^2]. Apart from the factor 2, q is the
    quadratic form of Eq. (12), with h(p) - h(p') in place of the derivative. If the scenario
    declares unknown phases, q is minimised over them; other nuisance parameters are not included.
    Takes the positions, float64 [N, 3] [m], and weights w, float64 [N], of N pairs; without
    weights, w = 1.
    `tolerance` and `tick` are the same as in `AverageCrlb`. Raises ValueError if a shape is wrong,
    a position is not finite, a weight is negative or NaN, or there are no pairs.
    """

    def __init__(
            self, scenario: Scenario, first_positions: np.ndarray, second_positions: np.ndarray,
            weights: np.ndarray | None = None, tolerance: float = 0.0,
            tick: Tick = no_tick) -> None:
        first_positions = checked_positions(first_positions)
        second_positions = checked_positions(second_positions)
        n = len(first_positions)
        if n == 0 or len(second_positions) != n:
            raise ValueError(
                f'second_positions: {len(second_positions)} positions, expected as many as '
                f'first_positions, {n}, and at least one')
        weights = np.ones(n) if weights is None else numbers('weights', weights, shapes=[(n,)])
        if weights.min() < 0:
            raise ValueError(f'weights: {weights.min():g}, expected none below 0')
        self._costs = weights * np.sum((first_positions - second_positions)**2, axis=1)
        self._scales, self._precision = nuisance_of(scenario).scaled_phases

        def gains(block: slice, band: int) -> list[np.ndarray]:
            return [_repeated_gain(scenario, first_positions[block], band),
                    los_gain(scenario, second_positions[block], band)]

        if not self._scales.size:
            super().__init__(RowSource(
                scenario, lambda block, band: np.subtract(*gains(block, band))[:, None], n, 1,
                tick=tick), self._confusion, tolerance)
            return
        super().__init__(RowSource(
            scenario, lambda block, band: np.stack(gains(block, band), axis=1), n, 2, tick=tick),
            self._confusion, tolerance, _rows_of_bands(scenario.n_bands))

    def sample(
            self, codebook: Beamforming, n: int, rng: np.random.Generator
    ) -> 'PairwiseErrorCost':
        """Return the cost of n of the pairs, drawn with probabilities that grow with their cost.

        The cost of the sample is an unbiased estimate of the cost of all pairs. It is close for
        this codebook and similar ones, because a few pairs with very similar signals contribute
        most of the cost. Samples are evaluated in single precision. Raises ValueError if n is not
        from 1 to the number of pairs, or if the rows are not compressed.
        """
        total = len(self._costs)
        if not 1 <= n <= total:
            raise ValueError(f'n: {n}, expected 1 to {total}, the number of pairs')
        if not isinstance(self.rows, CompressedRows):
            raise ValueError('differences: not compressed, expected a tolerance above 0 and more '
                             'pairs to draw a sample of')
        costs = self.losses(codebook)
        shares = np.full(total, 1 / total)
        if costs.any():
            shares += (1 - _UNIFORM_SHARE) * (costs / costs.sum() - shares)
        probabilities = _inclusion_probabilities(shares, n)
        # Systematic sampling: no pair occurs twice, because no probability exceeds 1.
        edges = np.cumsum(probabilities)
        edges *= n / edges[-1]
        items = np.searchsorted(edges, np.arange(n) + rng.uniform(), side='right')
        items = np.minimum(items, total - 1)
        sample = copy.copy(self)
        sample.rows = self.rows.chosen(items)
        sample._costs = self._costs[items] / probabilities[items] * (n / total)
        sample._loss = sample._confusion
        return sample

    def _confusion(self, block: slice, forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return costs times Q(sqrt(q / 2)) [n], and their negative derivatives [n, G, G]."""
        from scipy.special import ndtr

        squares, slopes = self._squares(forms)
        root = np.sqrt(squares)
        costs = self._costs[block]
        # The derivative is undefined for equal signals; the limit keeps it finite.
        slope = np.exp(-root**2 / 8) / (4 * np.sqrt(2 * np.pi) * np.maximum(root, 1e-9))
        return costs * ndtr(-root / 2), (costs * slope)[:, None, None] * slopes

    def _squares(self, forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values 2 q [n], and their derivatives by the forms, [n or 1, G, G]."""
        if not self._scales.size:
            return forms[:, 0, 0], np.ones((1, 1, 1))
        first = np.arange(0, forms.shape[1], 3)
        turned, second = first + 1, first + 2
        phases, penalties = best_phases(
            forms[:, first, second] + 1j * forms[:, turned, second], self._scales,
            self._precision)
        # The phases minimise the value, so their changes do not contribute to its derivative.
        slopes = np.zeros(forms.shape)
        slopes[:, first, first] = slopes[:, second, second] = 1.0
        slopes[:, first, second] = slopes[:, second, first] = -np.cos(phases)
        slopes[:, turned, second] = slopes[:, second, turned] = -np.sin(phases)
        squares = np.einsum('nab,nab->n', slopes, forms) + penalties
        return np.maximum(squares, 0.0), slopes


def best_phases(products: np.ndarray, scales: np.ndarray, precision: np.ndarray
                ) -> tuple[np.ndarray, np.ndarray]:
    """Find phases theta that bring signals a close to signals b: the better of two local minima.

    `products` are 2 a_i^H b_i of the whitened signals, complex128 [n, N_B], `scales` is the matrix
    A, float64 [N_B, Q] [rad], and `precision` the diagonal of P, float64 [Q]. Returns theta,
    float64 [n, N_B] [rad], and the cost ``z^T P z`` of these phases, float64 [n].
    """
    magnitude, angle = np.abs(products), np.angle(products)
    # The magnitudes bound the curvatures of the cosines, so these steps do not overshoot.
    curvature = np.einsum('bq,nb,bp->nqp', scales, magnitude, scales) + np.diag(precision)
    inverse = np.linalg.inv(curvature)
    candidates = []
    # If A is small, the best z is near 0; if A is large, the phases are near the products' angles.
    for z in (np.zeros((len(products), scales.shape[1])), angle @ np.linalg.pinv(scales).T):
        for _ in range(_STEPS):
            slope = (magnitude * np.sin(z @ scales.T - angle)) @ scales + precision * z
            z = z - np.einsum('nqp,np->nq', inverse, slope)
        penalty = z**2 @ precision
        phases = z @ scales.T
        cost = penalty - 2 * np.sum(magnitude * np.cos(phases - angle), axis=1)
        candidates.append((cost, phases, penalty))
    first, second = candidates
    better = first[0] <= second[0]
    return np.where(better[:, None], first[1], second[1]), np.where(better, first[2], second[2])


def _rows_of_bands(n_bands: int) -> Combination:
    """Return the rows a_i, j a_i and b_i of each band as multiples of the two signals' rows."""
    scale = np.zeros((n_bands, n_bands, 3), complex)
    scale[np.arange(n_bands), np.arange(n_bands)] = 1, 1j, 1
    return Combination(np.tile([0, 0, 1], n_bands), scale.reshape(n_bands, -1))


def _repeated_gain(scenario: Scenario, positions: np.ndarray, band: int) -> np.ndarray:
    """Compute line-of-sight gains [n, N_SB, N_E], once for each run of equal positions."""
    is_new = np.concatenate([[True], np.any(np.diff(positions, axis=0) != 0, axis=1)])
    return los_gain(scenario, positions[is_new], band)[np.cumsum(is_new) - 1]


def _inclusion_probabilities(shares: np.ndarray, n: int) -> np.ndarray:
    """Return probabilities proportional to shares [N], but at most 1, whose sum is n."""
    descending = np.sort(shares)[::-1]
    rest = np.cumsum(descending[::-1])[::-1]
    # The smallest number of certain items for which no other probability exceeds 1.
    n_certain = np.argmax((n - np.arange(len(shares))) * descending <= rest)
    return np.minimum(shares * ((n - n_certain) / rest[n_certain]), 1.0)
