"""An estimator that weighs a fixed set of positions: slow and coarse, but fifteen lines."""

import numpy as np
from scipy.stats import qmc

from rhs_isac_ros.positioning.estimate import estimate_each
from rhs_isac_ros.positioning.whitened import WhitenedModel


class GridEstimator:
    """Mean and covariance of the posterior over 2^14 even points of the region of interest."""

    name = 'grid'

    def __init__(self, scenario, codebook, log2_points=14):
        self._scenario, self._codebook = scenario, codebook
        low, high = scenario.roi_bounds_m
        self._points = low + (high - low) * qmc.Sobol(3, seed=0).random_base2(log2_points)
        # Multipath and noise are white after this, so that distances of signals are likelihoods.
        self._model = WhitenedModel(scenario, codebook)
        self._means = self._model.mean(self._points).reshape(len(self._points), -1)

    def estimate(self, received):
        """Check the signals, locate every one of them, and give the answer their form."""
        return estimate_each(self._scenario, self._codebook, received, self._locate)

    def _locate(self, batch):
        for whitened in self._model.whiten(batch):
            misfit = np.sum(np.abs(whitened.ravel() - self._means)**2, axis=1)
            weights = np.exp(misfit.min() - misfit)
            weights /= weights.sum()
            mean = weights @ self._points
            offsets = self._points - mean
            # Mean, covariance, and the reason why there is no position: none.
            yield mean, (weights[:, None] * offsets).T @ offsets + 1e-6 * np.eye(3), ''
