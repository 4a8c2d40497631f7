"""The likelihood of positions under unknown element errors, with their covariance at each.

The covariance is exact to second order. The errors multiply the multipath, and failures have a
mixed distribution, so that the signals are not exactly Gaussian: an average over surfaces would
be exact, but the weights of drawn surfaces degenerate, because a surface has as many unknown
numbers as there are measurements.
"""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario

# Points whose log-likelihood with the average covariance is lower than the best by more than this
# are ignored.
_MARGIN = 60.0
# Points evaluated at a time.
_BLOCK = 256


class ElementErrorLikelihood:
    """Log-likelihood of positions, float32 [P, N], for signals [N, N_B, N_SB F]."""

    def __init__(self, scenario: Scenario, codebook: Codebook, received: np.ndarray) -> None:
        self._model = MeasurementModel(scenario, codebook).prepare()
        self._received = received
        self._whitened = self._model.whiten(received).reshape(len(received), -1)
        self._energy = np.sum(np.abs(self._whitened)**2, axis=1)
        self._highest = np.full(len(received), -np.inf)

    def __call__(self, positions: np.ndarray) -> np.ndarray:
        """Evaluate positions [P, 3]."""
        mean = self._model.mean(positions)
        flat = self._model.whiten(mean).reshape(len(mean), -1)
        coarse = 2 * (flat.conj() @ self._whitened.T).real
        coarse -= np.sum(np.abs(flat)**2, axis=1)[:, None] + self._energy
        self._highest = np.maximum(self._highest, coarse.max(axis=0))
        near = coarse >= self._highest - _MARGIN
        # A phase without any point still needs a finite maximum.
        values = np.full(near.shape, -1e30, np.float32)
        (chosen,) = np.nonzero(near.any(axis=1))
        for start in range(0, len(chosen), _BLOCK):
            block = chosen[start:start + _BLOCK]
            exact = self._exact(positions[block], mean[block])
            values[block] = np.where(near[block], exact, -1e30)
        return values

    def _exact(self, positions: np.ndarray, mean: np.ndarray) -> np.ndarray:
        roots = np.linalg.cholesky(self._model.covariance_at(positions))
        volume = 2 * np.log(np.diagonal(roots, axis1=2, axis2=3).real).sum(axis=(1, 2))
        columns = np.concatenate([
            np.broadcast_to(np.moveaxis(self._received, 0, 2), (len(mean), *mean.shape[1:],
                                                                len(self._received))),
            mean[..., None]], axis=3)
        white = np.linalg.solve(roots, columns)
        residual = white[..., :-1] - white[..., -1:]
        exact: np.ndarray = -np.sum(np.abs(residual)**2, axis=(1, 2)) - volume[:, None]
        return exact
