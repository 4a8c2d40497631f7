"""Alternatives to a user in the region with a direct path: a user outside, or a blocked one.

Each alternative has prior odds and an evidence, the likelihood averaged over its own unknowns. A
comparison with the evidence for a user in the region gives the probability of the alternative.
Both average over errors and failures of the elements in the same way, without regard to what the
signals reveal about single elements. Where this leaves a doubt, all have the sets of failed
elements that are found for them. All parameters, such as an offset of the timing, are those
that fit the alternative. If a survey has measured how much the level of the multipath varies among
users, the evidences of all are averaged over it: with weak multipath, signals say more.

There is a fix only if a user in the region and in sight is at least as probable as all
alternatives together, which is the decision with the least error, and if the probability of each
alternative, compared with such a user alone, is within the limit of the alternative.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario, gaussian
from rhs_isac_ros.model.arrays import adjoint, multiply_rows
from rhs_isac_ros.model.constants import NEPERS_PER_DB
from rhs_isac_ros.positioning.dispersed import ONE_STATE, SurfaceState
from rhs_isac_ros.positioning.likelihood import Likelihood, Signals
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.outside import OutsideTemplates
from rhs_isac_ros.positioning.projection import (
    ProjectedModel,
    project,
)
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.sheets import Sheets

# Above this probability, a position is less probable than its alternatives.
LIMIT = 0.5
# Above this probability, a 95 % region that assumes a direct path cannot attain its coverage.
BLOCKED_LIMIT = 0.05
# Largest plausible level of the multipath of a blocked user, in standard deviations.
_LEVEL_REACH = 3.0
# Standard deviation that represents an unknown gain in the level of a blocked user [dB].
_UNKNOWN_GAIN_DB = 40.0
_MIN_PROBABILITY = 1e-12
# Range at which the direct path is negligible [m].
_FAR_M = 1e7
# Smallest probability of an alternative that is reported.
_MIN_DOUBT = 0.01
# Integrals of evidences over the parameters that move the multipath: number of steps to the
# maximum, largest step in standard deviations, and least curvature, relative to that of the
# multipath.
_STEPS = 2
_REACH = 2.0
_CURVATURE = 0.5
# Further steps with twice the differences, where the curvature is below the least one.
_WIDER, _WIDENINGS = 2.0, 4
# Absolute log odds of an alternative up to which its evidence may count, before and after the
# first step, and a step after which the curvature hardly changes.
_NEAR = 30.0
_SURE = 12.0
_CLOSE = 0.7


class Blocked:
    """A user without a direct path, whose signals are multipath of an unknown level.

    The attributes are those of `Outside`.
    """

    name, reason, limit, strength = 'blocked', 'blocked', BLOCKED_LIMIT, 0.0

    def __init__(self, scenario: Scenario, model: MeasurementModel,
                 states: Sequence[SurfaceState] = ONE_STATE) -> None:
        self._full = model.full if isinstance(model, ProjectedModel) else model
        self._states = [_Separated.of(self._full, state) for state in states]
        self.log_odds = log_odds_of(scenario.blocked_probability)
        self._median_db, self._std_db = scenario.multipath_level_db

    def log_evidence_of(self, whitened: np.ndarray, aligned: np.ndarray, prior: NuisancePrior
                        ) -> np.ndarray:
        """Compute log evidences with the level integrated out; see `Outside`."""
        # The gain of the user is part of the level.
        gain_db = min(prior.gain_std / NEPERS_PER_DB, _UNKNOWN_GAIN_DB)
        std_db = math.hypot(gaussian.BLOCKED_STD_DB, self._std_db, gain_db)
        blocked = np.logaddexp.reduce([
            state.offset + gaussian.log_evidence_of_level(
                state.energies(whitened), 1, std_db, self._median_db, state.noise)
            for state in self._states])
        if prior.gain_std:
            # Relative to the density of an unknown gain that positions assume.
            blocked += math.log(gain_db * NEPERS_PER_DB / prior.gain_unit)
        return np.asarray(blocked + prior.log_evidence_of_aligned(aligned))

    def seen(self, model: MeasurementModel, received: np.ndarray, whitened: np.ndarray
             ) -> np.ndarray:
        """Return the whitened signals of N shots before they are projected."""
        return whitened if self._full is model else self._full.whiten(received)

    def noise_ratio(self, whitened: np.ndarray, likelihood: Likelihood) -> float:
        """Return 0: the level does not scale the noise; see `Outside`."""
        return 0.0

    def places(self, whitened: np.ndarray, prior: NuisancePrior
               ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Return a place without a direct path, and the level of the signals; see `Outside`."""
        level = float(np.mean(np.abs(whitened)**2))
        return np.array([[_FAR_M, 0.0, 0.0]]), np.zeros((1, len(prior))), 1.0, level**0.5

    def given(self, wrong: float) -> 'Blocked':
        """Return the alternative; whether a user is in sight does not depend on a prior."""
        return self

    def explain(self, whitened: np.ndarray, max_residual: float) -> bool:
        """Return whether a plausible level explains signals up to this residual energy."""
        level = 10**(_LEVEL_REACH * gaussian.BLOCKED_STD_DB / 10)
        return any(np.sum(state.energies(whitened[None]) / (
            state.noise + (1 - state.noise) * level)) <= max_residual for state in self._states)


class _Separated(NamedTuple):
    """A state of the surface, with whitened signals in which multipath and noise are diagonal."""

    offset: float  # That of `SurfaceState`.
    operator: np.ndarray  # Yields these signals of unit variance, complex128 [N_B, n, n].
    noise: np.ndarray  # Share of thermal noise in their variances, float64 [N_B n].

    @classmethod
    def of(cls, model: MeasurementModel, state: SurfaceState) -> '_Separated':
        """Separate multipath and noise in the whitened signals of a model."""
        whitener = model.combined_whitener
        if state.operator is not None:
            whitener = adjoint(np.linalg.cholesky(state.operator)) @ whitener
        shares, vectors = np.linalg.eigh(
            model.scenario.noise_power_w * whitener @ adjoint(whitener))
        operator = adjoint(vectors) @ whitener @ model.combined_root
        # Rounding may bring a share beyond its ends.
        return cls(state.offset, operator, np.clip(shares, 0.0, 1.0).ravel())

    def energies(self, whitened: np.ndarray) -> np.ndarray:
        """Return energies of the signals of N shots, float64 [N, N_B n]."""
        return np.asarray(np.abs(multiply_rows(self.operator, whitened))**2).reshape(
            len(whitened), -1)


class Outside:
    """A user in front of the surface but outside of the region of interest; see `outside`."""

    name = 'outside'  # `Estimate` has the field ``<name>_probability``.
    reason = 'position outside of the region'  # Beginning of the reason why there is no fix.
    # Largest probability at which there is a fix, if no other alternative is considered.
    limit = LIMIT
    # Weight of a direct path as in the region in the parameters that move the multipath, which are
    # between those that fit such a path and those that fit the multipath alone.
    strength = 0.5

    def __init__(self, scenario: Scenario, arrays: Mapping[str, np.ndarray],
                 states: Sequence[SurfaceState] = ONE_STATE,
                 level: gaussian.UnknownLevel = gaussian.AT_0_DB) -> None:
        # Logarithm of the prior odds relative to a user inside and in sight.
        self._probability = scenario.outside_probability
        self.log_odds = log_odds_of(self._probability)
        self._basis = arrays['outer_basis']
        self._templates = [OutsideTemplates(scenario, arrays, state, level) for state in states]

    def seen(self, model: MeasurementModel, received: np.ndarray, whitened: np.ndarray
             ) -> np.ndarray:
        """Return the whitened signals of N shots in the dimensions of the templates."""
        if not isinstance(model, ProjectedModel):
            return whitened
        return project(self._basis, model.full.whiten(received))

    def given(self, wrong: float) -> 'Outside':
        """Return the alternative for a prior of the position that is wrong with a probability."""
        # If the prior holds, the user is inside.
        changed = copy.copy(self)
        changed.log_odds = log_odds_of(wrong * self._probability)
        return changed

    def log_evidence_of(self, whitened: np.ndarray, aligned: np.ndarray, prior: NuisancePrior
                        ) -> np.ndarray:
        """Compute logarithms of evidences with the nuisance parameters integrated out, [N].

        `aligned`, float64 [N, Q], contains the parameters that follow from the signals alone, and
        0 for the others. `whitened`, complex128 [N, N_B, N_SB F], are the signals of N shots
        without the factors of `aligned`.
        """
        found: np.ndarray = np.logaddexp.reduce([
            one.log_evidence_of(whitened, prior) for one in self._templates])
        return found + prior.log_evidence_of_aligned(aligned)

    def noise_ratio(self, whitened: np.ndarray, likelihood: Likelihood) -> float:
        """Return the log of the evidence of one shot relative to that of `log_evidence_of`.

        There, a gain also scales the thermal noise. Takes the signals of the latter, [N_B, n].
        """
        return self._best(whitened, likelihood.nuisance).noise_ratio(whitened, likelihood)

    def places(self, whitened: np.ndarray, prior: NuisancePrior
               ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Return the most likely places of a user elsewhere for whitened signals of one shot.

        Returns points (r [m], u, v), [P, 3], parameters that fit there, [P, Q], the share of the
        evidence that is due to them, and the factor of the signals that is not a parameter.
        """
        return *self._best(whitened, prior).places(whitened, prior), 1.0

    def sheets(self, whitened: np.ndarray, prior: NuisancePrior) -> Sheets:
        """Return the heaviest parts of the posterior of the position of a user outside.

        Takes whitened signals of one shot. The mass of the density is the share of these parts.
        """
        return self._best(whitened, prior).sheets(whitened, prior)

    def _best(self, whitened: np.ndarray, prior: NuisancePrior) -> 'OutsideTemplates':
        """Return the templates of the most likely state of the surface for one shot."""
        if len(self._templates) == 1:
            return self._templates[0]
        return max(self._templates, key=lambda one: one.log_evidence_of(whitened[None], prior)[0])

    def explain(self, whitened: np.ndarray, max_residual: float) -> bool:
        """Return whether some position explains the signals up to this residual energy."""
        return any(one.explain(whitened, max_residual) for one in self._templates)


Alternative: TypeAlias = Outside | Blocked
ALTERNATIVES: tuple[type[Alternative], ...] = (Outside, Blocked)


def probabilities_of(estimate: object) -> dict[str, float]:
    """Return the known probabilities in an `Estimate` or a message, keyed by alternative."""
    values = {kind.name: float(getattr(estimate, f'{kind.name}_probability'))
              for kind in ALTERNATIVES}
    return {name: value for name, value in values.items() if not math.isnan(value)}


def describe_doubts(estimate: object) -> str:
    """Return the probabilities of at least 1 % as a text such as ``blocked 12 %``, or ''."""
    return ', '.join(f'{name} {100 * value:.0f} %' for name, value in probabilities_of(
        estimate).items() if value >= _MIN_DOUBT)


def log_ratios_of(
        alternative: Alternative, likelihood: Likelihood, signals: Signals, seen: np.ndarray,
        aligned: np.ndarray, shadow: np.ndarray, in_sight: np.ndarray
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return log evidences of an alternative relative to a user inside and in sight, [N].

    They are integrals over the parameters that move the multipath, by Laplace's method: where the
    alternative may count, differences over a standard deviation lead from approximate parameters,
    between those that fit a direct path and `shadow`, [N, Q], to the maximum, and yield the
    curvature. Also returns the parameters there, and the signals without their factors. Without
    such parameters, these signals are `seen`. `in_sight`, [N], are the log evidences of a user
    inside. For the other arguments, see `Outside.log_evidence_of`.
    """
    prior, values = likelihood.nuisance, shadow + alternative.strength * (aligned - shadow)
    axes = prior.axes

    def with_noise(found: np.ndarray, seen: np.ndarray) -> np.ndarray:
        # If a gain without a prior scaled the noise, evidences would be arbitrarily wrong.
        limit = _SURE * prior.gain_std / (prior.gain_unit or 1.0)
        for n in np.flatnonzero(np.abs(alternative.log_odds + found) < limit):
            found[n] += alternative.noise_ratio(seen[n], likelihood)
        return found

    if not len(axes):
        found = alternative.log_evidence_of(seen, values, prior)
        return with_noise(found - in_sight, seen), values, seen

    def ratios(values: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        return alternative.log_evidence_of(
            likelihood.whitened(values, select(signals, rows)), values, prior) - in_sight[rows]

    found, log_volume = ratios(values), np.zeros(len(values))
    (near,) = np.nonzero(np.abs(alternative.log_odds + found) < _NEAR)
    # Places outside may differ in what a parameter changes, such as the delay, which the signals
    # then determine less than the multipath alone would.
    scales = np.ones((len(values), len(axes)))
    for _ in range(_STEPS + _WIDENINGS):
        if not len(near):
            break
        best, at, offsets = found[near], values[near], scales[near][..., None] * axes
        around = np.concatenate([-offsets, offsets], axis=1)
        low, high = np.split(ratios(
            (at[:, None] + around).reshape(-1, len(prior)), np.repeat(near, 2 * len(axes))
        ).reshape(len(near), -1), 2, axis=1)
        curvature = 2 * best[:, None] - high - low
        is_flat = curvature < _CURVATURE
        curvature = np.maximum(curvature, _CURVATURE)
        log_volume[near] = (np.log(scales[near]) - np.log(curvature) / 2).sum(axis=1)
        step = np.clip((high - low) / (2 * curvature), -_REACH, _REACH)
        moved = at + (step[..., None] * offsets).sum(axis=1)
        there = ratios(moved, near)
        better = there > best
        found[near[better]], values[near[better]] = there[better], moved[better]
        scales[near] *= np.where(is_flat, _WIDER, 1.0)
        near = near[((np.abs(step).max(axis=1) >= _CLOSE) | is_flat.any(axis=1))
                    & (alternative.log_odds + found[near] > -_SURE)]
    whitened = likelihood.whitened(values, signals)
    return with_noise(found + log_volume, whitened), values, whitened


def rejection(alternative: Alternative | type[Alternative], probability: float, inside: float
              ) -> str:
    """Return why an alternative rules out a fix, or '' if it does not.

    `probability` and `inside` are the probabilities of the alternative and of a user in the region
    and in sight, among all hypotheses.
    """
    share = probability / max(probability + inside, _MIN_PROBABILITY)
    if share > alternative.limit:
        return (f'{alternative.reason}: probability {share:.6g}, expected at most '
                f'{alternative.limit:g}')
    if inside < 1 - LIMIT:
        return (f'{alternative.reason}: probability {probability:.6g}, and {inside:.6g} of a user '
                f'in the region and in sight, expected at least {1 - LIMIT:g}')
    return ''


def unrecognised_outside(scenario: Scenario) -> str:
    """Return a text if users outside are not considered where they are to be rejected, or ''."""
    return '' if scenario.outside_probability else (
        'outside_probability: 0 in the scenario, so users outside of the region are not '
        'considered, and reject_outside has no effect')


def log_odds_of(probability: float) -> float:
    """Return the logarithm of the odds of a probability; the odds are within 1e-12 and 1e12."""
    return math.log(max(probability, _MIN_PROBABILITY) / max(1 - probability, _MIN_PROBABILITY))
