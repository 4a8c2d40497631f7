"""The posterior mean and covariance: a table search, then exact refinement of every mode."""

import numpy as np
from scipy.special import ndtri

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.estimate import Estimate, checked_received
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import gap_to_region, loss
from rhs_isac_ros.positioning.table import LEAST_CURVATURE, TemplateTable, separate
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Modes to refine, and how far below the best one's log-likelihood they may lie: on the table,
# which is good to one Gauss-Newton step, and after the first exact step.
_MODES = 32
_DEPTHS = (10.0, 8.0)
# Modes closer than this in all of (r [m], u, v) have climbed to the same peak.
_MERGE = np.array([0.01, 0.02, 0.02])
_LONGEST_STEP = np.array([0.02, 0.05, 0.05])
# Points that represent the Gaussian around a mode when it is cut to the region of interest.
_SPREAD = 128


class BayesEstimator:
    """Mean and covariance of the posterior for a uniform prior on the region of interest.

    The table gives the modes, Gauss-Newton steps on the exact near-field model refine them, and
    every mode enters with the mass of its Gaussian inside the region.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    """

    name = 'bayes'

    def __init__(self, scenario: Scenario, codebook: Codebook) -> None:
        self._model = WhitenedModel(scenario, codebook)
        self._table = TemplateTable(self._model)
        self._bounds = scenario.roi_bounds_m
        self._prior = np.diag((self._bounds[1] - self._bounds[0])**2 / 12)
        # Here: a slow import that only this estimator needs.
        from scipy.stats import qmc

        uniform = qmc.Sobol(3, seed=0).random(_SPREAD)
        self._normal = ndtri(np.clip(uniform, 1e-6, 1 - 1e-6))

    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals.

        Parameters
        ----------
        received
            Complex128 [N_B, N_SB F], or [N, N_B, N_SB F] for N positions; sub-band-major.

        Returns
        -------
        Estimate
            With a leading N if the signals have one.

        Raises
        ------
        SignalError
            If the shape is another one or a value is not finite.
        """
        model = self._model
        batch = checked_received(model.scenario, model.codebook, received)
        if not len(batch):
            return Estimate(np.empty((0, 3)), np.empty((0, 3, 3)))
        moments = [self._posterior(y) for y in model.whiten(batch)]
        mean, covariance = (np.stack(part) for part in zip(*moments, strict=True))
        if np.ndim(received) == 2:
            return Estimate(mean[0], covariance[0])
        return Estimate(mean, covariance)

    def _posterior(self, whitened: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points, curvature, log_mass = self._refine(whitened)
        factors = np.linalg.inv(np.swapaxes(np.linalg.cholesky(curvature), 1, 2))
        # The Gaussian of a mode outside the region is sampled where it enters the region, and
        # each sample weighs what the Gaussian says of it.
        gap = gap_to_region(points, curvature, self._bounds)
        shift = np.linalg.solve(factors, gap[..., None])[..., 0]
        log_weights = log_mass[:, None] - shift @ self._normal.T - loss(gap, curvature)[:, None]
        spread = np.einsum('mab,sb->msa', factors, self._normal)
        positions = to_positions((points + gap)[:, None] + spread)
        low, high = self._bounds
        inside = ((positions >= low) & (positions <= high)).all(axis=-1)
        if not inside.any():
            positions, inside = np.clip(positions, low, high), ~inside
        log_weights[~inside] = -np.inf
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        mean = np.einsum('ms,msu->u', weights, positions)
        offsets = positions - mean
        covariance = np.einsum('ms,msu,msv->uv', weights, offsets, offsets)
        # Few points inside make the mean itself uncertain.
        bent = np.matmul(jacobian(points), factors)
        own = np.einsum('m,mab,mcb->ac', weights.sum(axis=1), bent, bent)
        # Nothing is less certain than the region of interest.
        own = own @ np.linalg.solve(own + self._prior, self._prior)
        return mean, covariance + own * np.sum(weights**2)

    def _refine(self, whitened: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the modes that carry weight.

        Returns the points and the curvature of the log-likelihood [M, 3, 3], both polar, and the
        logarithm of each mode's mass up to a constant [M].
        """
        points = self._table.modes(whitened, _MODES, _DEPTHS[0])
        points, curvature, value = self._climb(points, whitened)
        height = value - loss(gap_to_region(points, curvature, self._bounds), curvature)
        order = np.argsort(-height)
        order = order[height[order] >= height[order[0]] - _DEPTHS[1]]
        points = points[order][separate(points[order] / _MERGE, _MODES)]
        points, curvature, value = self._climb(points, whitened)
        volume = np.log(np.linalg.det(jacobian(points))) - np.log(np.linalg.det(curvature)) / 2
        return points, curvature, value + volume

    def _climb(
            self, points: np.ndarray, whitened: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One Gauss-Newton step: the new points, the curvature, and the value to expect there."""
        curvature, slope, value = self._local(points, whitened)
        step = np.linalg.solve(curvature, slope[..., None])[..., 0]
        value = value + np.einsum('mq,mq->m', slope, step) / 2
        return points + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP), curvature, value

    def _local(
            self, points: np.ndarray, whitened: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Curvature [M, 3, 3], slope [M, 3] and value [M] of the log-likelihood, polar."""
        positions = to_positions(points)
        n = len(points)
        mean, by_position = self._model.mean_and_derivative(positions)
        residual = (whitened - mean).reshape(n, 1, -1)
        slopes = by_position.reshape(n, 3, -1)
        slopes = np.matmul(np.swapaxes(jacobian(points), 1, 2), slopes)
        curvature = 2 * np.matmul(slopes, np.conj(np.swapaxes(slopes, 1, 2))).real
        curvature += np.diag(LEAST_CURVATURE)
        slope = 2 * np.sum((np.conj(slopes) * residual).real, axis=-1)
        return curvature, slope, -np.sum(np.abs(residual)**2, axis=(1, 2))
