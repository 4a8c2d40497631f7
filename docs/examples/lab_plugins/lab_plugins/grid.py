"""An estimator that weights a fixed set of positions: a short example, but slow and coarse."""

import numpy as np
from scipy.stats import qmc

from rhs_isac_ros.positioning.estimate import Estimate, estimate_each


class GridEstimator:
    """Mean and covariance of the posterior over 2^14 Sobol points of the region of interest."""

    name = 'grid'

    def __init__(self, system, log2_points=14):
        self.system = system
        low, high = system.scenario.roi_bounds_m
        self._points = low + (high - low) * qmc.Sobol(3, seed=0).random_base2(log2_points)
        # Whitening turns squared distances between signals into negative log-likelihoods.
        means = system.whiten(system.mean(self._points))
        self._means = means.reshape(len(means), -1)

    def estimate(self, received):
        """Estimate the position for each phase of received signals, [..., N_B, N_SB F]."""
        return estimate_each(self.system.codebook, received, self._locate)

    def _locate(self, batch):
        for whitened in self.system.whiten(batch):
            distance2 = np.sum(np.abs(whitened.ravel() - self._means)**2, axis=1)
            weights = np.exp(distance2.min() - distance2)
            weights /= weights.sum()
            mean = weights @ self._points
            offsets = self._points - mean
            yield Estimate(mean, (weights[:, None] * offsets).T @ offsets + 1e-6 * np.eye(3))
