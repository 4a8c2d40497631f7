"""What the estimators that search for modes have in common."""

import abc
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.estimate import Estimate, estimate_each
from rhs_isac_ros.positioning.fit import FitTest
from rhs_isac_ros.positioning.modes import LONG_SEARCH, Modes, find_modes
from rhs_isac_ros.positioning.store import table_of
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.whitened import WhitenedModel


class SearchEstimator(abc.ABC):
    """An estimator from the modes of the posterior, for a uniform prior on the region of interest.

    Signals that the model cannot explain at the best mode give no fix; see `fit`.

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

    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None) -> None:
        self._model = WhitenedModel(scenario, codebook)
        self._table = TemplateTable(scenario, table_of(self._model, table_folder))
        self._test = FitTest(int(np.prod(self._model.shape)))
        self._bounds = scenario.roi_bounds_m

    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals.

        Parameters
        ----------
        received
            Complex128 [N_B, N_SB F], or [N, N_B, N_SB F] for N positions; sub-band-major.

        Returns
        -------
        Estimate
            With a leading N if the signals have one; without a position where they tell none.

        Raises
        ------
        SignalError
            If the shape is another one or a value is not finite.
        """
        model = self._model
        return estimate_each(model.scenario, model.codebook, received, self._locate)

    def _locate(self, batch: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
        nowhere = np.full(3, np.nan), np.full((3, 3), np.nan)
        for whitened in self._model.whiten(batch):
            reason = self._test.silence(float(np.sum(np.abs(whitened)**2)))
            if reason:
                yield *nowhere, reason
                continue
            modes = find_modes(self._model, self._table, whitened)
            if self._test.misfit(-modes.height.max()):
                # Strong signals may need more steps up to their peak.
                modes = find_modes(self._model, self._table, whitened, LONG_SEARCH)
            reason = self._test.misfit(-modes.height.max())
            yield (*nowhere, reason) if reason else (*self._moments(modes), '')

    @abc.abstractmethod
    def _moments(self, modes: Modes) -> tuple[np.ndarray, np.ndarray]:
        """Make a position [3] and its covariance [3, 3] of the modes."""
