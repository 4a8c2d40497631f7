"""Places outside of the region of interest: a table of templates, and their evidence.

The table covers the half space in front of the surface. Range ambiguities repeat every few
wavelengths, so signals from outside often fit some position in the region. The prior is uniform in
range and solid angle, up to a multiple of the region's farthest range. The carrier phases of the
bands turn within centimetres of range. The average over these phases has a closed form: the
product over the bands of ``I_0(2 |t_i^H y_i|)``, with templates t_i and signals y_i. All other
factors are smooth, so a coarse grid suffices.
"""

import functools
import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario, gaussian
from rhs_isac_ros.model.arrays import blocks, evenly_spread, log_sum, marked, mixture_weights
from rhs_isac_ros.model.geometry import element_positions, to_positions
from rhs_isac_ros.positioning.dispersed import ONE_STATE, SurfaceState
from rhs_isac_ros.positioning.gains import GainLikelihoods
from rhs_isac_ros.positioning.grid import separate
from rhs_isac_ros.positioning.lattice import Resolution, carrier_wavenumbers
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.projection import at_ranges, white_means
from rhs_isac_ros.positioning.segments import Segments
from rhs_isac_ros.positioning.sheets import Sheets
from rhs_isac_ros.support.threads import map_blocks

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
# Number of directions in which noise is taken into account.
_NOISY = 32
# Numbers of templates, and of shots, to compute at a time.
_BLOCK = 512
_SHOTS = 16
# Number of places to which sets of failed elements are fitted.
_PLACES = 24
# Sheets around places: numbers before and after a merger, and squared distance within one.
_CELLS = 256
_SHEETS = 32
_APART = 3.0
# Smallest energy of a residual, relative to that of usual signals.
_LEAST_REST = 1e-12


def tabulate_outside(model: MeasurementModel, progress: Callable[[float], None] | None = None
                     ) -> dict[str, np.ndarray]:
    """Compute the arrays of `OutsideTemplates`: templates of the half space before the surface.

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


class OutsideTemplates:
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
        """Return the log of the mean of ``exp(-|h y - t|^2)`` over the prior, [N].

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
        rest = np.maximum(energy[:, None] - explained, n * _LEAST_REST)
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

    @functools.cached_property
    def _prior_of_directions(self) -> np.ndarray:
        """Prior probabilities of directions, float64 [V]."""
        return np.exp((self._offset + self._energy).astype(float)).sum(axis=0)

    def noise_ratio(self, whitened: np.ndarray, likelihood: Likelihood) -> float:
        """Compare averages over directions; see `alternatives.Outside.noise_ratio`.

        Half of the directions are drawn as often as they are probable if the gain scales the
        noise. The other half is drawn from the prior, as noise may hide the signals.
        """
        prior, noise = likelihood.nuisance, likelihood.factors.noise
        assert noise is not None
        _, _, directions, logs, _ = self._cells(whitened[None], prior)
        expected = self._prior_of_directions
        probable = np.bincount(directions, mixture_weights(logs)[0], minlength=len(expected))
        drawn_as = (probable + expected) / 2
        drawn = np.minimum(np.searchsorted(
            np.cumsum(drawn_as), evenly_spread(_NOISY)), len(drawn_as) - 1)
        drawn, counts = np.unique(drawn, return_counts=True)
        nodes = np.arange(len(self._node_energy))[:, None]
        means = self._filters[:, nodes * len(self._directions) + drawn].conj() / 2
        log_weights = np.log(counts / drawn_as[drawn]) + (
            self._offset[:, drawn] + self._energy[:, drawn])
        amplitudes, log_sums = self._scale[:, 0].astype(float), []
        for of_noise in (noise, np.zeros_like(noise)):
            likelihoods = GainLikelihoods(
                whitened, means, of_noise, prior.gain_std, prior.least_information.max())
            gains, values = likelihoods.starts(amplitudes, self._index)
            values += log_weights
            ranges, places = marked(values >= values.max() - _MARGIN)
            log_sums.append(log_sum(log_weights[ranges, places] + likelihoods.log_integrals(
                self._index[ranges], places, amplitudes[ranges], gains[ranges, places])))
        return log_sums[0] - log_sums[1]

    def places(self, whitened: np.ndarray, prior: NuisancePrior
               ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the best points, parameters and a share for one shot."""
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
        """Merge the cells of the grid with the most mass."""
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
