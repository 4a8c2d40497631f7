"""The common part of the estimators that search for modes."""

import abc
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.model.nuisance import nuisance_parameters
from rhs_isac_ros.model.threads import map_blocks, one_blas_thread
from rhs_isac_ros.positioning.element_error_model import ElementErrorModel
from rhs_isac_ros.positioning.estimate import (
    Estimate,
    Estimator,
    Located,
    checked_received,
    estimate_each,
)
from rhs_isac_ros.positioning.failed_elements import FailedElements, can_enumerate
from rhs_isac_ros.positioning.fit import (
    DOUBT_LIMIT,
    FitTest,
    outside_probability,
    outside_test,
)
from rhs_isac_ros.positioning.marginal import Found, MarginalSearch
from rhs_isac_ros.positioning.modes import (
    LONG_SEARCH_STEPS,
    Modes,
    find_modes,
    find_modes_of_each,
)
from rhs_isac_ros.positioning.posterior import Doubt, Posterior
from rhs_isac_ros.positioning.samples import WeightedSamples, draw_samples_of_each
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.positioning.surroundings import Surroundings
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Standard deviations of the user's gain that the test of the energy admits.
_GAIN_REACH = 6
# Coordinates fitted to the signals of each phase.
_N_COORDINATES = 3
# Number of phases that are located together.
_BLOCK = 128


class SearchEstimator(abc.ABC):
    """An estimator from the modes of the posterior, for a uniform prior on the region of interest.

    Signals that the model cannot explain at the best mode give no fix; see `fit`. Tables are kept
    in `table_folder` between runs.

    Parameters
    ----------
    reject_outside
        Whether the user may also be outside of the region; see `surroundings`. If this is almost
        certain (`fit.OUTSIDE_LIMIT`), there is no fix either. If it is merely possible
        (`fit.DOUBT_LIMIT`), the covariance includes the positions outside, while the position
        remains that of a user inside.
    surface
        What is known of the surface, as in `MeasurementModel`; for example a calibration.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    """

    @one_blas_thread
    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None, *, reject_outside: bool = False,
            surface: Surface | None = None) -> None:
        self._rejects_outside = reject_outside
        self._model = WhitenedModel(scenario, codebook, surface)
        arrays = load_table(self._model, table_folder)
        self._table = TemplateTable(scenario, arrays)
        self._surroundings = Surroundings(scenario, arrays)
        n_measurements = int(np.prod(self._model.shape))
        self._test = FitTest(n_measurements)
        self._bounds = scenario.roi_bounds_m
        self._volume_m3 = float(np.prod(scenario.roi_size_m))
        self._error = ElementErrorModel.of(self._model)
        self._failures: FailedElements | None = None
        if surface is None and can_enumerate(scenario):
            self._failures = FailedElements(self._model, self._table)
        self._marginal: MarginalSearch | None = None
        # Weak signals may be those of a user with a low gain.
        self._max_power = 10**(_GAIN_REACH * scenario.user_gain_std_db / 10)
        if nuisance_parameters(scenario):
            self._marginal = MarginalSearch(
                self._model, self._table, self._surroundings if reject_outside else None,
                self._error)
        n_fitted = _N_COORDINATES + (len(self._marginal.unknowns.names) if self._marginal else 0)
        # Twice an energy has two degrees of freedom for each complex measurement, less one for
        # each fitted parameter.
        self._mean_residual = max(n_measurements - n_fitted / 2, 0.5)

    @one_blas_thread
    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals, as `Estimator.estimate` describes."""
        model = self._model
        return estimate_each(model.scenario, model.codebook, received, self._locate)

    @one_blas_thread
    def posterior(self, received: np.ndarray) -> Posterior:
        """Compute the posterior for the signals of one phase, complex128 [N_B, N_SB F].

        Raises
        ------
        SignalError
            If the signals cannot be used, as in `estimate`.
        """
        model = self._model
        (signals,) = checked_received(model.scenario, model.codebook, received)
        (whitened,) = model.whiten(signals[None])
        located, modes, doubt = self._analyse(signals, whitened)
        return Posterior(Estimate(*located), modes, whitened, doubt)

    def with_outside(
            self, mean: np.ndarray, covariance: np.ndarray, doubt: Doubt) -> np.ndarray:
        """Add positions outside of the region to a covariance about a mean inside, [3, 3]."""
        moment = self._surroundings.second_moment(doubt.whitened, mean, doubt.scale)
        result: np.ndarray = (1 - doubt.probability) * covariance + doubt.probability * moment
        return result

    @property
    def normal(self) -> np.ndarray:
        """Points that represent a standard Gaussian, float64 [128, 3]."""
        return self._table.normal

    @property
    def exact_model(self) -> WhitenedModel | None:
        """The model of the whitened signals; None if they also depend on other unknowns."""
        return None if self._marginal or self._error else self._model

    @property
    def scenario(self) -> Scenario:
        """The scenario of the signals."""
        return self._model.scenario

    def _locate(self, batch: np.ndarray) -> Iterable[Located]:
        whitened = self._model.whiten(batch)
        if self._marginal or self._failures or self._error:
            return [self._analyse(*phase)[0] for phase in zip(batch, whitened, strict=True)]
        starts = range(0, len(batch), _BLOCK)
        blocks = map_blocks(
            lambda start: self._locate_block(whitened[start:start + _BLOCK]), starts)
        return itertools.chain.from_iterable(blocks)

    def _locate_block(self, whitened: np.ndarray) -> list[Located]:
        """Locate phases together whose signals depend on the position only."""
        reasons = [self._too_weak(signals) for signals in whitened]
        (usable,) = np.nonzero([not reason for reason in reasons])
        located: list[Located] = [(*_no_fix(), reason, np.nan, np.nan) for reason in reasons]
        if not len(usable):
            return located
        found = [self._found(*phase) for phase in zip(
            whitened[usable], find_modes_of_each(self._model, self._table, whitened[usable]),
            strict=True)]
        for row, (one, _) in zip(usable.tolist(), self._judge(found), strict=True):
            located[row] = one
        return located

    def _analyse(
            self, received: np.ndarray, whitened: np.ndarray
    ) -> tuple[Located, Modes | None, Doubt | None]:
        """Locate one phase; also return the modes, None without a position, and the doubt."""
        reason = self._too_weak(whitened)
        if reason:
            return (*_no_fix(), reason, np.nan, np.nan), None, None
        found = (self._marginal.find(received) if self._marginal
                 else self._find(received, whitened))
        ((located, doubt),) = self._judge([found])
        return located, None if located[2] else found.modes, doubt

    def _too_weak(self, whitened: np.ndarray) -> str:
        """Return a reason if the signals are weaker than noise."""
        return self._test.min_energy_test(
            float(np.sum(np.abs(whitened)**2)) * self._max_power)

    def _judge(self, found: Sequence[Found]) -> Iterator[tuple[Located, Doubt | None]]:
        """Yield the position of each phase, or why there is none, and the doubt."""
        starts = np.array([0, *itertools.accumulate(len(one.residuals) for one in found[:-1])])
        modes = Modes(*map(np.concatenate, zip(*(one.modes for one in found), strict=True)))
        residuals = np.concatenate([one.residuals for one in found])
        drawn = found[0].samples or draw_samples_of_each(
            modes, starts, self._table.normal, self._bounds)
        samples = WeightedSamples.of(drawn, starts)
        evidence = samples.log_evidence(self._volume_m3)
        moments = self._moments(modes, samples)
        # Averaged over the posterior, the energy of a model that holds has the mean of a
        # chi-square variable. At the best of several modes it is smaller, by the difference from
        # the average.
        expected = self._mean_residual - samples.average(residuals)
        likelihood = modes.roi_log_likelihood
        for row, (one, start) in enumerate(zip(found, starts.tolist(), strict=True)):
            end = start + len(one.residuals)
            residual = float(residuals[start + np.argmax(likelihood[start:end])])
            outside = outside_probability(evidence[row] - one.log_evidence_outside)
            yield self._conclude(one, residual, expected[row] + residual, outside,
                                 (moments[0][row], moments[1][row]))

    def _conclude(
            self, found: Found, residual: float, expected: float, outside: float,
            moments: tuple[np.ndarray, np.ndarray]) -> tuple[Located, Doubt | None]:
        """Return a position, or why there is none, and the doubt."""
        reason = self._reason(found, residual, outside)
        if reason:
            moments = _no_fix()
        doubt = None
        if outside > DOUBT_LIMIT and not self._test.residual_test(residual) == reason != '':
            expected = np.nan
            if not reason:
                doubt = Doubt(outside, found.whitened, found.scale_outside)
                moments = moments[0], self.with_outside(*moments, doubt)
        return (*moments, reason, residual, expected), doubt

    def _find(self, received: np.ndarray, whitened: np.ndarray) -> Found:
        if self._failures:
            modes = find_modes(
                self._model, self._table, whitened, extra_margin=self._failures.search_margin)
            return self._with_evidence(whitened, *self._failures.refine(modes, received))
        found = self._found(whitened, find_modes(self._model, self._table, whitened))
        if not self._error:
            return found
        signals = np.broadcast_to(received, (len(found.modes.points), *received.shape))
        modes, residuals = self._error.refine(found.modes, signals, step=True)
        return found._replace(modes=modes, residuals=residuals)

    def _found(self, whitened: np.ndarray, modes: Modes) -> Found:
        """Return the result of a search; continue it if it has not reached a maximum."""
        residuals = -modes.roi_log_likelihood
        if self._test.residual_test(residuals.min()):
            # Strong signals may need more steps to reach the maximum.
            modes = find_modes(self._model, self._table, whitened, LONG_SEARCH_STEPS)
            residuals = -modes.roi_log_likelihood
        return self._with_evidence(whitened, modes, residuals)

    def _with_evidence(
            self, whitened: np.ndarray, modes: Modes, residuals: np.ndarray) -> Found:
        outside = (float(self._surroundings.log_evidence(whitened)[0])
                   if self._rejects_outside else -np.inf)
        return Found(modes, residuals, whitened, outside)

    def _reason(self, found: Found, residual: float, outside: float) -> str:
        """Return why there is no fix, empty if there is one.

        If no position of the region explains the signals, one outside has to explain them for
        the user to be there.
        """
        unexplained = self._test.residual_test(residual)
        if not self._rejects_outside or unexplained and not self._surroundings.explain(
                found.whitened, self._test.max_residual):
            return unexplained
        return outside_test(outside) or unexplained

    @property
    def surface(self) -> Surface | None:
        """What the estimator assumes to be known of the surface."""
        return self._model.surface

    @abc.abstractmethod
    def _moments(
            self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        """Return positions, [N, 3], and covariances, [N, 3, 3], of N phases."""


def _no_fix() -> tuple[np.ndarray, np.ndarray]:
    return np.full(3, np.nan), np.full((3, 3), np.nan)


def surface_of(estimator: Estimator) -> Surface | None:
    """Return what an estimator assumes to be known of the surface; None for other estimators."""
    return estimator.surface if isinstance(estimator, SearchEstimator) else None
