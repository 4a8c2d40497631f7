"""The posterior mean and covariance: a table search, then exact refinement of every mode."""

from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import loss
from rhs_isac_ros.positioning.search import SearchEstimator


class BayesEstimator(SearchEstimator):
    """Mean and covariance of the posterior for a uniform prior on the region of interest.

    The table gives the modes, Gauss-Newton steps on the exact near-field model refine them, and
    every mode enters with the mass of its Gaussian inside the region.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook.
    table_folder
        Where tables are kept between runs; None: nowhere.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    """

    name = 'bayes'

    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None) -> None:
        super().__init__(scenario, codebook, table_folder)
        self._prior = np.diag((self._bounds[1] - self._bounds[0])**2 / 12)
        self._normal = self._table.normal

    def _moments(self, modes: Modes) -> tuple[np.ndarray, np.ndarray]:
        points, curvature, value, gap = modes
        bend = jacobian(points)
        log_mass = value + np.log(np.linalg.det(bend)) - np.log(np.linalg.det(curvature)) / 2
        factors = np.linalg.inv(np.swapaxes(np.linalg.cholesky(curvature), 1, 2))
        # The Gaussian of a mode outside the region is sampled where it enters the region, and
        # each sample weighs what the Gaussian says of it.
        shift = np.linalg.solve(factors, gap[..., None])[..., 0]
        log_weights = log_mass[:, None] - shift @ self._normal.T - loss(gap, curvature)[:, None]
        spread = np.matmul(self._normal, np.swapaxes(factors, 1, 2))
        positions = to_positions((points + gap)[:, None] + spread)
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
        # Few points inside make the mean itself uncertain.
        bent = np.matmul(bend, factors)
        own = np.einsum('m,mab,mcb->ac', weights.sum(axis=1), bent, bent)
        # Nothing is less certain than the region of interest.
        own = own @ np.linalg.solve(own + self._prior, self._prior)
        covariance = covariance + own * np.sum(weights**2)
        return mean, (covariance + covariance.T) / 2
