"""The posterior mean and covariance: a table search, then exact refinement of every mode."""

from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.samples import Samples
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
            table_folder: Path | None = None, *, reject_outside: bool = False,
            surface: Surface | None = None) -> None:
        super().__init__(scenario, codebook, table_folder, reject_outside=reject_outside,
                         surface=surface)
        self._prior_covariance = np.diag((self._bounds[1] - self._bounds[0])**2 / 12)

    def _moments(self, modes: Modes, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        positions, log_weights, factors = samples
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        flat = weights.reshape(-1)
        mean = flat @ positions.reshape(-1, 3)
        offsets = (positions - mean).reshape(-1, 3)
        covariance = (flat[:, None] * offsets).T @ offsets
        # The mean of few samples is itself uncertain; its covariance never exceeds that of the
        # prior.
        within = np.einsum('m,mab,mcb->ac', weights.sum(axis=1), factors, factors)
        within = within @ np.linalg.solve(within + self._prior_covariance, self._prior_covariance)
        covariance = covariance + within * np.sum(weights**2)
        return mean, (covariance + covariance.T) / 2
