"""Estimators that search for the modes of the posterior: `bayes` and `ml`."""

import abc
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import blocks, mixture_weights
from rhs_isac_ros.model.gaussian import moments, share_of_level
from rhs_isac_ros.model.geometry import to_positions
from rhs_isac_ros.positioning.alternatives import Alternative, Blocked, Outside, rejection
from rhs_isac_ros.positioning.diagnosis import FitTest
from rhs_isac_ros.positioning.draws import DrawnPosterior
from rhs_isac_ros.positioning.estimate import (
    Estimate,
    Fit,
    checked_received,
    estimate_each,
    regular,
)
from rhs_isac_ros.positioning.failures import refinement_of
from rhs_isac_ros.positioning.grid import TemplateTable
from rhs_isac_ros.positioning.lattice import Grid, Resolution, lay_grid
from rhs_isac_ros.positioning.likelihood import (
    Alignment,
    Likelihood,
    Signals,
)
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.posterior import (
    BandPhases,
    Posterior,
    WeightedSamples,
    draw_broad_samples,
    draw_samples,
)
from rhs_isac_ros.positioning.prior import (
    MIN_EXTENT_M,
    PRIOR_MARGIN,
    WRONG,
    bend,
    cells_of,
    flatten,
    inside,
    is_doubtful,
    multiply,
    uniform,
)
from rhs_isac_ros.positioning.search import GRID_MARGIN, Modes, modes_from
from rhs_isac_ros.positioning.segments import concatenate, select
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.positioning.templates import N_NORMAL, standard_normal, tabulate
from rhs_isac_ros.support.threads import map_blocks, one_blas_thread
from rhs_isac_ros.system import System


class _Limits(NamedTuple):
    """Numbers of shots and samples, and when a residual counts."""

    # Number of shots that are located together.
    block: int = 128
    # Samples per mode if the phases of the bands carry information, and if modes are narrow. In
    # the first case, the density has several peaks within a mode, and a few of the samples carry
    # most of the weight.
    informative: int = 512
    narrow: int = 64
    # Total probability of the alternatives above which residuals are not compared with the
    # scenario.
    doubt: float = 0.05


_LIMITS = _Limits()


class Scope(NamedTuple):
    """Where modes are searched for, and what depends on the templates there."""

    table: TemplateTable
    alignment: Alignment
    alternatives: Sequence[Alternative]
    #: Cells in which less likely modes are kept as well, bool [C] or [1].
    favoured: np.ndarray
    drawn: DrawnPosterior | None = None

    @classmethod
    def of(cls, likelihood: Likelihood, arrays: Mapping[str, np.ndarray], grid: Grid) -> 'Scope':
        """Take the templates of a grid, which may be part of the region's."""
        scenario = likelihood.scenario
        table = TemplateTable(scenario, arrays, grid=grid)
        alternatives = [Blocked(scenario)] if scenario.blocked_probability else []
        return cls(table, Alignment(likelihood, table.spread), alternatives, np.zeros(1, bool))


class SearchEstimator(abc.ABC):
    """Estimator based on the modes of the posterior, with a uniform prior over the region.

    If the model cannot explain the signals even at the best mode, there is no fix; see
    `diagnosis`. If the scenario has a `blocked_probability`, users may lack the direct path; see
    `alternatives`. Tables are kept between runs in `table_folder`, if it is given.

    Parameters
    ----------
    reject_outside
        Whether the user may also be outside of the region, with the prior probability
        `Scenario.outside_probability`. The estimate then contains the probability of this; if it
        exceeds `alternatives.LIMIT`, there is no fix. Position and covariance always apply to a
        user inside.
    progress
        Called with the completed share while a table is computed, from any thread.
    lazy
        Whether the table of the region is computed only when it is first needed. With a mixture as
        prior, it rarely is.
    """

    averages = True  # Whether positions are averages over the posterior.

    @one_blas_thread
    def __init__(
            self, system: System, table_folder: Path | None = None, *,
            reject_outside: bool = False, progress: Callable[[float], None] | None = None,
            lazy: bool = False) -> None:
        self.system, self.scenario = system, system.scenario
        scenario = system.scenario
        self._likelihood = likelihood = Likelihood(system)
        self._rejects_outside = reject_outside and bool(scenario.outside_probability)
        self._load = functools.partial(load_table, system, table_folder, progress)
        prior, n_measurements = likelihood.nuisance, int(np.prod(likelihood.model.shape))
        median_db, std_db = scenario.multipath_level_db
        # Median multipath level of users in sight, and the share of a residual's deviation that
        # is due to the level.
        self._level, self._n_measurements = 10**(median_db / 10), n_measurements
        self._level_share = share_of_level(n_measurements, std_db)
        self._test = FitTest(n_measurements, self._level)
        self._bounds = likelihood.resolution.bounds_m
        self._prior_m2 = float(np.sum((self._bounds[1] - self._bounds[0])**2)) / 12
        self._phases = BandPhases(likelihood)
        self._refinement = refinement_of(likelihood)
        # Twice an energy has two degrees of freedom for each complex measurement, less one for
        # each fitted coordinate or parameter.
        n_fitted = 3 + len(prior)
        self._mean_residual = max(n_measurements - n_fitted / 2, 0.5)
        # The likelihood of positions; None if it also depends on other unknowns.
        self._exact_likelihood = (
            likelihood if self._refinement.is_exact and not len(prior) else None)
        # Points that represent a standard Gaussian, float64 [128, 3].
        self.normal = standard_normal(N_NORMAL) if lazy else self._region.table.normal
        self._mode_normal = (
            standard_normal(_LIMITS.informative) if self._phases.is_informative
            else self.normal if prior.is_coarse else self.normal[:_LIMITS.narrow])

    @functools.cached_property
    def _region(self) -> Scope:
        """The whole region."""
        scenario, arrays = self.scenario, self._load(outside=self._rejects_outside)
        scope = Scope.of(self._likelihood, arrays, lay_grid(scenario))
        if self._rejects_outside:
            scope = scope._replace(
                alternatives=[Outside(scenario, arrays), *scope.alternatives])
        if self.averages and self._exact_likelihood:
            scope = scope._replace(drawn=DrawnPosterior(scenario, scope.table))
        return scope

    def prepare(self) -> None:
        """Compute the table of the region, unless it exists; any thread may call this."""
        _ = self._region

    def _scopes(self, bent: Mixture) -> Iterator[Scope]:
        """Yield the part of the grid that a prior in (r [m], u, v) covers, and then the region.

        The part is left out if the table of the region exists.
        """
        likelihood, grid = self._likelihood, lay_grid(self.scenario)
        chosen = cells_of(bent, grid, likelihood.resolution)
        # A cached property is in vars() once it is computed.
        if '_region' not in vars(self) and chosen.any():
            part = grid.within(chosen)
            scope = Scope.of(likelihood, tabulate(likelihood.model, grid=part), part)
            yield scope._replace(favoured=np.ones(1, bool))
        yield self._region._replace(favoured=chosen)

    @one_blas_thread
    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals; see `Estimator.estimate`."""
        return estimate_each(self._likelihood.codebook, received, self._locate)

    @one_blas_thread
    def posterior(self, received: np.ndarray, prior: Mixture | None = None, *,
                  wrong: float = WRONG, share: float = 1.0) -> Posterior:
        """Compute the posterior for the signals of one shot, complex128 [N_B, N_SB F].

        The probabilities of users outside or blocked, and the reason why there is no position, are
        those without the prior. Users outside are considered only if the whole region is searched.
        Raises `SignalError` if the signals are unusable.

        Parameters
        ----------
        prior
            Mixture in the frame of the site; by default, a uniform density on the region. If the
            table of the region does not exist yet, only the cells where the prior is are searched
            at first, and the region if the prior does not explain the signals.
        wrong
            Probability that the prior does not hold, and the user is anywhere in the region.
        share
            Exponent of the likelihood with a mixture as prior; see `independent_share`.
        """
        batch = checked_received(self._likelihood.codebook, received)
        signals = self._likelihood.signals(batch)
        if prior is not None:
            return self._update(signals, prior, wrong, share)
        ((estimate, modes),) = self._locate_block(self._region, signals, draws=True)
        if modes is None and not estimate.reason:
            # The position is an average over draws, as in `estimate`; a search yields modes.
            ((_, modes),) = self._locate_block(self._region, signals, draws=False)
        return Posterior(estimate, modes, signals, modes and flatten(
            uniform(modes, self._bounds).normalised(), self.scenario.pose))

    def _update(self, signals: Signals, prior: Mixture, wrong: float, share: float) -> Posterior:
        """Compute the posterior with a mixture as prior; see `posterior`."""
        pose, extent = self.scenario.pose, self._bounds[1] - self._bounds[0]
        region = (pose.to_site(self._bounds.mean(axis=0)), pose.covariances_to_site(
            np.diag(np.maximum(extent, MIN_EXTENT_M)**2)))
        # The component for the whole region comes last.
        before = bend(prior.or_within(*region, wrong), pose)
        for scope in self._scopes(select(before, slice(-1))):
            ((estimate, modes),) = self._locate_block(scope, signals, draws=False)
            if modes is None:
                continue
            products = multiply(
                before, modes, share, self._exact_likelihood, signals, self._bounds)
            if not is_doubtful(products.energy / self._level, self._n_measurements):
                break
        if modes is None:
            return Posterior(estimate, None, signals)
        found = products.bent
        blocked, outside = np.nan_to_num(
            [float(estimate.blocked_probability), float(estimate.outside_probability)])
        if blocked:
            # Signals without a direct path contain no information. The odds are relative to a user
            # anywhere in the region.
            odds = share * np.log(blocked / max(1 - blocked - outside, 1e-12))
            everywhere = uniform(modes, self._bounds, share).log_mass
            found = concatenate(found, before.weighted(everywhere + odds))
        found, mean, covariance = inside(
            found.reduce(), self._bounds, self.normal[:_LIMITS.narrow])
        return Posterior(dataclasses.replace(estimate, mean=mean, covariance=covariance), modes,
                         signals, flatten(found, pose), products.is_last)

    @abc.abstractmethod
    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        """Return positions, [N, 3], and covariances, [N, 3, 3], of N shots."""

    def _locate(self, batch: np.ndarray) -> Iterator[Estimate]:
        signals = self._likelihood.signals(batch)
        parts = map_blocks(
            lambda block: self._locate_block(self._region, select(signals, block), draws=True),
            blocks(len(batch), _LIMITS.block))
        return (estimate for estimate, _ in itertools.chain.from_iterable(parts))

    def _locate_block(self, scope: Scope, signals: Signals, draws: bool
                      ) -> list[tuple[Estimate, Modes | None]]:
        """Return the estimate and the modes of each of several shots.

        With `draws`, positions are drawn if the search for modes would be too long. The modes are
        None after draws and without a position.
        """
        energies = np.sum(np.abs(signals.received)**2, axis=(1, 2)) / self.scenario.noise_power_w
        reasons = list(map(self._test.min_energy_test, energies.tolist()))
        found: list[tuple[Estimate, Modes | None]] = [
            (Estimate.without_fix(reason), None) for reason in reasons]
        usable = [row for row, reason in enumerate(reasons) if not reason]
        if usable:
            signals = select(signals, usable)
            aligned = scope.alignment.values_of_each(signals.received)
            whitened = self._likelihood.whitened(aligned, signals)
            fits = self._fits(scope, signals, aligned, whitened, draws)
            for row, (fit, modes), one, values in zip(
                    usable, fits, whitened, aligned, strict=True):
                estimate = self._judge(scope.alternatives, fit, one, values)
                found[row] = estimate, None if estimate.reason else modes
        return found

    def _fits(self, scope: Scope, signals: Signals, aligned: np.ndarray, whitened: np.ndarray,
              draws: bool) -> list[tuple[Fit, Modes | None]]:
        """Find the posterior and the modes of each shot; the modes are None after draws."""
        # Margin of modes in each cell, beyond the usual one.
        margin = self._refinement.margin + PRIOR_MARGIN * scope.favoured
        starts, drawn = scope.table.search(
            whitened, self._likelihood.nuisance, GRID_MARGIN + scope.alignment.margin + margin,
            scope.drawn.fit if scope.drawn and draws else None)
        fits: dict[int, tuple[Fit, Modes | None]] = {
            shot: (fit, None) for shot, fit in drawn.items()}
        if len(starts.shots):
            modes = modes_from(
                starts, self._likelihood, signals, aligned, float(margin.max()))
            fits.update(self._fits_of(scope, modes, signals))
        return [fits[shot] for shot in range(len(aligned))]

    def _fits_of(self, scope: Scope, modes: Modes, signals: Signals
                 ) -> Iterator[tuple[int, tuple[Fit, Modes]]]:
        """Yield each shot that has modes, with its posterior and its refined modes."""
        likelihood = self._likelihood
        modes, conditionals = self._refinement.refine(modes, signals, scope.table)
        if likelihood.nuisance.is_coarse:
            drawn = concatenate(*(
                draw_broad_samples(likelihood, of_shot, self._phases, select(signals, [shot]),
                                   modes.of_shot(shot), self._mode_normal)
                for shot, of_shot in conditionals.items()))
        else:
            drawn = draw_samples(modes, self._mode_normal, self._bounds)
        samples = WeightedSamples.of(drawn, modes)
        means, covariances = self._moments(modes, samples)
        # If the model holds, twice the residual energy, averaged over the posterior, has the mean
        # of a chi-square variable. At the best of several modes, it is smaller than the average.
        # The best mode of each shot comes first.
        residuals = samples.of_shot.first(modes.residual)
        expected = self._mean_residual - (samples.average(modes.residual) - residuals)
        gains = samples.of_shot.first(modes.values) @ likelihood.nuisance.gain
        for shot, *fit in zip(
                conditionals, means, covariances, samples.log_evidence.tolist(),
                residuals.tolist(), expected.tolist(), gains.tolist(), strict=True):
            yield shot, (Fit(*fit), modes.of_shot(shot))

    def _judge(self, alternatives: Sequence[Alternative], fit: Fit, whitened: np.ndarray,
               aligned: np.ndarray) -> Estimate:
        """Return the position of one shot, or the reason why there is none."""
        log_weights = np.array([fit.log_evidence, *(
            one.log_odds + one.log_evidence_of(
                whitened, aligned, fit.residual, self._likelihood.nuisance)
            for one in alternatives)])
        probabilities, _ = mixture_weights(log_weights)
        weights = self._likelihood.weights_at(np.array([fit.gain]))[0]
        reason = self._reason(alternatives, whitened * np.exp(-fit.gain) * weights,
                              fit.residual, probabilities)
        # Without a fix, only a residual that nothing explains is evidence against the scenario.
        # The residual is the reason if the texts are equal.
        is_evidence = (reason == self._test.residual_test(fit.residual) if reason
                       else probabilities[0] >= 1 - _LIMITS.doubt)
        statistics = {
            'residual': fit.residual, 'expected_residual': fit.expected if is_evidence else np.nan,
            **{f'{one.name}_probability': float(share) for one, share in zip(
                alternatives, probabilities[1:], strict=True)}}
        if reason:
            return Estimate.without_fix(reason, **statistics)
        return Estimate(fit.mean, self._covariance(fit), reason, **statistics)

    def _covariance(self, fit: Fit) -> np.ndarray:
        """Return the covariance, scaled to the multipath level that the residual indicates."""
        relative = max(fit.residual, 1e-9) / (self._level * max(fit.expected, 0.5))
        # The scaled covariance does not exceed the prior's, unless the original one does.
        largest = max(self._prior_m2 / float(fit.covariance.trace()), 1.0)
        return min(relative**self._level_share, largest) * fit.covariance

    def _reason(self, alternatives: Sequence[Alternative], whitened: np.ndarray, residual: float,
                probabilities: np.ndarray) -> str:
        """Return the reason why there is no fix, or '' if there is one."""
        # If no position in the region explains the signals, an alternative is the reason only if
        # it explains them.
        unexplained = self._test.residual_test(residual) or self._test.weak_test(
            float(np.sum(np.abs(whitened)**2)), residual)
        in_sight, *others = probabilities.tolist()
        for probability, one in sorted(
                zip(others, alternatives, strict=True), key=lambda pair: -pair[0]):
            reason = rejection(one, probability, in_sight)
            if reason and (not unexplained or one.explain(whitened, self._test.max_residual)):
                return reason
        return unexplained


class BayesEstimator(SearchEstimator):
    """Mean and covariance of the posterior, from samples inside the region."""

    name, uses_tracks = 'bayes', True

    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        mean, covariance = samples.moments()
        return mean, regular(covariance)


class MlEstimator(SearchEstimator):
    """The most likely position in the region, and its mean squared error under the posterior."""

    name, averages = 'ml', False

    def _moments(self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        mean, covariance = samples.moments()
        best = to_positions(samples.of_shot.first(modes.points))
        offsets = best - mean
        return best, regular(covariance + offsets[:, :, None] * offsets[:, None])


class WeightedModes(NamedTuple):
    """The posterior as a mixture of M components, the most probable first."""

    probabilities: np.ndarray  #: Float64 [M]; their sum is 1.
    positions: np.ndarray  #: Means of the components, float64 [M, 3] [m].
    covariances: np.ndarray  #: Float64 [M, 3, 3] [m^2].


@one_blas_thread
def weighted_modes(estimator: SearchEstimator, received: np.ndarray) -> WeightedModes | None:
    """Compute the mixture of modes for signals of one shot, [N_B, N_SB F] or [N_B, N_SB, F].

    The mixture has the mean and covariance that `BayesEstimator` estimates, up to sampling errors,
    unless the latter averages over draws, bands have unknown phases, or multipath levels vary.
    Returns None without a position. Raises `SignalError` if the signals cannot be used.
    """
    modes = estimator.posterior(received.reshape(len(received), -1)).modes
    if modes is None:
        return None
    samples = WeightedSamples.of(draw_samples(
        modes, estimator._mode_normal, Resolution.of(estimator.scenario).bounds_m), modes)
    shares = samples.weights.sum(axis=1)
    order = np.argsort(-shares, kind='stable')[:np.count_nonzero(shares)]
    weights = samples.weights[order] / shares[order, None]
    return WeightedModes(shares[order], *moments(weights, samples.positions[order]))
