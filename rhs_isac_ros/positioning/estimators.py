"""Estimators that search for the modes of the posterior: `bayes` and `ml`."""

import abc
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Pose
from rhs_isac_ros.model.arrays import blocks, log_size, mixture_weights
from rhs_isac_ros.model.gaussian import UnknownLevel, share_of_level
from rhs_isac_ros.model.geometry import seen_bounds
from rhs_isac_ros.positioning import prior as priors
from rhs_isac_ros.positioning.alternatives import (
    Alternative,
    Blocked,
    Outside,
    log_ratios_of,
    rejection,
)
from rhs_isac_ros.positioning.beyond import places_of
from rhs_isac_ros.positioning.diagnosis import FitTest, misfit_log_ratio
from rhs_isac_ros.positioning.draws import DrawnPosterior
from rhs_isac_ros.positioning.estimate import (
    MISS_PROBABILITY,
    Estimate,
    Fit,
    Sighting,
    checked_received,
    estimate_each,
    regular,
)
from rhs_isac_ros.positioning.failures import refinement_of
from rhs_isac_ros.positioning.lattice import lay_grid
from rhs_isac_ros.positioning.likelihood import Conditional, Likelihood, Signals
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.movement import MovementTest
from rhs_isac_ros.positioning.offsets import Alignment
from rhs_isac_ros.positioning.posterior import (
    BandPhases,
    Samples,
    draw_broad_samples,
    draw_samples,
)
from rhs_isac_ros.positioning.scope import ModeSearch, SearchScope
from rhs_isac_ros.positioning.search import (
    EXACT_MARGIN,
    GRID_MARGIN,
    Modes,
    OneState,
    likely_modes,
)
from rhs_isac_ros.positioning.segments import concatenate, select
from rhs_isac_ros.positioning.sheets import Sheets
from rhs_isac_ros.positioning.store import load_table
from rhs_isac_ros.positioning.templates import N_NORMAL, standard_normal, tabulate
from rhs_isac_ros.support.fields import Field, finite
from rhs_isac_ros.support.threads import map_blocks, one_blas_thread
from rhs_isac_ros.system import System

# Number of shots that are located together.
_BLOCK = 128
# Samples per mode if the phases of the bands carry information, and if modes are narrow. In the
# first case, the density has several peaks within a mode, and a few of the samples carry most of
# the weight.
_INFORMATIVE = 512
_MOVING = 128
_NARROW = 64
# Total probability of the alternatives above which residuals are not compared with the scenario.
_DOUBT = 0.05
# Log odds of an alternative below which averages over surfaces leave no doubt.
_CLEAR = -3.0


class SearchEstimator(abc.ABC):
    """Estimator based on the modes of the posterior, with a uniform prior over the region.

    If the model cannot explain the signals even at the best mode, there is no fix; see
    `diagnosis`. If the scenario has a `blocked_probability`, users may lack the direct path; see
    `alternatives`. Tables are kept between runs in `table_folder`, if it is given.

    Parameters
    ----------
    reject_outside
        Whether the user may also be outside of the region, with the prior probability
        `Scenario.outside_probability`, if not 0. The estimate then contains the probability of
        this; if it exceeds `alternatives.LIMIT`, or all other alternatives are likely, too, there
        is no fix; see `alternatives.rejection`. Position and covariance apply to a user inside.
    progress
        Called with the completed share while a table is computed, from any thread.
    lazy
        Whether the table of the region is computed only when it is first needed. With a mixture as
        prior, it rarely is.
    left_out
        Largest share of the posterior of modes that are left out, from 1e-12 to
        `MISS_PROBABILITY`; less for a surface of a site, if other surfaces may favour them. The
        region is then that of `geometry.seen_bounds`.
    """

    averages = True  # Whether positions are averages over the posterior.

    @one_blas_thread
    def __init__(
            self, system: System, table_folder: str | Path | None = None, *,
            reject_outside: bool = False, progress: Callable[[float], None] | None = None,
            lazy: bool = False, left_out: float = MISS_PROBABILITY) -> None:
        if left_out < MISS_PROBABILITY:
            system = _in_site(system)
        self.system, self.scenario = system, (scenario := system.scenario)
        self._likelihood = likelihood = Likelihood(system)
        self._rejects_outside = reject_outside and bool(scenario.outside_probability)
        self.left_out: float = Field(
            float, low=1e-12, high=MISS_PROBABILITY).checked('left_out', left_out)
        self._load = functools.partial(
            load_table, system, table_folder, progress, model=likelihood.model)
        prior, n_measurements = likelihood.nuisance, likelihood.model.n_whitened
        median_db, std_db = scenario.multipath_level_db
        # Median multipath level of users in sight, and its share of a residual's deviation.
        self._level, self._n_measurements = 10**(median_db / 10), n_measurements
        self._unknown_level = UnknownLevel(n_measurements, (median_db, std_db))
        self._level_share = share_of_level(n_measurements, std_db)
        self._test = FitTest(n_measurements, self._level, likelihood.scenario.board.declared)
        self._movement = MovementTest.of(system, likelihood)
        self._bounds = likelihood.resolution.bounds_m
        self._prior_m2 = float(np.sum((self._bounds[1] - self._bounds[0])**2)) / 12
        self._phases = BandPhases(likelihood)
        self._refinement = refinement_of(likelihood)
        self._averaging = OneState(likelihood, EXACT_MARGIN)
        # What distinguishes users without a direct path, and their parameters.
        self._blocked = [Blocked(
            scenario, likelihood.model,
            self._averaging.states(MeasurementModel.covariance_in_shadow))
        ] if scenario.blocked_probability else []
        self._shadow = Alignment(likelihood, np.zeros_like(likelihood.model.combined_root))
        # Whether the likelihood depends on nothing but the position.
        self._is_plain = self._refinement.is_exact and not len(prior)
        # Points that represent a standard Gaussian, float64 [128, 3].
        self.normal = standard_normal(N_NORMAL) if lazy else self._region.table.normal
        self._mode_normal = (
            standard_normal(_INFORMATIVE, 3 + 3 * bool(prior.velocity.size))
            if self._phases.is_informative
            else standard_normal(_MOVING, 6) if prior.velocity.size
            else self.normal if prior.is_coarse else self.normal[:_NARROW])

    @functools.cached_property
    def _region(self) -> SearchScope:
        """The whole region."""
        scenario = self._likelihood.scenario
        scope = SearchScope.of(self._likelihood, self._load(), lay_grid(scenario), self._blocked)
        if self._rejects_outside:
            outside = Outside(
                scenario, self._load(outside=True),
                self._averaging.states(MeasurementModel.covariance), self._unknown_level)
            scope = scope._replace(alternatives=[outside, *scope.alternatives])
        if self.averages and self._is_plain:
            draws = DrawnPosterior(scenario, scope.table, self._n_measurements)
            scope = scope._replace(drawn=draws.draw(favoured=self.left_out < MISS_PROBABILITY))
        return scope

    def prepare(self) -> None:
        """Compute the table of the region, unless it exists; any thread may call this."""
        _ = self._region

    def _scopes(self, bent: Sheets, wrong: float) -> Iterator[SearchScope]:
        """Yield the part of the grid that a prior in (r [m], u, v) covers, and then the region.

        A user is outside only if the prior is wrong. The part is left out if the table of the
        region exists.
        """
        likelihood, grid = self._likelihood, lay_grid(self._likelihood.scenario)
        chosen = priors.cells_of(bent, grid, likelihood.resolution)
        # A cached property is in vars() once it is computed.
        if '_region' not in vars(self) and chosen.any():
            part = grid.within(chosen)
            scope = SearchScope.of(
                likelihood, tabulate(likelihood.model, grid=part), part, self._blocked)
            yield scope._replace(favoured=np.ones(1, bool))
        yield self._region._replace(
            alternatives=[one.given(wrong) for one in self._region.alternatives], favoured=chosen)

    @one_blas_thread
    def estimate(self, received: np.ndarray) -> Estimate:
        """Estimate positions from received signals; see `Estimator.estimate`."""
        return estimate_each(self._likelihood.codebook, received, self._locate)

    @one_blas_thread
    def posterior(self, received: np.ndarray, prior: Mixture | None = None, *,
                  wrong: float = priors.WRONG, share: float = 1.0, n_before: float = 0.0
                  ) -> Estimate:
        """Estimate positions, and keep the posterior as a mixture; signals as in `estimate`.

        Without a prior, the position is that of `estimate`. The probabilities of users outside or
        blocked, and the reason why there is no position, are those without the prior, except that
        a user is outside only if the prior is wrong. Users outside are considered only if the
        whole region is searched. Raises `SignalError` if the signals are unusable, and ValueError
        if another argument is out of range.

        Parameters
        ----------
        prior
            Mixture in the frame of the site, also with velocities if users move; by default, a
            uniform density on the region.
        wrong
            Probability that the prior does not hold, and the user is anywhere in the region.
        share
            Exponent of the likelihood with a mixture as prior; see `independent_share`.
        n_before
            Number of phases in the prior. If it is not 0, the prior is that of a position with the
            errors that are the same in all phases; see `constant_shares`.
        """
        signals = self._likelihood.signals(checked_received(self._likelihood.codebook, received))
        if prior is None:
            for name, value, default in (('wrong', wrong, priors.WRONG), ('share', share, 1.0),
                                         ('n_before', n_before, 0.0)):
                if value != default:
                    raise ValueError(f'{name}: {value}, expected together with a prior')
            found = [one.posterior() for block in blocks(len(signals.received), _BLOCK)
                     for one in self._locate_block(self._region, select(signals, block))]
        else:
            if not 0 < finite('wrong', wrong) < 1:
                raise ValueError(f'wrong: {wrong}, expected a probability between 0 and 1')
            if not 0 < finite('share', share) <= 1:
                raise ValueError(f'share: {share}, expected an exponent above 0, up to 1')
            finite('n_before', n_before, 0.0)
            found = [self._update(select(signals, [n]), prior, wrong, share, n_before)
                     for n in range(len(signals.received))]
        return found[0] if np.ndim(received) == 2 else Estimate.of_each(found)

    def in_front(self, prior: Mixture, wrong: float) -> Sheets:
        """Return a density of the site around the surface, with the probability that it is wrong.

        A component for the whole region comes last.
        """
        pose, extent = self.scenario.pose, np.ptp(self._bounds, axis=0)
        return Sheets.from_mixture(prior.or_within(
            pose.to_site(self._bounds.mean(axis=0)), pose.covariances_to_site(
                np.diag(np.maximum(extent, priors.MIN_EXTENT_M)**2)), wrong), pose)

    def _update(self, signals: Signals, prior: Mixture, wrong: float, share: float,
                n_before: float) -> Estimate:
        """Compute the posterior of one shot for a prior."""
        if self.scenario.user_speed_std_mps:
            return self._moving(signals, prior, wrong, share)
        before = self.in_front(prior, wrong)
        constant = self.constant_shares if n_before else np.zeros(3)
        for scope in self._scopes(select(before, slice(-1)), wrong):
            (found,) = self._locate_block(scope, signals, draws=False)
            if found.modes is None or found.estimate.reason:
                continue
            products = priors.multiply(
                before, found.modes, share, found.conditionals, self._likelihood, signals,
                self._bounds, constant, n_before)
            if not priors.is_doubtful(products.energy / self._level, self._n_measurements):
                break
        if found.modes is None or found.estimate.reason:
            return found.estimate
        estimate, density = found.estimate, products.bent
        blocked, outside = np.nan_to_num(
            [float(estimate.blocked_probability), float(estimate.outside_probability)])
        if blocked:
            # Signals without a direct path contain no information. The odds are relative to a user
            # anywhere in the region.
            odds = share * np.log(blocked / max(1 - blocked - outside, 1e-12))
            everywhere = priors.uniform(found.modes.sheets(share), self._bounds).log_mass
            density = concatenate(density, before.weighted(everywhere + odds))
        return self.restricted(density.reduce(), dataclasses.replace(
            estimate, see=found.see(), is_elsewhere=products.is_last),
            priors.constant_covariance(products.best, constant, self.scenario.pose))

    def _moving(self, signals: Signals, prior: Mixture, wrong: float, share: float) -> Estimate:
        """Compute the posterior of one shot of a user who moves."""
        estimate = self._locate_block(self._region, signals)[0].posterior()
        if (seen := estimate.sighting) is None or not estimate.fix:
            return estimate
        joint = priors.Users.of(self.scenario, self._bounds, self.scenario.pose).updated(
            prior, seen.mixture.normalised(), seen.missing, share, wrong)
        return self.restricted(self.in_front(joint, priors.ELSEWHERE), estimate, np.zeros((3, 3)))

    def begin(self, estimate: Estimate) -> Mixture:
        """Return the posterior without a prior, from which a track begins."""
        assert estimate.sighting is not None and estimate.sighting.sheets is not None
        sheets = estimate.sighting.sheets
        best = select(sheets, [int(np.argmax(sheets.log_peaks))])
        density = priors.uniform(sheets.narrowed(self.constant_shares), self._bounds).normalised()
        return density.to_mixture(self.scenario.pose).shared(
            priors.constant_covariance(best, self.constant_shares, self.scenario.pose))

    @functools.cached_property
    def constant_shares(self) -> np.ndarray:
        """Shares of variances that are the same in all phases; see the function of this name."""
        return priors.constant_shares(self._likelihood.model)

    def restricted(self, density: Sheets, estimate: Estimate, constant: np.ndarray) -> Estimate:
        """Return an estimate with the position and velocity of a density, in the region.

        `constant`, [3, 3] [m^2], is the covariance of further errors, which all phases share.
        """
        density, mixture = priors.inside(
            density, self._bounds, self.normal[:_NARROW], self.scenario.pose)
        pose = self.scenario.pose
        return dataclasses.replace(
            estimate.described(mixture.shared(constant), pose),
            unbounded=density.to_mixture(pose).shared(constant))

    @abc.abstractmethod
    def _moments(self, modes: Modes, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        """Return means, [N, D], and covariances, [N, D, D], of N shots; D is 6 with velocities."""

    def _locate(self, batch: np.ndarray) -> Iterator[Estimate]:
        signals = self._likelihood.signals(batch)
        return itertools.chain.from_iterable(map_blocks(
            lambda block: [one.estimate for one in self._locate_block(
                self._region, select(signals, block))],
            blocks(len(batch), _BLOCK)))

    def _locate_block(self, scope: SearchScope, signals: Signals, draws: bool = True
                      ) -> list['_Found']:
        """Locate each of several shots.

        With `draws`, positions are drawn if the search for modes would be too long.
        """
        energies = np.sum(np.abs(self._likelihood.model.combine(
            signals.received))**2, axis=(1, 2)) / self.scenario.noise_power_w
        reasons = list(map(self._test.min_energy_test, energies.tolist()))
        found = {row: _Found(self, Estimate.without_fix(reason))
                 for row, reason in enumerate(reasons) if reason}
        usable = [row for row, reason in enumerate(reasons) if not reason]
        if usable:
            signals = select(signals, usable)
            aligned = scope.alignment.values_of_each(signals.received)
            whitened = self._likelihood.whitened(aligned, signals)
            fits = self._fits(scope, signals, aligned, whitened, draws)
            seen = [one.seen(self._likelihood.model, signals.received, whitened)
                    for one in scope.alternatives]
            ratios, outside = self._log_ratios(
                scope.alternatives, signals, seen, aligned, [one.fit for one in fits])
            for n, (row, searched) in enumerate(zip(usable, fits, strict=True)):
                log_ratios = {name: float(ratio[n]) for name, ratio in ratios.items()}
                estimate = self._judge(
                    scope.alternatives, log_ratios, searched, select(signals, [n]), whitened[n],
                    [each[n] for each in seen], aligned[n])
                found[row] = _Found(self, estimate, log_ratios, *searched, outside[n])
        return [found[row] for row in range(len(reasons))]

    def _fits(self, scope: SearchScope, signals: Signals, aligned: np.ndarray,
              whitened: np.ndarray, draws: bool) -> list['_Searched']:
        """Find the posterior of each shot."""
        # Margin of modes in each cell, beyond the usual one.
        margin = (np.log(MISS_PROBABILITY / self.left_out) + self._refinement.margin
                  + priors.PRIOR_MARGIN * scope.favoured)
        starts, drawn = scope.table.search(
            whitened, self._likelihood.nuisance, GRID_MARGIN + scope.alignment.margin + margin,
            scope.drawn if draws else None)
        fits = {shot: _Searched(fit) for shot, fit in drawn.items()}
        if len(starts.shots):
            search = ModeSearch(
                scope, self._likelihood, signals, margin, self._refinement.is_exact)
            fits.update(self._fits_of(scope, search.modes(starts, aligned, whitened), signals))
        return [fits[shot] for shot in range(len(aligned))]

    def _fits_of(self, scope: SearchScope, modes: Modes, signals: Signals
                 ) -> Iterator[tuple[int, '_Searched']]:
        """Yield each shot that has modes, with its posterior."""
        likelihood, coarse = self._likelihood, modes
        modes, conditionals = self._refinement.refine(coarse, signals, scope.table)
        samples = averaged = self._samples(modes, conditionals, signals)
        if scope.alternatives and not isinstance(self._refinement, OneState):
            # The margin of the refinement admits modes that count only for some states.
            averaged = self._samples(*self._averaging.refine(likely_modes(
                coarse), signals, scope.table), signals)
        means, covariances = self._moments(modes, samples)
        # If the model holds, twice the residual energy, averaged over the posterior, has the mean
        # of a chi-square variable, with two degrees of freedom for each complex measurement, less
        # one for each fitted coordinate or parameter. At the best of several modes, it is smaller
        # than the average. The best mode of each shot comes first.
        residuals = samples.of_shot.first(modes.residual)
        n_fitted = self._n_fitted(select(modes, samples.of_shot.starts), signals)
        expected = np.maximum(self._n_measurements - n_fitted / 2, 0.5) - (
            samples.average(modes.residual) - residuals)
        gains = samples.of_shot.first(modes.values) @ likelihood.nuisance.gain
        for n, (shot, *fit) in enumerate(zip(
                conditionals, means, covariances, samples.log_evidence.tolist(),
                averaged.log_evidence.tolist(), residuals.tolist(), expected.tolist(),
                gains.tolist(), strict=True)):
            of_shot = modes.of_shot(shot)
            # Broad modes are not Gaussian, so their sheets have the moments of the samples.
            describe = functools.partial(
                samples.described, n, None if likelihood.nuisance.is_coarse else of_shot,
                self._bounds)
            yield shot, _Searched(Fit._make((*fit, describe)), of_shot, conditionals[shot])

    def _n_fitted(self, modes: Modes, signals: Signals) -> np.ndarray:
        """Return the numbers of coordinates and parameters that signals determine, float64 [M].

        Where a prior determines a parameter, the residual is no smaller.
        """
        prior, n_axes = self._likelihood.nuisance, np.count_nonzero(self.scenario.roi_size_m)
        if not len(prior):
            return np.full(len(modes.shots), float(n_axes))
        information = self._likelihood.local(
            modes.points, modes.values, select(signals, modes.shots)).information
        variances = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)[:, 3:]
        found: np.ndarray = n_axes + np.sum(1 - np.clip(prior.precision * variances, 0, 1), axis=1)
        return found

    def _samples(self, modes: Modes, conditionals: Mapping[int, Sequence[Conditional]],
                 signals: Signals) -> Samples:
        """Represent the posteriors with these modes by samples."""
        if not self._likelihood.nuisance.is_coarse:
            return draw_samples(modes, self._mode_normal, self._bounds)
        drawn = (draw_broad_samples(
            self._likelihood, of_shot, self._phases, select(signals, [shot]), modes.of_shot(shot),
            self._mode_normal) for shot, of_shot in conditionals.items())
        positions, log_weights = map(np.concatenate, zip(*drawn, strict=True))
        # Evenly spread points represent a position well: covariances are 1 % too small. With a
        # velocity, these are 12 % too small, and points are no better than independent ones.
        n_moving = self._likelihood.nuisance.velocity.shape[1]
        return Samples.of(
            positions, log_weights, modes.shots, (2 * n_moving + 2) * (n_moving > 0))

    def _log_ratios(self, alternatives: Sequence[Alternative], signals: Signals,
                    seen: Sequence[np.ndarray], aligned: np.ndarray, fits: Sequence[Fit]
                    ) -> tuple[dict[str, np.ndarray], list[Callable[[], Sheets] | None]]:
        """Return logarithms of the likelihoods of alternatives relative to the fits, [N] each.

        Where averages over all surfaces leave a doubt, each has the failures found for it. Also
        returns functions that compute the density of each user outside.
        """
        prior, found = self._likelihood.nuisance, {}
        outside: list[Callable[[], Sheets] | None] = [None] * len(fits)
        residuals, averaged, gains = np.array([
            (fit.residual, fit.averaged_evidence, fit.log_evidence - fit.averaged_evidence)
            for fit in fits]).T
        shadow = self._shadow.values_of_each(signals.received, aligned)
        in_sight = averaged + self._unknown_level.gain(residuals)
        for one, projected in zip(alternatives, seen, strict=True):
            ratios, values, turned = log_ratios_of(
                one, self._likelihood, signals, projected, aligned, shadow, in_sight)
            for n in np.flatnonzero((gains > 0) & (one.log_odds + ratios > _CLEAR)):
                points, parameters, share, level = one.places(turned[n], prior)
                gain = self._refinement.gain(points, parameters + values[n], Signals(*(
                    each / level for each in select(signals, [n]))))
                # Sets of failed elements are not searched at the other places.
                others = max(1 - share, np.finfo(float).tiny)
                ratios[n] += np.logaddexp(np.log(others), np.log(share) + gain) - gains[n]
            found[one.name] = ratios
            if isinstance(one, Outside):
                outside = [functools.partial(one.sheets, each, prior) for each in turned]
        return found, outside

    def _judge(self, alternatives: Sequence[Alternative], log_ratios: Mapping[str, float],
               searched: '_Searched', signals: Signals, whitened: np.ndarray,
               seen: Sequence[np.ndarray], aligned: np.ndarray) -> Estimate:
        """Return the position of one shot, or the reason why there is none."""
        fit = searched.fit
        probabilities, _ = mixture_weights(np.array([0.0, *(
            one.log_odds + log_ratios[one.name] for one in alternatives)]))
        factor = np.exp(-fit.gain) * self._likelihood.weights_at(np.array([fit.gain]))[0]
        reason = self._reason(alternatives, whitened * factor, [each * factor for each in seen],
                              fit.residual, probabilities)
        if self._movement and not reason:
            reason = self._movement.reason(
                *searched, signals, aligned, self._scale(fit))
        # Without a fix, only a residual that nothing explains is evidence against the scenario.
        # The residual is the reason if the texts are equal.
        is_evidence = (reason == self._test.residual_test(fit.residual) if reason
                       else probabilities[0] >= 1 - _DOUBT)
        statistics: dict[str, Any] = {
            'residual': fit.residual, 'expected_residual': fit.expected if is_evidence else np.nan,
            **{f'{one.name}_probability': float(share) for one, share in zip(
                alternatives, probabilities[1:], strict=True)}}
        if reason:
            return Estimate.without_fix(reason, **statistics)
        covariance = self._scale(fit) * fit.covariance
        if len(covariance) > 3:
            statistics.update(velocity=fit.mean[3:], velocity_covariance=covariance[3:, 3:],
                              cross_covariance=covariance[:3, 3:])
        return Estimate(fit.mean[:3], covariance[:3, :3], reason, **statistics)

    def _scale(self, fit: Fit) -> float:
        """Return the factor of the covariance for the multipath level that the residual shows."""
        relative = max(fit.residual, 1e-9) / (self._level * max(fit.expected, 0.5))
        # The scaled covariance does not exceed the prior's, unless the original one does.
        largest = max(self._prior_m2 / float(fit.covariance[:3, :3].trace()), 1.0)
        return float(min(relative**self._level_share, largest))

    def _reason(self, alternatives: Sequence[Alternative], whitened: np.ndarray,
                seen: Sequence[np.ndarray], residual: float, probabilities: np.ndarray) -> str:
        """Return the reason why there is no fix, or '' if there is one."""
        # If no position in the region explains the signals, an alternative is the reason only if
        # it explains them.
        unexplained = self._test.residual_test(residual) or self._test.weak_test(
            float(np.sum(np.abs(whitened)**2)), residual)
        in_sight, *others = probabilities.tolist()
        for probability, one, signals in sorted(
                zip(others, alternatives, seen, strict=True),
                key=lambda each: -each[0] / each[1].limit):
            reason = rejection(one, probability, in_sight)
            if reason and (not unexplained or one.explain(signals, self._test.max_residual)):
                return reason
        return unexplained


class BayesEstimator(SearchEstimator):
    """Mean and covariance of the posterior, from samples inside the region."""

    name, uses_tracks = 'bayes', True

    def _moments(self, modes: Modes, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        mean, covariance = samples.moments()
        return mean, regular(covariance)


class MlEstimator(SearchEstimator):
    """The most likely position in the region, and its mean squared error under the posterior."""

    name, averages = 'ml', False

    def _moments(self, modes: Modes, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        mean, covariance = samples.moments()
        best = self._likelihood.nuisance.states(
            samples.of_shot.first(modes.points), samples.of_shot.first(modes.values))[0]
        offsets = best - mean
        return best, regular(covariance + offsets[:, :, None] * offsets[:, None])


def _in_site(system: System) -> System:
    """Return the surface with the region in which it sees users of a site."""
    scenario = system.scenario
    if np.array_equal(bounds_m := seen_bounds(scenario), scenario.roi_bounds_m):
        return system
    return System(dataclasses.replace(
        scenario, roi_center_m=bounds_m.mean(axis=0), roi_size_m=np.ptp(bounds_m, axis=0)),
        system.codebook, system.surface)


class _Searched(NamedTuple):
    """The posterior of one shot, and the refined modes unless positions were drawn."""

    fit: Fit
    modes: Modes | None = None
    conditionals: Sequence[Conditional] = ()  # The likelihood for each state of the surface.


class _Found(NamedTuple):
    """The estimate of one shot, and how it was found if the signals are stronger than noise."""

    estimator: SearchEstimator
    estimate: Estimate
    #: Logarithms of the likelihoods of alternatives, by name, relative to a user in sight.
    log_ratios: Mapping[str, float] = {}
    fit: Fit | None = None
    # Those of `_Searched`.
    modes: Modes | None = None
    conditionals: Sequence[Conditional] = ()
    # Returns the density of a user outside, if it is known.
    outside: Callable[[], Sheets] | None = None

    def posterior(self) -> Estimate:
        """Return the estimate with its mixture and its sighting."""
        reason = self.estimate.reason
        if self.fit is None or (reason and not str(reason).startswith(Outside.reason)):
            return self.estimate
        see = self.see()
        density = functools.cache(lambda: see().mixture.normalised())
        return dataclasses.replace(self.estimate, see=see, density=None if reason else density)

    def see(self) -> Callable[[], Sighting]:
        """Return the function that describes the signals alone."""
        return functools.cache(self._sighting)

    def _sighting(self) -> Sighting:
        estimator, estimate, fit = self.estimator, self.estimate, self.fit
        assert fit is not None
        mixture, sheets = fit.describe()
        scenario, bounds_m = estimator.scenario, estimator._bounds
        pose, blocked = scenario.pose, float(np.nan_to_num(estimate.blocked_probability))
        placed = mixture.scaled(estimator._scale(fit)).moved(Pose(), pose)
        log_ratio = self.log_ratios.get(Outside.name, -np.inf)
        places = places_of(self.outside(), log_ratio, scenario) if (
            self.outside and np.ptp(bounds_m, axis=0).all() and np.isfinite(log_ratio)) else None
        return Sighting(
            pose, placed.weighted(fit.log_evidence + log_size(bounds_m)),
            float(np.clip(blocked + (1 - blocked) * MISS_PROBABILITY, 0.0, 1 - 1e-12)), sheets,
            misfit_log_ratio=misfit_log_ratio(
                fit.residual, estimator._n_measurements, scenario.multipath_level_db),
            places=places, region_m=bounds_m,
            **{f'{name}_log_ratio': value for name, value in self.log_ratios.items()})
