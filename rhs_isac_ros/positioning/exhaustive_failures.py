"""The posterior with failed elements if the search cannot miss the true set and position.

A sum over all sets and positions is not tractable. With the truth and the sets next to it among
the hypotheses, the mixture differs from that of the estimator by what its search misses. Both
approximate the amplitudes of stuck elements by a Gaussian.
"""

from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.imperfections import SurfaceImperfection
from rhs_isac_ros.positioning.bayes import BayesEstimator
from rhs_isac_ros.positioning.estimate import Estimate
from rhs_isac_ros.positioning.failed_elements import FailedElements
from rhs_isac_ros.positioning.failure_search import FailureSearch
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import to_polar


def posterior_with_truth(
        scenario: Scenario, codebook: Codebook, received: np.ndarray,
        surfaces: Sequence[SurfaceImperfection], positions: np.ndarray) -> Estimate:
    """Compute the posterior of phases, with the truth among the hypotheses of the search.

    Parameters
    ----------
    received
        Signals, complex128 [N, N_B, N_SB F].
    surfaces, positions
        The N surfaces, and the positions of the users, float64 [N, 3] [m].

    Raises
    ------
    ValueError
        If the scenario does not declare failures whose sets can be searched.
    """
    estimator = _Estimator(scenario, codebook)
    estimates = [
        estimator.estimate_with(signals, surface, position)
        for signals, surface, position in zip(received, surfaces, positions, strict=True)]
    return Estimate(np.stack([one.mean for one in estimates]),
                    np.stack([one.covariance for one in estimates]))


class _Failures(FailedElements):
    """The search with a hypothesis that it cannot miss."""

    truth: tuple[tuple[int, ...], np.ndarray]

    def _search(self, modes: Modes, received: np.ndarray) -> FailureSearch:
        search = super()._search(modes, received)
        failed, point = self.truth
        (key,) = search.add(point[None], failed)
        search.try_neighbours(key)
        return search


class _Estimator(BayesEstimator):
    """An estimator whose search includes the true hypothesis."""

    def __init__(self, scenario: Scenario, codebook: Codebook) -> None:
        super().__init__(scenario, codebook)
        if self._failures is None:
            raise ValueError(f'failed_element_share: {scenario.failed_element_share:g}, expected '
                             'few failures, so that their sets can be searched')
        self._failures = self._with_truth = _Failures(self._model, self._table)

    def estimate_with(self, received: np.ndarray, surface: SurfaceImperfection,
                      position: np.ndarray) -> Estimate:
        (failed,) = np.nonzero(~np.isnan(surface.stuck))
        self._with_truth.truth = tuple(failed.tolist()), to_polar(position)
        return self.estimate(received)
