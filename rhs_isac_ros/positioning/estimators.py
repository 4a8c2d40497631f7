"""Estimators that search for the modes of the posterior: `bayes` and `ml`."""

import abc
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import blocks, mixture_weights
from rhs_isac_ros.model.gaussian import share_of_level
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.positioning.alternatives import (
    ALTERNATIVES,
    Alternative,
    Blocked,
    Outside,
    rejection,
)
from rhs_isac_ros.positioning.coordinates import (
    concatenate,
    jacobian,
    moments,
    select,
    symmetric,
    to_positions,
)
from rhs_isac_ros.positioning.diagnosis import FitTest
from rhs_isac_ros.positioning.draws import DrawnPosterior
from rhs_isac_ros.positioning.estimate import (
    Estimate,
    Fit,
    Located,
    checked_received,
    estimate_each,
)
from rhs_isac_ros.positioning.failures import FailedElements, can_enumerate
from rhs_isac_ros.positioning.grid import Query, TemplateTable, standard_normal
from rhs_isac_ros.positioning.lattice import Resolution
from rhs_isac_ros.positioning.likelihood import (
    Alignment,
    Conditional,
    DispersedLikelihood,
    Likelihood,
    Signals,
)
from rhs_isac_ros.positioning.posterior import (
    BandPhases,
    Posterior,
    WeightedSamples,
    draw_broad_samples,
    draw_samples,
)
from rhs_isac_ros.positioning.search import Modes, ascend, find_modes
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.support.threads import map_blocks, one_blas_thread

# Number of phases that are located together.
_BLOCK = 128
# Samples per mode if the phases of the bands carry information. The density then has several peaks
# within a mode, and a few of the samples carry most of the weight.
_N_INFORMATIVE = 512
# Total probability of the alternatives above which residuals are not compared with the scenario.
_DOUBT_LIMIT = 0.05


class SearchEstimator(abc.ABC):
    """Estimator based on the modes of the posterior, with a uniform prior over the region.

    If the model cannot explain the signals even at the best mode, there is no fix; see
    `diagnosis`. If the scenario has a `blocked_probability`, users may lack the direct path; see
    `alternatives`. Tables are kept between runs in `table_folder`, if it is given.

    Parameters
    ----------
    reject_outside
        Whether the user may also be outside of the region. The estimate then contains the
        probability of this; if it exceeds `alternatives.OUTSIDE_LIMIT`, there is no fix. Position
        and covariance always apply to a user inside.
    surface
        Knowledge of the surface, such as a calibration; see `MeasurementModel`.
    progress
        Called with the completed share while a table is computed, from any thread.
    """

    averages = True  # Whether positions are averages over the posterior.

    @one_blas_thread
    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None, *, reject_outside: bool = False,
            surface: Surface | None = None,
            progress: Callable[[float], None] | None = None) -> None:
        self.scenario, self.surface = scenario, surface
        self._likelihood = likelihood = Likelihood(scenario, codebook, surface)
        arrays = load_table(likelihood.model, codebook.id, table_folder, progress)
        self._grid = TemplateTable(scenario, arrays)
        self._alternatives: list[Alternative] = []
        if reject_outside:
            self._alternatives.append(Outside(scenario, arrays))
        if scenario.blocked_probability:
            self._alternatives.append(Blocked(scenario))
        prior, n_measurements = likelihood.nuisance, int(np.prod(likelihood.model.shape))
        # Median multipath level of users in sight, and the share of a residual's deviation that
        # is due to the level.
        median_db, std_db = scenario.multipath_level_db
        self._level = 10**(median_db / 10)
        self._level_share = share_of_level(n_measurements, std_db)
        self._test = FitTest(n_measurements, self._level)
        self._bounds = likelihood.resolution.bounds_m
        self._prior_m2 = float(np.sum((self._bounds[1] - self._bounds[0])**2)) / 12
        self._alignment = Alignment(likelihood, self._grid.spread)
        self._phases = BandPhases(likelihood)
        self._failures = (FailedElements(likelihood, self._grid)
                          if surface is None and can_enumerate(scenario) else None)
        self._dispersed = None if self._failures else DispersedLikelihood.of(likelihood)
        # Twice an energy has two degrees of freedom for each complex measurement, less one for
        # each fitted coordinate or parameter.
        n_fitted = 3 + len(prior)
        self._mean_residual = max(n_measurements - n_fitted / 2, 0.5)
        # Points that represent a standard Gaussian, float64 [128, 3].
        self.normal = self._grid.normal
        self._normal = (standard_normal(_N_INFORMATIVE) if self._phases.is_informative
                        else self.normal)
        # The likelihood of positions; None if it also depends on other unknowns.
        self.exact_likelihood = None if (
            len(prior) or self._failures or self._dispersed) else likelihood
        self._drawn = (DrawnPosterior(scenario, self._grid)
                       if self.averages and self.exact_likelihood else None)

    @one_blas_thread
    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals; see `Estimator.estimate`."""
        return estimate_each(self.scenario, self._likelihood.codebook, received, self._locate)

    @one_blas_thread
    def posterior(self, received: np.ndarray) -> Posterior:
        """Compute the posterior for the signals of one phase, complex128 [N_B, N_SB F]."""
        batch = checked_received(self._likelihood.codebook, received)
        signals = self._likelihood.signals(batch)
        ((located, modes),) = self._locate_block(signals, draws=False)
        return Posterior(Estimate(*located), modes, signals)

    @abc.abstractmethod
    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        """Return positions, [N, 3], and covariances, [N, 3, 3], of N phases."""

    def _locate(self, batch: np.ndarray) -> Iterable[Located]:
        signals = self._likelihood.signals(batch)
        parts = map_blocks(
            lambda block: self._locate_block(select(signals, block), draws=True),
            blocks(len(batch), _BLOCK))
        return (located for located, _ in itertools.chain.from_iterable(parts))

    def _locate_block(self, signals: Signals, draws: bool
                      ) -> list[tuple[Located, Modes | None]]:
        """Locate phases together; with `draws`, draw positions if there are too many modes."""
        energies = np.sum(np.abs(signals.received)**2, axis=(1, 2)) / self.scenario.noise_power_w
        reasons = [self._test.min_energy_test(energy) for energy in energies.tolist()]
        results: list[tuple[Located, Modes | None]] = [
            ((*_no_fix(), reason), None) for reason in reasons]
        (usable,) = np.nonzero([not reason for reason in reasons])
        if len(usable):
            signals = select(signals, usable)
            aligned = self._alignment.values_of_each(signals.received)
            fits = self._search(signals, aligned, draws)
            for row, (fit, modes), *phase in zip(usable.tolist(), fits, self._likelihood.whitened(
                    aligned, signals), aligned, strict=True):
                located = self._judge(fit, *phase)
                results[row] = located, None if located[2] else modes
        return results

    def _search(self, signals: Signals, aligned: np.ndarray, draws: bool
                ) -> list[tuple[Fit, Modes | None]]:
        """Find the posterior and modes of each phase; the modes are None after draws."""
        likelihood, fits = self._likelihood, dict[int, tuple[Fit, Modes | None]]()
        extra = self._failures.search_margin if self._failures else 0.0

        def draw(query: Query, row: int) -> bool:
            found = self._drawn.of(query, row) if self._drawn else None
            if found is not None:
                fits[query.first + row] = found, None
            return found is not None

        modes = find_modes(
            likelihood, self._grid, signals, aligned, extra, draw if draws else None)
        if modes:
            rows = [phase for phase in range(len(aligned)) if phase not in fits]
            fits.update(zip(rows, self._fit(modes, signals, rows), strict=True))
        return [fits[phase] for phase in range(len(aligned))]

    def _fit(self, modes: Modes, signals: Signals, rows: list[int]
             ) -> Iterator[tuple[Fit, Modes]]:
        """Yield posterior and modes of each phase in `rows`, in ascending order."""
        likelihood = self._likelihood
        conditionals: dict[int, Sequence[Conditional]] = dict.fromkeys(
            rows, [self._dispersed or likelihood])
        if self._dispersed:
            modes = ascend(self._dispersed, likelihood, modes.starts(), signals, 1, np.inf)
        if self._failures:
            parts = []
            for phase in rows:
                one, conditionals[phase] = self._failures.refine(
                    modes.of_phase(phase), select(signals, [phase]))
                # Each part counts its phases from 0.
                parts.append(one._replace(phases=np.full(len(one.phases), phase)))
            modes = concatenate(*parts)
        if likelihood.nuisance.is_coarse:
            drawn = concatenate(*(
                draw_broad_samples(likelihood, conditionals[phase], self._phases,
                                   select(signals, [phase]), modes.of_phase(phase), self._normal)
                for phase in rows))
        else:
            drawn = draw_samples(modes, self._normal, self._bounds)
        samples = WeightedSamples.of(drawn, modes)
        means, covariances = self._moments(modes, samples)
        log_evidence = samples.log_evidence(likelihood.resolution.volume_m3)
        # If the model holds, twice the residual energy, averaged over the posterior, has the mean
        # of a chi-square variable. At the best of several modes, it is smaller than the average.
        expected = self._mean_residual - samples.average(modes.residual)
        # The best mode of each phase comes first.
        for row, (phase, best) in enumerate(zip(rows, samples.starts.tolist(), strict=True)):
            residual = float(modes.residual[best])
            fit = Fit(means[row], covariances[row], float(log_evidence[row]), residual,
                      expected[row] + residual, modes.values[best] @ likelihood.nuisance.gain)
            yield fit, modes.of_phase(phase)

    def _judge(self, fit: Fit, whitened: np.ndarray, aligned: np.ndarray) -> Located:
        """Return the position of one phase, or the reason why there is none."""
        log_weights = np.array([fit.log_evidence, *(
            one.log_odds + one.log_evidence_of(
                whitened, aligned, fit.residual, self._likelihood.nuisance)
            for one in self._alternatives)])
        probabilities, _ = mixture_weights(log_weights)
        reason = self._reason(whitened * np.exp(-fit.gain), fit.residual, log_weights)
        mean, covariance = _no_fix() if reason else (fit.mean, self._covariance(fit))
        # Without a fix, only a residual that nothing explains is evidence against the scenario.
        counts = (reason == self._test.residual_test(fit.residual) if reason
                  else probabilities[0] >= 1 - _DOUBT_LIMIT)
        by_name = {one.name: float(share) for one, share in zip(
            self._alternatives, probabilities[1:], strict=True)}
        outside, blocked = (by_name.get(kind.name, np.nan) for kind in ALTERNATIVES)
        expected = fit.expected if counts else np.nan
        return mean, covariance, reason, fit.residual, expected, outside, blocked

    def _covariance(self, fit: Fit) -> np.ndarray:
        """Return the covariance, scaled to the multipath level that the residual indicates."""
        relative = max(fit.residual, 1e-9) / (self._level * max(fit.expected, 0.5))
        # The scaled covariance does not exceed the prior's, unless the original one does.
        largest = max(self._prior_m2 / float(fit.covariance.trace()), 1.0)
        return min(relative**self._level_share, largest) * fit.covariance

    def _reason(self, whitened: np.ndarray, residual: float, log_weights: np.ndarray) -> str:
        """Return the reason why there is no fix, or '' if there is one."""
        # If no position in the region explains the signals, an alternative is the reason only if
        # it explains them.
        unexplained = self._test.residual_test(residual) or self._test.weak_test(
            float(np.sum(np.abs(whitened)**2)), residual)
        for index in np.argsort(-log_weights[1:]).tolist():
            one = self._alternatives[index]
            (_, share), _ = mixture_weights(log_weights[[0, 1 + index]])
            reason = rejection(one, float(share))
            if reason and (not unexplained or one.explain(whitened, self._test.max_residual)):
                return reason
        return unexplained


class BayesEstimator(SearchEstimator):
    """Mean and covariance of the posterior, from samples inside the region."""

    name = 'bayes'

    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        mean, covariance = samples.moments()
        # The mean of few samples is itself uncertain; its covariance never exceeds the prior's.
        prior = np.diag((self._bounds[1] - self._bounds[0])**2 / 12)
        within = samples.average(np.matmul(samples.spread, np.swapaxes(samples.spread, 1, 2)))
        within = within @ np.linalg.solve(within + prior, np.broadcast_to(prior, within.shape))
        share = samples.sums(np.einsum('ms,ms->m', samples.weights, samples.weights))
        covariance += within * share[:, None, None]
        return mean, symmetric(covariance)


class MlEstimator(SearchEstimator):
    """The most likely position in the region; the covariance is the inverse of the curvature."""

    name, averages = 'ml', False

    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        best = select(modes, samples.starts)
        points = best.roi_points
        by_point = jacobian(points)
        covariance = np.matmul(
            by_point, np.linalg.solve(best.curvature, np.swapaxes(by_point, 1, 2)))
        positions = np.clip(to_positions(points), *self._bounds)
        return positions, symmetric(covariance)


class WeightedModes(NamedTuple):
    """The posterior as a mixture of M components, the most probable first."""

    probabilities: np.ndarray  #: Float64 [M]; their sum is 1.
    positions: np.ndarray  #: Means of the components, float64 [M, 3] [m].
    covariances: np.ndarray  #: Float64 [M, 3, 3] [m^2].


@one_blas_thread
def weighted_modes(estimator: SearchEstimator, received: np.ndarray) -> WeightedModes | None:
    """Compute the mixture of modes for signals of one phase, [N_B, N_SB F] or [N_B, N_SB, F].

    The mixture has the mean and covariance that `BayesEstimator` estimates, up to sampling errors,
    unless the latter averages over draws, bands have unknown phases, or multipath levels vary.
    Returns None without a position. Raises `SignalError` if the signals cannot be used.
    """
    modes = estimator.posterior(received.reshape(len(received), -1)).modes
    if modes is None:
        return None
    samples = WeightedSamples.of(draw_samples(
        modes, estimator.normal, Resolution.of(estimator.scenario).bounds_m), modes)
    shares = samples.weights.sum(axis=1)
    order = np.argsort(-shares)[:np.count_nonzero(shares)]
    weights = samples.weights[order] / shares[order, None]
    return WeightedModes(shares[order], *moments(weights, samples.positions[order]))


def _no_fix() -> tuple[np.ndarray, np.ndarray]:
    return np.full(3, np.nan), np.full((3, 3), np.nan)
