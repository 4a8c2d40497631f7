"""The posterior mean and covariance: a table search, then exact refinement of every mode."""

from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.samples import WeightedSamples
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

    def _moments(
            self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        mean, covariance = samples.moments()
        # The mean of few samples is itself uncertain; its covariance never exceeds that of the
        # prior.
        within = samples.average(np.matmul(samples.spread, np.swapaxes(samples.spread, 1, 2)))
        prior = self._prior_covariance
        within = within @ np.linalg.solve(within + prior, np.broadcast_to(prior, within.shape))
        share = samples.sums(np.einsum('ms,ms->m', samples.weights, samples.weights))
        covariance += within * share[:, None, None]
        return mean, (covariance + np.swapaxes(covariance, 1, 2)) / 2
