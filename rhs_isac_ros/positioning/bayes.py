"""The posterior mean and covariance: a table search, then exact refinement of every mode."""

from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import likelihood_loss
from rhs_isac_ros.positioning.search import SearchEstimator


class BayesEstimator(SearchEstimator):
    """Estimates mean and covariance of the posterior; the prior is uniform on the region.

    The table gives the modes, Gauss-Newton steps on the exact near-field model refine them, and
    every mode contributes with the mass of its Gaussian inside the region. Parameters and errors
    are those of `SearchEstimator`.
    """

    name = 'bayes'

    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None) -> None:
        super().__init__(scenario, codebook, table_folder)
        self._prior_covariance = np.diag((self._bounds[1] - self._bounds[0])**2 / 12)

    def _moments(self, modes: Modes) -> tuple[np.ndarray, np.ndarray]:
        points, curvature, log_likelihood, roi_offset = modes
        jacobians = jacobian(points)
        log_mass = (log_likelihood + np.log(np.linalg.det(jacobians))
                    - np.log(np.linalg.det(curvature)) / 2)
        factors = np.linalg.inv(np.swapaxes(np.linalg.cholesky(curvature), 1, 2))
        # The Gaussian of a mode outside the region is sampled around the point where it enters
        # the region; the weights of the samples correct for the shift.
        normal = self._table.normal
        shift = np.linalg.solve(factors, roi_offset[..., None])[..., 0]
        log_weights = (log_mass[:, None] - shift @ normal.T
                       - likelihood_loss(roi_offset, curvature)[:, None])
        spread = np.matmul(normal, np.swapaxes(factors, 1, 2))
        positions = to_positions((points + roi_offset)[:, None] + spread)
        low, high = self._bounds
        inside = ((positions >= low) & (positions <= high)).all(axis=-1)
        if not inside.any():
            positions, inside = np.clip(positions, low, high), ~inside
        log_weights[~inside] = -np.inf
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        flat = weights.reshape(-1)
        mean = flat @ positions.reshape(-1, 3)
        offsets = (positions - mean).reshape(-1, 3)
        covariance = (flat[:, None] * offsets).T @ offsets
        # The mean of few samples is itself uncertain; its covariance never exceeds that of the
        # prior.
        position_factors = np.matmul(jacobians, factors)
        within = np.einsum(
            'm,mab,mcb->ac', weights.sum(axis=1), position_factors, position_factors)
        within = within @ np.linalg.solve(within + self._prior_covariance, self._prior_covariance)
        covariance = covariance + within * np.sum(weights**2)
        return mean, (covariance + covariance.T) / 2
