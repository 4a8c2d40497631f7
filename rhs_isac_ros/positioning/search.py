"""The common part of the estimators that search for modes."""

import abc
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.estimate import Estimate, estimate_each
from rhs_isac_ros.positioning.fit import FitTest
from rhs_isac_ros.positioning.modes import LONG_SEARCH_STEPS, Modes, find_modes
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.whitened import WhitenedModel


class SearchEstimator(abc.ABC):
    """An estimator from the modes of the posterior, for a uniform prior on the region of interest.

    Signals that the model cannot explain at the best mode give no fix; see `fit`. Tables are kept
    in `table_folder` between runs.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    """

    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None) -> None:
        self._model = WhitenedModel(scenario, codebook)
        self._table = TemplateTable(scenario, load_table(self._model, table_folder))
        self._test = FitTest(int(np.prod(self._model.shape)))
        self._bounds = scenario.roi_bounds_m

    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals, as `Estimator.estimate` describes."""
        model = self._model
        return estimate_each(model.scenario, model.codebook, received, self._locate)

    def _locate(self, batch: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
        no_fix = np.full(3, np.nan), np.full((3, 3), np.nan)
        for whitened in self._model.whiten(batch):
            reason = self._test.min_energy_test(float(np.sum(np.abs(whitened)**2)))
            if reason:
                yield *no_fix, reason
                continue
            modes = find_modes(self._model, self._table, whitened)
            if self._residual_test(modes):
                # Strong signals may need more steps to reach the maximum.
                modes = find_modes(self._model, self._table, whitened, LONG_SEARCH_STEPS)
            reason = self._residual_test(modes)
            yield (*no_fix, reason) if reason else (*self._moments(modes), '')

    def _residual_test(self, modes: Modes) -> str:
        return self._test.residual_test(-modes.roi_log_likelihood.max())

    @abc.abstractmethod
    def _moments(self, modes: Modes) -> tuple[np.ndarray, np.ndarray]:
        """Return a position [3] and its covariance [3, 3] from the modes."""
