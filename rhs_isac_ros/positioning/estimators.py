"""Estimators that search for the modes of the posterior: `bayes` and `ml`."""

import abc
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.positioning.alternatives import (
    ALTERNATIVES,
    Alternative,
    Blocked,
    Outside,
    rejection,
    shares,
)
from rhs_isac_ros.positioning.coordinates import concatenate, jacobian, symmetric, to_positions
from rhs_isac_ros.positioning.diagnosis import FitTest
from rhs_isac_ros.positioning.estimate import (
    Estimate,
    Estimator,
    Located,
    checked_received,
    estimate_each,
)
from rhs_isac_ros.positioning.failures import FailedElements, can_enumerate
from rhs_isac_ros.positioning.grid import TemplateTable, first_of_each, standard_normal
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
    Samples,
    WeightedSamples,
    draw_broad_samples,
    draw_samples,
)
from rhs_isac_ros.positioning.search import Modes, ascend, find_modes
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.support.threads import map_blocks, one_blas_thread

# Coordinates fitted to the signals of each phase.
_N_COORDINATES = 3
# Number of phases that are located together.
_BLOCK = 128
# Samples of a mode if the phases of the bands carry information: their density has several peaks
# within a mode, so that fewer samples have most of the weight.
_N_INFORMATIVE = 512
# Probability of all alternatives above which residuals are not compared with the scenario.
_DOUBT_LIMIT = 0.05


class _Search(NamedTuple):
    """The result of a search for several phases."""

    modes: Modes
    samples: Samples
    # Whitened signals without the parameters that they reveal, complex128 [N, N_B, N_SB F].
    whitened: np.ndarray
    # Logarithm of the prior odds of each alternative times its evidence, float64 [N, A].
    log_weights: np.ndarray


class SearchEstimator(abc.ABC):
    """An estimator from the modes of the posterior, for a uniform prior on the region of interest.

    Signals that the model cannot explain at the best mode give no fix; see `diagnosis`. If the
    scenario has a `blocked_probability`, users may lack the direct path; see `alternatives`.
    Tables are kept in `table_folder` between runs.

    Parameters
    ----------
    reject_outside
        Whether the user may also be outside of the region. If this is almost certain
        (`alternatives.OUTSIDE_LIMIT`), there is no fix. Otherwise the estimate contains its
        probability, while position and covariance remain those of a user inside.
    surface
        What is known of the surface, as in `MeasurementModel`; for example a calibration.
    """

    @one_blas_thread
    def __init__(
            self, scenario: Scenario, codebook: Codebook,
            table_folder: Path | None = None, *, reject_outside: bool = False,
            surface: Surface | None = None) -> None:
        self.scenario, self.surface = scenario, surface
        self._likelihood = likelihood = Likelihood(scenario, codebook, surface)
        arrays = load_table(likelihood.model, codebook.id, table_folder)
        self._grid = TemplateTable(scenario, arrays)
        self._alternatives: list[Alternative] = []
        if reject_outside:
            self._alternatives.append(Outside(scenario, arrays))
        if scenario.blocked_probability:
            self._alternatives.append(Blocked(scenario))
        prior, n_measurements = likelihood.nuisance, int(np.prod(likelihood.model.shape))
        self._test = FitTest(n_measurements)
        self._bounds = likelihood.resolution.bounds_m
        self._alignment = Alignment(likelihood, self._grid.spread)
        self._phases = BandPhases(likelihood)
        self._failures = (FailedElements(likelihood, self._grid)
                          if surface is None and can_enumerate(scenario) else None)
        self._dispersed = None if self._failures else DispersedLikelihood.of(likelihood)
        # Twice an energy has two degrees of freedom for each complex measurement, less one for
        # each fitted parameter.
        n_fitted = _N_COORDINATES + len(prior)
        self._mean_residual = max(n_measurements - n_fitted / 2, 0.5)
        # Points that represent a standard Gaussian, float64 [128, 3].
        self.normal = self._grid.normal
        self._normal = (standard_normal(_N_INFORMATIVE) if self._phases.is_informative
                        else self.normal)
        # The likelihood of positions; None if it also depends on other unknowns.
        self.exact_likelihood = None if (
            len(prior) or self._failures or self._dispersed) else likelihood

    @one_blas_thread
    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals, as `Estimator.estimate` describes."""
        return estimate_each(self.scenario, self._likelihood.codebook, received, self._locate)

    @one_blas_thread
    def posterior(self, received: np.ndarray) -> Posterior:
        """Compute the posterior for the signals of one phase, complex128 [N_B, N_SB F]."""
        batch = checked_received(self._likelihood.codebook, received)
        signals = self._likelihood.signals(batch)
        ((located, modes),) = self._locate_block(signals)
        return Posterior(Estimate(*located), modes, signals)

    @abc.abstractmethod
    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        """Return positions, [N, 3], and covariances, [N, 3, 3], of N phases."""

    def _locate(self, batch: np.ndarray) -> Iterable[Located]:
        signals = self._likelihood.signals(batch)
        blocks = map_blocks(
            lambda start: self._locate_block(signals.take(slice(start, start + _BLOCK))),
            range(0, len(batch), _BLOCK))
        return (located for located, _ in itertools.chain.from_iterable(blocks))

    def _locate_block(self, signals: Signals) -> list[tuple[Located, Modes | None]]:
        """Locate phases together: position or reason, and modes if there is a position."""
        energies = np.sum(np.abs(signals.received)**2, axis=(1, 2)) / self.scenario.noise_power_w
        reasons = [self._test.min_energy_test(energy) for energy in energies.tolist()]
        results: list[tuple[Located, Modes | None]] = [
            ((*_no_fix(), reason), None) for reason in reasons]
        (usable,) = np.nonzero([not reason for reason in reasons])
        if len(usable):
            found = self._search(signals.take(usable))
            for row, result in zip(usable.tolist(), self._judge(found), strict=True):
                results[row] = result
        return results

    def _search(self, signals: Signals) -> _Search:
        """Search for the modes of N phases."""
        likelihood = self._likelihood
        aligned = self._alignment.values_of_each(signals.received)
        extra = self._failures.search_margin if self._failures else 0.0
        modes = find_modes(likelihood, self._grid, signals, aligned, extra_margin=extra)
        conditionals: list[Sequence[Conditional]] = [
            [self._dispersed or likelihood]] * len(aligned)
        if self._dispersed:
            modes = ascend(self._dispersed, likelihood, modes.starts(), signals, 1, np.inf)
        if self._failures:
            refined = [self._failures.refine(modes.of_phase(phase), signals.repeated(phase))
                       for phase in range(len(aligned))]
            # Each part counts its phases from 0.
            modes = concatenate(*(one._replace(phases=np.full(len(one.phases), phase))
                                  for phase, (one, _) in enumerate(refined)))
            conditionals = [sets for _, sets in refined]
        if likelihood.nuisance.is_coarse:
            samples = concatenate(*(
                draw_broad_samples(likelihood, conditionals[phase], self._phases,
                                   signals.repeated(phase), modes.of_phase(phase), self._normal)
                for phase in range(len(aligned))))
        else:
            samples = draw_samples(modes, self._normal, self._bounds)
        whitened = likelihood.whitened(aligned, signals)
        best = np.minimum.reduceat(modes.residual, first_of_each(modes.phases))
        log_weights = np.array([
            [one.log_odds + one.log_evidence_of(*phase, likelihood.nuisance)
             for one in self._alternatives]
            for phase in zip(whitened, aligned, best.tolist(), strict=True)])
        return _Search(modes, samples, whitened, log_weights)

    def _judge(self, found: _Search) -> Iterator[tuple[Located, Modes | None]]:
        """Yield the position of each phase, or why there is none, and its modes."""
        modes = found.modes
        samples = WeightedSamples.of(found.samples, modes)
        log_weights = np.column_stack([
            samples.log_evidence(self._likelihood.resolution.volume_m3), found.log_weights])
        probabilities = shares(log_weights)
        means, covariances = self._moments(modes, samples)
        # Averaged over the posterior, the energy of a model that holds has the mean of a
        # chi-square variable. At the best of several modes it is smaller, by the difference from
        # the average.
        expected = self._mean_residual - samples.average(modes.residual)
        likelihood = modes.roi_log_likelihood
        ends = [*samples.starts[1:].tolist(), len(modes.phases)]
        for row, (start, end) in enumerate(zip(samples.starts.tolist(), ends, strict=True)):
            best = start + int(np.argmax(likelihood[start:end]))
            residual = float(modes.residual[best])
            gain = modes.values[best] @ self._likelihood.nuisance.gain
            reason = self._reason(found.whitened[row] * np.exp(-gain), residual, log_weights[row])
            moments = _no_fix() if reason else (means[row], covariances[row])
            # Of signals without a fix, only a residual that nothing explains is evidence against
            # the scenario.
            counts = (reason == self._test.residual_test(residual) if reason
                      else probabilities[row, 0] >= 1 - _DOUBT_LIMIT)
            by_name = {one.name: float(share) for one, share in zip(
                self._alternatives, probabilities[row, 1:], strict=True)}
            outside, blocked = (by_name.get(kind.name, np.nan) for kind in ALTERNATIVES)
            yield ((*moments, reason, residual, expected[row] + residual if counts else np.nan,
                    outside, blocked),
                   None if reason else modes.select(slice(start, end)))

    def _reason(self, whitened: np.ndarray, residual: float, log_weights: np.ndarray) -> str:
        """Return why there is no fix, empty if there is one."""
        # If no position of the region explains the signals, an alternative has to explain them to
        # be the reason.
        unexplained = self._test.residual_test(residual) or self._test.weak_test(
            float(np.sum(np.abs(whitened)**2)), residual)
        for index in np.argsort(-log_weights[1:]).tolist():
            one = self._alternatives[index]
            share = float(shares(log_weights[None, [0, 1 + index]])[0, 1])
            reason = rejection(one, share)
            if reason and (not unexplained or one.explain(whitened, self._test.max_residual)):
                return reason
        return unexplained


class BayesEstimator(SearchEstimator):
    """Mean and covariance of the posterior, from the Gaussians of all modes inside the region."""

    name = 'bayes'

    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        mean, covariance = samples.moments()
        # The mean of few samples is itself uncertain; its covariance never exceeds that of the
        # prior.
        prior = np.diag((self._bounds[1] - self._bounds[0])**2 / 12)
        within = samples.average(np.matmul(samples.spread, np.swapaxes(samples.spread, 1, 2)))
        within = within @ np.linalg.solve(within + prior, np.broadcast_to(prior, within.shape))
        share = samples.sums(np.einsum('ms,ms->m', samples.weights, samples.weights))
        covariance += within * share[:, None, None]
        return mean, symmetric(covariance)


class MlEstimator(SearchEstimator):
    """The most likely position in the region, with the inverse curvature as its covariance."""

    name = 'ml'

    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        order = np.lexsort((-modes.roi_log_likelihood, modes.phases))
        best = order[samples.starts]
        points = modes.roi_points[best]
        by_point = jacobian(points)
        covariance = np.matmul(
            by_point, np.linalg.solve(modes.curvature[best], np.swapaxes(by_point, 1, 2)))
        positions = np.clip(to_positions(points), *self._bounds)
        return positions, symmetric(covariance)


class WeightedModes(NamedTuple):
    """The posterior as a mixture of M components, the most probable first."""

    probabilities: np.ndarray  #: Float64 [M]; their sum is 1.
    positions: np.ndarray  #: Means of the components, float64 [M, 3] [m].
    covariances: np.ndarray  #: Float64 [M, 3, 3] [m^2].


@one_blas_thread
def weighted_modes(estimator: SearchEstimator, received: np.ndarray) -> WeightedModes | None:
    """Compute the modes for the signals of one phase, complex128 [N_B, N_SB F] or [N_B, N_SB, F].

    Mean and covariance of the mixture are those of the estimate of `BayesEstimator`, up to the
    uncertainty of the mean of its samples. The result is None if there is no position. Raises
    `SignalError` if the signals cannot be used.
    """
    modes = estimator.posterior(received.reshape(len(received), -1)).modes
    if modes is None:
        return None
    samples = draw_samples(modes, estimator.normal, Resolution.of(estimator.scenario).bounds_m)
    weights = np.exp(samples.log_weights - samples.log_weights.max())
    shares = weights.sum(axis=1)
    order = np.argsort(-shares)[:np.count_nonzero(shares)]
    shares, places = shares[order], samples.positions[order]
    weights = weights[order] / shares[:, None]
    means = np.einsum('ms,msa->ma', weights, places)
    offsets = places - means[:, None]
    covariances = np.einsum('ms,msa,msb->mab', weights, offsets, offsets)
    return WeightedModes(shares / shares.sum(), means, covariances)


def surface_of(estimator: Estimator) -> Surface | None:
    """Return what an estimator assumes to be known of the surface; None for other estimators."""
    return estimator.surface if isinstance(estimator, SearchEstimator) else None


def _no_fix() -> tuple[np.ndarray, np.ndarray]:
    return np.full(3, np.nan), np.full((3, 3), np.nan)
