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
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario, gaussian
from rhs_isac_ros.model.arrays import blocks, log_sum, marked
from rhs_isac_ros.model.constants import NEPERS_PER_DB
from rhs_isac_ros.model.geometry import element_positions, to_positions
from rhs_isac_ros.positioning.dispersed import ONE_STATE, SurfaceState
from rhs_isac_ros.positioning.grid import separate
from rhs_isac_ros.positioning.lattice import Resolution, carrier_wavenumbers
from rhs_isac_ros.positioning.likelihood import Likelihood, Signals
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.projection import (
    ProjectedModel,
    at_ranges,
    project,
    white_means,
)
from rhs_isac_ros.positioning.segments import Segments, select
from rhs_isac_ros.positioning.sheets import Sheets
from rhs_isac_ros.support.threads import map_blocks

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
# In units of the nearest range of the region: width of the border around the region that does not
# count as outside, and nearest range, which is at least a multiple of the radius of the aperture.
_BORDER = 0.1
_NEAREST = 0.3
_APERTURES = 4.0
# Farthest range in units of the farthest range of the region, and ratio of successive ranges.
_RANGE_FACTOR = 3.0
_RANGE_RATIO = 1.15
# Phase error of a template at the edge of the aperture at which the next direction takes over, and
# largest number of templates. If this number would be exceeded, larger errors are accepted: large
# apertures distinguish more directions than a comparison of two hypotheses needs.
_DIRECTION_RAD = 0.25
_TEMPLATES = 40_000
# Largest phase error of a template at the ends of the ranges that share it [rad].
_PHASE_ERROR = 0.5
# Largest sine of the angle from boresight.
_SINE = 0.998
# Error of a residual due to the grid, as a share of the template's energy, and error of the gains
# of elements, as a share of a gain.
_ERROR = 0.25
_GAIN_ERROR = 0.01
# Directions with a log-likelihood below the best by more than this at all ranges are ignored.
_MARGIN = 20.0
# Numbers of templates, and of shots, to compute at a time.
_BLOCK = 512
_SHOTS = 16
# Number of places to which sets of failed elements are fitted.
_PLACES = 24
# Sheets around places: numbers before and after a merger, and squared distance within one.
_CELLS = 256
_SHEETS = 32
_APART = 3.0
# Integrals of evidences over the parameters that move the multipath: number of steps to the
# maximum, largest step in standard deviations, and least curvature, relative to that of the
# multipath.
_STEPS = 2
_REACH = 2.0
_CURVATURE = 0.5
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

    def __init__(self, scenario: Scenario, n_measurements: int,
                 states: Sequence[SurfaceState] = ONE_STATE) -> None:
        self._n, self._states = n_measurements, states
        self.log_odds = log_odds_of(scenario.blocked_probability)
        self._median_db, self._std_db = scenario.multipath_level_db

    def log_evidence_of(self, whitened: np.ndarray, aligned: np.ndarray, prior: NuisancePrior
                        ) -> np.ndarray:
        """Compute log evidences from the energies of the signals; see `Outside`."""
        # The gain of the user is part of the level.
        gain_db = min(prior.gain_std / NEPERS_PER_DB, _UNKNOWN_GAIN_DB)
        std_db = math.hypot(gaussian.BLOCKED_STD_DB, self._std_db, gain_db)
        blocked = np.logaddexp.reduce([
            state.offset + gaussian.log_evidence_of_level(
                state.energy(whitened), self._n, std_db, self._median_db)
            for state in self._states])
        if prior.gain_std:
            # Relative to the density of an unknown gain that positions assume.
            blocked += math.log(gain_db * NEPERS_PER_DB / prior.gain_unit)
        return np.asarray(blocked + prior.log_evidence_of_aligned(aligned))

    def seen(self, model: MeasurementModel, received: np.ndarray, whitened: np.ndarray
             ) -> np.ndarray:
        """Return the whitened signals, of which only the energy matters."""
        return whitened

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
        energy = float(np.sum(np.abs(whitened)**2))
        return energy <= max_residual * 10**(_LEVEL_REACH * gaussian.BLOCKED_STD_DB / 10)


def tabulate_outside(model: MeasurementModel, progress: Callable[[float], None] | None = None
                     ) -> dict[str, np.ndarray]:
    """Compute the arrays of `Outside`: templates of the half space in front of the surface.

    A template is a whitened mean times the range, without the carrier's phase. It depends on the
    direction and, through the curvature of the wavefront and the delays of the sub-bands, slowly
    on the range. For T template ranges, R ranges and V directions, the arrays are
    ``outer_filters``, the conjugate templates, complex64 [N_B, T V, D]; ``outer_basis``, that of
    `at_ranges` with D dimensions, complex128 [N_B, n, D]; ``outer_energy``, the energy of the
    templates [m^2], float32 [T, V]; ``outer_index``, the index of the template range for each
    range, int64 [R]; and ``outer_weights``, the prior probability of ranges and directions, 0
    inside the region, float64 [R, V].
    """
    scenario = model.scenario
    ranges, directions = _ranges(scenario), _directions(scenario)
    nodes, index = _template_ranges(scenario, ranges)
    weights = _prior(scenario, ranges, directions)
    points = _points(nodes, directions)
    models = at_ranges(model, nodes, points.reshape(-1, 3), _GAIN_ERROR)
    basis, shape = models[0].basis, (model.shape[0], *points.shape[:2])
    filters = np.empty((*shape, basis.shape[2]), np.complex64)
    energy = np.empty(shape[1:], np.float32)

    def fill(part: tuple[int, slice]) -> None:
        range_m = nodes[part[0]]
        carrier = range_m * np.exp(1j * carrier_wavenumbers(scenario) * range_m)
        templates = carrier[:, None, None] * white_means(
            models[part[0]], to_positions(points[part]))[..., :-1]
        filters[:, part[0], part[1]] = templates.conj()
        energy[part] = np.sum(np.abs(templates)**2, axis=(0, 2))

    map_blocks(fill, list(itertools.product(
        range(len(nodes)), blocks(len(directions), _BLOCK))), progress)
    return {
        'outer_filters': filters.reshape(shape[0], -1, basis.shape[2]),
        'outer_basis': basis,
        'outer_energy': energy,
        'outer_index': index,
        'outer_weights': weights,
    }


class Outside:
    """A user in front of the surface but outside of the region of interest.

    Range ambiguities repeat every few wavelengths, so signals from outside often fit some position
    in the region. The prior is uniform in range and solid angle, up to a multiple of the region's
    farthest range. The carrier phases of the bands turn within centimetres of range. The average
    over these phases has a closed form: the product over the bands of ``I_0(2 |t_i^H y_i|)``, with
    templates t_i and signals y_i. All other factors are smooth, so a coarse grid suffices.
    """

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
        self._templates = [_Templates(scenario, arrays, state, level) for state in states]

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

    def _best(self, whitened: np.ndarray, prior: NuisancePrior) -> '_Templates':
        """Return the templates of the most likely state of the surface for one shot."""
        if len(self._templates) == 1:
            return self._templates[0]
        return max(self._templates, key=lambda one: one.log_evidence_of(whitened[None], prior)[0])

    def explain(self, whitened: np.ndarray, max_residual: float) -> bool:
        """Return whether some position explains the signals up to this residual energy."""
        return any(one.explain(whitened, max_residual) for one in self._templates)


class _Templates:
    """The templates of `tabulate_outside` for one state of the surface."""

    def __init__(self, scenario: Scenario, arrays: Mapping[str, np.ndarray],
                 state: SurfaceState = ONE_STATE[0],
                 level: gaussian.UnknownLevel = gaussian.AT_0_DB) -> None:
        self._state, self._level = state, level
        self._filters, self._index = arrays['outer_filters'], arrays['outer_index']
        ranges = _ranges(scenario)[:, None]
        self._directions, self._carriers = _directions(scenario), carrier_wavenumbers(scenario)
        self._spacing = [np.diff(np.unique(axis)).min() for axis in self._directions.T]
        self._scale = (2 / ranges).astype(np.float32)
        energy = arrays['outer_energy']
        if state.operator is not None:
            operator = state.operator.astype(np.complex64)
            energy = np.sum([np.sum(one.conj() * (one @ of_band), axis=1).real
                             for one, of_band in zip(self._filters, operator, strict=True)],
                            axis=0).reshape(energy.shape)
        self._node_energy = np.maximum(energy, np.finfo(np.float32).tiny)
        self._energy = (energy[self._index] / ranges**2).astype(np.float32)
        with np.errstate(divide='ignore'):
            log_prior = np.log(arrays['outer_weights'])
        self._offset = (log_prior - self._energy).astype(np.float32)

    def log_evidence_of(self, whitened: np.ndarray, prior: NuisancePrior) -> np.ndarray:
        """Return the log of the mean of ``exp(-|h y - t|^2)`` over the prior, [N]; see `Outside`.

        The signals y of N shots are `whitened`, t is the whitened mean for a user outside, and h
        divides by the gain.
        """
        return np.concatenate([self._log_evidence(whitened[block], prior)
                               for block in blocks(len(whitened), _SHOTS)])

    def _log_evidence(self, whitened: np.ndarray, prior: NuisancePrior) -> np.ndarray:
        shot, _, _, logs, largest = self._cells(whitened, prior)
        with np.errstate(divide='ignore'):
            return self._state.offset + largest + np.log(
                np.bincount(shot, np.exp(logs - largest[shot]), minlength=len(whitened))
            ) - (not prior.gain_std) * self._state.energy(whitened)

    def _cells(self, whitened: np.ndarray, prior: NuisancePrior) -> tuple[np.ndarray, ...]:
        """Return shots, ranges, directions and log evidences of cells, [C], and the largest, [N].

        The evidences lack the energies if the gain is known. Cells without a share are left out.
        """
        filtered, energy = self._filter(whitened), self._state.energy(whitened)
        n = whitened[0].size
        # At any range, the log-likelihood is highest if the outputs of all bands are in phase.
        explained = (np.sum(filtered, axis=1)**2 / self._node_energy).max(axis=1)
        rest = np.maximum(energy[:, None] - explained, n * _MIN_PROBABILITY)
        bound, _ = _best_gain(prior, np.zeros_like(rest), rest, n)
        shot, direction = marked(bound >= bound.max(axis=1, keepdims=True) - _MARGIN)
        of_shot, n_bands = Segments.of_keys(shot), filtered.shape[1]
        # With the P pairs of a shot and a direction last, reductions over ranges are fast.
        places = np.arange(filtered[0, ..., 0].size)[:, None] * filtered.shape[3]
        by_node = filtered.ravel().take(places + (shot * filtered[0].size + direction))
        by_node = by_node.reshape(n_bands, -1, len(shot))
        arguments = by_node.take(self._index, axis=1)
        arguments *= self._scale
        # A Bessel function I_0(x) is at most exp(x), and its logarithm is convex. So few places
        # need its value.
        total = arguments.sum(axis=0)
        # Without an unknown gain, the values lack the energy, and are of single precision.
        value, gain = prior.maximised_over_gain(total / 2, energy[shot], n)
        offset = self._offset.take(direction, axis=1)
        highest = value + offset
        if prior.gain_std:
            factor = np.exp(-gain).astype(np.float32)
            arguments, total = arguments * factor, total * factor
        mean = of_shot.max(total.max(axis=0)) / n_bands
        largest = np.maximum(of_shot.max(highest.max(axis=0)), np.finfo(np.float32).min)
        least = largest - _MARGIN - n_bands * (mean - gaussian.log_bessel(mean))
        (chosen,) = (highest >= of_shot.repeat(least)).ravel().nonzero()
        arguments = arguments.reshape(n_bands, -1).take(chosen, axis=1)
        ranges, pairs = np.divmod(chosen, len(shot))
        shot, direction = shot[pairs], direction[pairs]
        logs = value.take(chosen) + offset.take(chosen).astype(float) + np.sum(
            gaussian.log_bessel(arguments) - arguments, axis=0)
        power = energy[shot]
        if prior.gain_std:
            # Laplace's integral over the gain, which hardly changes the Bessel functions.
            power *= np.exp(-2 * gain.take(chosen))
            logs -= np.log(4 * power - total.take(chosen) + prior.gain_std**-2) / 2 + math.log(
                prior.gain_unit)
        if not self._level.is_known:
            logs += self._level.gain(power + self._energy[ranges, direction] - total.take(chosen))
            largest = np.full(len(largest), np.finfo(np.float32).min, float)
            np.maximum.at(largest, shot, logs)
        return shot, ranges, direction, logs, largest

    def explain(self, whitened: np.ndarray, max_residual: float) -> bool:
        """Return whether some position explains the signals up to this residual energy."""
        amplitude = np.sum(self._filter(whitened[None])[0], axis=0)[self._index] * self._scale
        residual = self._state.energy(whitened) - amplitude + self._energy
        tolerated = max_residual + _ERROR * self._energy
        return bool(((residual <= tolerated) & np.isfinite(self._offset)).any())

    def places(self, whitened: np.ndarray, prior: NuisancePrior
               ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the best points, parameters and a share for one shot; see `Outside.places`."""
        outputs = self._outputs(whitened[None])[0][:, self._index]
        energy, radii = self._state.energy(whitened), Resolution.of(
            prior.scenario).separation(prior.is_coarse)
        likely, _ = _best_gain(
            prior, np.sum(np.abs(outputs), axis=0) * self._scale / 2, energy, whitened.size)
        likely = likely + self._offset
        half, parts = _RANGE_RATIO**0.5, []
        best = np.argsort(-likely, axis=None)[:_PLACES]
        share = float(np.exp(log_sum(likely.ravel()[best]) - log_sum(likely)))
        for index in best:
            place = np.unravel_index(index, likely.shape)
            centre_m = 2 / float(self._scale[place[0], 0])
            range_m = np.arange(centre_m / half, centre_m * half, radii[0] / 3)
            turned = outputs[:, place[0], place[1], None] * np.exp(
                1j * self._carriers[:, None] * range_m) / range_m
            value, gain = _best_gain(prior, prior.amplitude(turned), energy, whitened.size)
            order = np.argsort(-value)[:_PLACES]
            points = np.column_stack([range_m[order], np.broadcast_to(
                self._directions[place[1]], (len(order), 2))])
            parts.append((value[order] - self._energy[place], points, prior.start(
                turned[:, order], np.broadcast_to(gain, value.shape)[order])))
        value, points, values = map(np.concatenate, zip(*parts, strict=True))
        order = np.argsort(-value, kind='stable')
        order = order[separate(np.zeros(len(order), int), points[order], radii)][:_PLACES]
        return points[order], values[order], share

    def sheets(self, whitened: np.ndarray, prior: NuisancePrior) -> Sheets:
        """Merge the cells of the grid with the most mass; see `Outside.sheets`."""
        _, ranges, directions, logs, _ = self._cells(whitened[None], prior)
        chosen = np.argsort(-logs, kind='stable')[:_CELLS]
        range_m = 2 / self._scale[ranges[chosen], 0].astype(float)
        extents = np.empty((len(chosen), 3))
        extents[:, 0], extents[:, 1:] = range_m * math.log(_RANGE_RATIO), self._spacing
        points = np.column_stack([range_m, self._directions[directions[chosen]]])
        return Sheets._make((logs[chosen] - log_sum(logs), points, extents[:, None]**2 / 12
                             * np.eye(3))).reduce(_SHEETS, _APART)

    def _filter(self, whitened: np.ndarray) -> np.ndarray:
        """Return filter output magnitudes by template and direction, [N, N_B, T, V] [m]."""
        return np.abs(self._outputs(whitened))

    def _outputs(self, whitened: np.ndarray) -> np.ndarray:
        """Return filter outputs by template and direction, complex64 [N, N_B, T, V] [m]."""
        # The energy outside of a basis is not part of a template.
        seen = self._state.apply(whitened)
        signals = seen[..., :self._filters.shape[2], None].astype(np.complex64)
        filtered = np.matmul(self._filters, signals)[..., 0]
        return filtered.reshape(*filtered.shape[:2], -1, self._energy.shape[1])


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
    if not len(axes):
        found = alternative.log_evidence_of(seen, values, prior)
        return found - in_sight, values, seen

    def ratios(values: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        return alternative.log_evidence_of(
            likelihood.whitened(values, select(signals, rows)), values, prior) - in_sight[rows]

    found, log_volume = ratios(values), np.zeros(len(values))
    (near,) = np.nonzero(np.abs(alternative.log_odds + found) < _NEAR)
    around = np.concatenate([-axes, axes])
    for _ in range(_STEPS):
        if not len(near):
            break
        best, at = found[near], values[near]
        low, high = np.split(ratios(
            (at[:, None] + around).reshape(-1, len(prior)), np.repeat(near, len(around))
        ).reshape(len(near), -1), 2, axis=1)
        curvature = np.maximum(2 * best[:, None] - high - low, _CURVATURE)
        log_volume[near] = -np.log(curvature).sum(axis=1) / 2
        step = np.clip((high - low) / (2 * curvature), -_REACH, _REACH)
        moved = at + step @ axes
        there = ratios(moved, near)
        better = there > best
        found[near[better]], values[near[better]] = there[better], moved[better]
        near = near[(np.abs(step).max(axis=1) >= _CLOSE)
                    & (alternative.log_odds + found[near] > -_SURE)]
    found += log_volume
    return found, values, likelihood.whitened(values, signals)


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


def _best_gain(prior: NuisancePrior, amplitude: np.ndarray, energy: np.ndarray, n: int
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return `maximised_over_gain` of n measurements, less their energy if the gain is known."""
    value, gain = prior.maximised_over_gain(amplitude, energy, n)
    return value if prior.gain_std else value - energy, gain


def farthest_range_m(scenario: Scenario) -> float:
    """Return the largest range of users outside."""
    return _RANGE_FACTOR * float(Resolution.of(scenario).farthest_m)


def _ranges(scenario: Scenario) -> np.ndarray:
    """Return the ranges of the grid in geometric progression, float64 [R] [m]."""
    resolution = Resolution.of(scenario)
    aperture_m = np.linalg.norm(element_positions(scenario), axis=1).max()
    nearest_m = max(_NEAREST * resolution.nearest_m, _APERTURES * aperture_m)
    ratio = farthest_range_m(scenario) / nearest_m
    n_ranges = 1 + max(1, int(np.ceil(np.log(ratio) / np.log(_RANGE_RATIO))))
    return nearest_m * _RANGE_RATIO**np.arange(n_ranges)


def _directions(scenario: Scenario) -> np.ndarray:
    """Return direction cosines (u, v) over the half space, float64 [V, 2]."""
    direction = Resolution.of(scenario).direction
    n_ranges = len(_template_ranges(scenario, _ranges(scenario))[0])
    fewest = np.sqrt(np.pi / 4 * n_ranges / (np.prod(direction) * _TEMPLATES))
    counts = np.ceil(0.5 / (max(_DIRECTION_RAD, fewest) * direction)).astype(int)
    lines = [(np.arange(2 * n) + 0.5) / n - 1 for n in counts.tolist()]
    grid = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 2)
    return grid[np.hypot(*grid.T) < _SINE]


def _points(ranges: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the points at all ranges in all directions, (r [m], u, v), float64 [R, V, 3]."""
    points = np.empty((len(ranges), len(directions), 3))
    points[..., 0] = ranges[:, None]
    points[..., 1:] = directions
    return points


def _prior(scenario: Scenario, ranges: np.ndarray, directions: np.ndarray) -> np.ndarray:
    positions = to_positions(_points(ranges, directions))
    distance = np.linalg.norm(positions - np.clip(positions, *scenario.roi_bounds_m), axis=-1)
    solid_angle = 1 / np.sqrt(1 - np.sum(directions**2, axis=1))
    border_m = _BORDER * Resolution.of(scenario).nearest_m
    weights = np.where(distance > border_m, ranges[:, None] * solid_angle, 0.0)
    total = weights.sum()
    return weights / total if total > 0 else weights


def _template_ranges(scenario: Scenario, ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return template ranges [T] [m], and the index of a template range for each grid range, [R].

    The phase error of a template is due to the curvature of the wavefront, proportional to 1 / r,
    and to the delay across the sub-bands, proportional to r.
    """
    resolution = Resolution.of(scenario)

    def midway(first: np.ndarray | int, end: np.ndarray | int) -> np.ndarray:
        # Midway in 1 / r, the curvature causes the same error at both ends.
        return 2 / (1 / ranges[first] + 1 / ranges[end - 1])

    def fits(first: int, end: int) -> bool:
        ends_m, node_m = ranges[[first, end - 1]], midway(first, end)
        errors = (resolution.curvature_m * np.abs(1 / ends_m - 1 / node_m)
                  + np.abs(ends_m - node_m) / resolution.delay_m)
        return bool(errors.max() <= _PHASE_ERROR)

    shared = Segments.as_long_as(fits, len(ranges))
    return (midway(shared.starts, shared.ends),
            shared.repeat(np.arange(len(shared.starts), dtype=np.int64)))
