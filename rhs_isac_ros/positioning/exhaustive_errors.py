"""The likelihood of positions under unknown element errors, with their covariance at each.

The covariance is exact to second order. The errors multiply the multipath, and failures have a
mixed distribution, so that the signals are not exactly Gaussian: an average over surfaces would
be exact, but the weights of drawn surfaces degenerate, because a surface has as many unknown
numbers as there are measurements.
"""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario

# Expected number of points at which the likelihood of a phase is evaluated. They are drawn with a
# probability that follows from an approximation, raised to a power so that points which it
# misjudges are drawn, too.
_N_EXACT = 600
_POWER = 0.6
# The approximation: the covariance in intervals of the range, each averaged over some points.
_N_INTERVALS = 8
_N_AVERAGED = 16
_LOG2_TRIED = 10
# Points evaluated at a time.
_BLOCK = 256


class ElementErrorLikelihood:
    """Estimate of the log-likelihood of positions, float32 [P, N], for signals [N, N_B, N_SB F].

    A covariance for every point and phase would take hours. Each phase draws a few points; their
    likelihood is divided by the probability of the draw, and that of the others is zero, so that
    sums over points keep their expectation. Calls with fewer points in total than a phase would
    draw evaluate all of them.

    Parameters
    ----------
    n_points
        Number of positions of all calls together.
    """

    def __init__(self, scenario: Scenario, codebook: Codebook, received: np.ndarray,
                 n_points: int) -> None:
        self._model = MeasurementModel(scenario, codebook)
        self._received, self._rng = received, np.random.default_rng(0)
        self._n_points, self._n_done = n_points, 0
        # Logarithm of the sum of all weights so far.
        self._log_sum = np.full(len(received), -np.inf)

        from scipy.stats import qmc
        low, high = scenario.roi_bounds_m
        points = qmc.Sobol(3, seed=1).random_base2(_LOG2_TRIED) * (high - low) + low
        distance = np.linalg.norm(points, axis=1)
        self._edges = np.quantile(distance, np.arange(1, _N_INTERVALS) / _N_INTERVALS)
        interval = np.searchsorted(self._edges, distance)
        covariance = np.stack([
            self._model.covariance_at(points[interval == index][:_N_AVERAGED]).mean(axis=0)
            for index in range(_N_INTERVALS)])
        roots = np.linalg.cholesky(covariance)
        self._volume = _log_determinant(roots)
        self._whiteners = np.linalg.inv(roots)
        self._whitened = np.einsum('ibrs,nbs->inbr', self._whiteners, received)

    def __call__(self, positions: np.ndarray) -> np.ndarray:
        """Evaluate positions [P, 3]."""
        mean = self._model.mean(positions)
        values = np.full((len(positions), len(self._received)), -1e30, np.float32)
        self._n_done += len(positions)
        if self._n_points <= _N_EXACT:
            log_share = np.zeros(values.shape)
        else:
            log_share = self._log_share(self._approximate(positions, mean))
        drawn = np.log(self._rng.uniform(size=values.shape)) < log_share
        (chosen,) = np.nonzero(drawn.any(axis=1))
        for start in range(0, len(chosen), _BLOCK):
            block = chosen[start:start + _BLOCK]
            roots = np.linalg.cholesky(self._model.covariance_at(positions[block]))
            point, phase = np.nonzero(drawn[block])
            residual = self._received[phase] - mean[block[point]]
            white = np.linalg.solve(roots[point], residual[..., None])[..., 0]
            values[block[point], phase] = -np.sum(np.abs(white)**2, axis=(1, 2)) \
                - _log_determinant(roots)[point] - log_share[block[point], phase]
        return values

    def _approximate(self, positions: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Log-likelihood with the covariance of an interval, [P, N]."""
        interval = np.searchsorted(self._edges, np.linalg.norm(positions, axis=1))
        values = np.empty((len(positions), len(self._received)))
        for index in range(_N_INTERVALS):
            inside = interval == index
            white = np.matmul(np.swapaxes(mean[inside], 0, 1), np.swapaxes(
                self._whiteners[index], 1, 2))
            flat = np.swapaxes(white, 0, 1).reshape(len(white[0]), -1).astype(np.complex64)
            signals = self._whitened[index].reshape(len(self._received), -1)
            values[inside] = 2 * (flat.conj() @ signals.T.astype(np.complex64)).real
            values[inside] -= np.sum(np.abs(flat)**2, axis=1)[:, None] + self._volume[index]
            values[inside] -= np.sum(np.abs(signals)**2, axis=1)
        return values

    def _log_share(self, approximate: np.ndarray) -> np.ndarray:
        """Logarithm of the probability that a phase draws a point, [P, N]."""
        weights = _POWER * approximate
        self._log_sum = np.logaddexp(self._log_sum, np.logaddexp.reduce(weights, axis=0))
        expected = self._log_sum + np.log(self._n_points / self._n_done)
        share: np.ndarray = np.minimum(weights - expected + np.log(_N_EXACT), 0.0)
        return share


def _log_determinant(roots: np.ndarray) -> np.ndarray:
    """Logarithm of the determinant from Cholesky factors [..., N_B, S, S], over all bands."""
    value: np.ndarray = 2 * np.log(
        np.diagonal(roots, axis1=-2, axis2=-1).real).sum(axis=(-1, -2))
    return value
