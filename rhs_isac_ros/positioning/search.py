"""The common part of the estimators that search for modes."""

import abc
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.imperfections import has_element_errors
from rhs_isac_ros.model.nuisance import nuisance_parameters
from rhs_isac_ros.positioning.element_error_model import ElementErrorModel
from rhs_isac_ros.positioning.estimate import Estimate, estimate_each
from rhs_isac_ros.positioning.fit import FitTest, outside_test
from rhs_isac_ros.positioning.marginal import Found, MarginalSearch
from rhs_isac_ros.positioning.modes import LONG_SEARCH_STEPS, Modes, find_modes
from rhs_isac_ros.positioning.samples import Samples, draw_samples
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.positioning.surroundings import Surroundings
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Standard deviations of the user's gain that the test of the energy admits.
_GAIN_REACH = 6


class SearchEstimator(abc.ABC):
    """An estimator from the modes of the posterior, for a uniform prior on the region of interest.

    Signals that the model cannot explain at the best mode give no fix; see `fit`. Tables are kept
    in `table_folder` between runs.

    Parameters
    ----------
    reject_outside
        Whether signals that are more probably from outside of the region give no fix either; see
        `surroundings`. Some users inside then get no fix; their share grows as the number of
        measurements falls.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    """

    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None, *, reject_outside: bool = False) -> None:
        self._rejects_outside = reject_outside
        self._model = WhitenedModel(scenario, codebook)
        arrays = load_table(self._model, table_folder)
        self._table = TemplateTable(scenario, arrays)
        self._surroundings = Surroundings(scenario, arrays)
        self._test = FitTest(int(np.prod(self._model.shape)))
        self._bounds = scenario.roi_bounds_m
        self._volume_m3 = float(np.prod(scenario.roi_size_m))
        self._error = ElementErrorModel(self._model) if has_element_errors(scenario) else None
        self._marginal: MarginalSearch | None = None
        # Weak signals may be those of a user with a low gain.
        self._max_power = 10**(_GAIN_REACH * scenario.user_gain_std_db / 10)
        if nuisance_parameters(scenario):
            self._marginal = MarginalSearch(
                self._model, self._table, self._surroundings, self._error)

    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals, as `Estimator.estimate` describes."""
        model = self._model
        return estimate_each(model.scenario, model.codebook, received, self._locate)

    def _locate(self, batch: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, str, float]]:
        no_fix = np.full(3, np.nan), np.full((3, 3), np.nan)
        for received, whitened in zip(batch, self._model.whiten(batch), strict=True):
            reason = self._test.min_energy_test(
                float(np.sum(np.abs(whitened)**2)) * self._max_power)
            if reason:
                yield *no_fix, reason, np.nan
                continue
            found = (self._marginal.find(received) if self._marginal
                     else self._find(received, whitened))
            samples = draw_samples(found.modes, self._table.normal, self._bounds)
            reason = self._reason(found, samples)
            moments = no_fix if reason else self._moments(found.modes, samples)
            yield *moments, reason, found.residual

    def _find(self, received: np.ndarray, whitened: np.ndarray) -> Found:
        modes = find_modes(self._model, self._table, whitened)
        if self._test.residual_test(-modes.roi_log_likelihood.max()):
            # Strong signals may need more steps to reach the maximum.
            modes = find_modes(self._model, self._table, whitened, LONG_SEARCH_STEPS)
        residual = float(-modes.roi_log_likelihood.max())
        if self._error:
            signals = np.broadcast_to(received, (len(modes.points), *received.shape))
            modes, residuals = self._error.refine(modes, signals, step=True)
            residual = float(residuals[0])
        outside = (float(self._surroundings.log_evidence(whitened)[0])
                   if self._rejects_outside else -np.inf)
        return Found(modes, residual, whitened, outside)

    def _reason(self, found: Found, samples: Samples) -> str:
        """Return why there is no fix, empty if there is one.

        If no position of the region explains the signals, one outside has to explain them for
        the user to be there.
        """
        unexplained = self._test.residual_test(found.residual)
        if not self._rejects_outside or unexplained and not self._surroundings.explain(
                found.whitened, self._test.max_residual):
            return unexplained
        inside = samples.log_evidence(self._volume_m3)
        return outside_test(inside - found.log_evidence_outside) or unexplained

    @abc.abstractmethod
    def _moments(self, modes: Modes, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        """Return a position [3] and its covariance [3, 3] from the modes."""
