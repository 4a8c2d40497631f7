"""The common part of the estimators that search for modes."""

import abc
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.estimate import Estimate, estimate_each
from rhs_isac_ros.positioning.fit import FitTest, outside_test
from rhs_isac_ros.positioning.modes import LONG_SEARCH_STEPS, Modes, find_modes
from rhs_isac_ros.positioning.samples import Samples, draw_samples
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.positioning.surroundings import Surroundings
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.whitened import WhitenedModel


class SearchEstimator(abc.ABC):
    """An estimator from the modes of the posterior, for a uniform prior on the region of interest.

    Signals that the model cannot explain at the best mode give no fix; see `fit`. Nor do signals
    that are more probably from outside of the region; see `surroundings`. Tables are kept in
    `table_folder` between runs.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    """

    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None) -> None:
        self._model = WhitenedModel(scenario, codebook)
        arrays = load_table(self._model, table_folder)
        self._table = TemplateTable(scenario, arrays)
        self._surroundings = Surroundings(scenario, arrays)
        self._test = FitTest(int(np.prod(self._model.shape)))
        self._bounds = scenario.roi_bounds_m
        self._volume_m3 = float(np.prod(scenario.roi_size_m))

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
            samples = draw_samples(modes, self._table.normal, self._bounds)
            reason = (self._outside_test(whitened, samples, bool(self._residual_test(modes)))
                      or self._residual_test(modes))
            yield (*no_fix, reason) if reason else (*self._moments(modes, samples), '')

    def _residual_test(self, modes: Modes) -> str:
        return self._test.residual_test(-modes.roi_log_likelihood.max())

    def _outside_test(self, whitened: np.ndarray, samples: Samples, unexplained: bool) -> str:
        """Return why the signals are from outside of the region, empty if they need not be.

        If no position of the region explains the signals, one outside has to explain them.
        """
        evidence = samples.log_evidence(self._volume_m3)
        log_odds = evidence - self._surroundings.log_evidence(whitened)
        if unexplained and not self._surroundings.explain(whitened, self._test.max_residual):
            return ''
        return outside_test(log_odds)

    @abc.abstractmethod
    def _moments(self, modes: Modes, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        """Return a position [3] and its covariance [3, 3] from the modes."""
