"""The search for modes of the likelihood on a grid of templates over the region of interest.

A template is a mean signal times the range, without the carriers of its sub-bands: exp(i k_n r) r
mu_n(p). It changes with the direction at the resolution of the aperture, but with the range only
through the curvature of the wavefront, so many ranges share one template. The search has three
levels. First, matched filters are evaluated for every template and sub-band. Second, their outputs
are summed over the sub-bands for range cells, within which delays and amplitudes hardly change.
Third, the sum for each band rotates along fine range steps, which resolve the carriers.

All lengths of the grid follow from the scenario; see `lattice`.
"""

import itertools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.gaussian import quadratic_form
from rhs_isac_ros.positioning.coordinates import (
    carrier_wavenumbers,
    concatenate,
    likelihood_loss,
    offset_to_roi,
    select,
)
from rhs_isac_ros.positioning.lattice import (
    PHASE_ERROR,
    Expansion,
    Resolution,
    lay_grid,
    subband_wavenumbers,
    whiten,
)
from rhs_isac_ros.positioning.likelihood import NuisancePrior
from rhs_isac_ros.support.threads import map_blocks

# Number of points that represent a standard Gaussian.
_N_NORMAL = 128
# Number of templates to compute at a time.
_BLOCK = 128
# Fine range steps per shortest wavelength; at least four are needed to resolve the posterior.
_STEPS_PER_WAVELENGTH = 8
# Number of outputs in a block, which limits the number of phases in it.
_N_OUTPUTS = 1 << 18
# Number of cells of a phase that are examined first, to find how likely the other cells must be.
_N_FIRST = 48
# Number of other relevant cells above which positions are drawn, without a search for modes.
_MAX_CELLS = 100
# Largest log-likelihood, relative to no direct path, at which positions are drawn. Peaks of
# stronger signals are so narrow that draws may hit some of them and miss others.
_MAX_DRAWN = 100.0
# Largest number of peaks of a phase that are kept, to limit memory and time. Only signals below
# the noise have more, and the peaks left out have little weight.
_MAX_PEAKS = 8192
# Squared Mahalanobis distance below which points belong to the same mode.
_SAME_MODE = 2.0
# Largest distance at which points are compared, in radii of the ellipsoid.
_MAX_REACH = 3.0
# Error within a range cell, as a share of the energy of the template.
_TABLE_ERROR = 0.015
# Error of the log-likelihood after a step with the slopes, relative to the loss that the step
# recovers.
_STEP_ERROR = 0.5


def tabulate(model: MeasurementModel, progress: Callable[[float], None] | None = None
             ) -> dict[str, np.ndarray]:
    """Compute the arrays of a `TemplateTable`, for G templates and C pairs of template and cell.

    The arrays are ``filters``, the conjugate templates, complex64 [N_B, N_SB, G, F];
    ``slope_filters``, their derivatives with respect to (r [m], u, v), complex64 [N_B, N_SB, G, 3,
    F]; ``energy`` of the whitened means, float32 [C]; ``energy_slope``, its derivative, float32
    [C, 3]; ``curvature`` of the log-likelihood, float64 [C, 3, 3]; ``spread``, the mean of the
    outer products of the whitened means, and ``whitener``, inverse Cholesky factors of the
    covariance, complex128 [N_B, N_SB F, N_SB F]; and ``normal``, points that represent a standard
    Gaussian, float64 [128, 3].
    """
    grid, (n_bands, n_rows) = lay_grid(model.scenario), model.shape
    points = grid.points
    n_subbands = subband_wavenumbers(model.scenario).shape[1]
    shape = n_bands, n_subbands, len(grid.nodes)
    n_frames, n_cells = n_rows // n_subbands, len(grid.cell)
    table = {
        'filters': np.empty((*shape, n_frames), np.complex64),
        'slope_filters': np.empty((*shape, 3, n_frames), np.complex64),
        'energy': np.empty(n_cells, np.float32),
        'energy_slope': np.empty((n_cells, 3), np.float32),
        'curvature': np.empty((n_cells, 3, 3)),
        'whitener': np.array(model.whitener),
        'normal': standard_normal(_N_NORMAL),
    }
    order = np.argsort(grid.node, kind='stable')
    bounds = np.searchsorted(grid.node[order], np.arange(len(grid.nodes) + 1))

    def fill(start: int) -> np.ndarray:
        nodes = slice(start, min(start + _BLOCK, len(grid.nodes)))
        expansion = Expansion.of(model, grid.nodes[nodes])
        by_frame = expansion.mean.conj().reshape(-1, n_bands, n_subbands, n_frames)
        table['filters'][:, :, nodes] = np.moveaxis(by_frame, 0, 2)
        by_frame = expansion.slopes.conj().reshape(-1, 3, n_bands, n_subbands, n_frames)
        table['slope_filters'][:, :, nodes] = np.moveaxis(by_frame, (0, 1), (2, 3))
        spread = np.zeros((n_bands, n_rows, n_rows), complex)
        cells = order[bounds[nodes.start]:bounds[nodes.stop]]
        for part in np.array_split(cells, -(-len(cells) // _BLOCK)):
            white = whiten(model, *expansion.at(grid.node[part] - nodes.start, points[part]))
            mean = np.moveaxis(white[:, 0], 1, 0)
            spread += np.einsum('icr,ics->irs', mean, mean.conj(), optimize=True)
            form = quadratic_form(white.reshape(len(part), 4, -1))
            table['energy'][part] = form[:, 0, 0] / 2
            table['energy_slope'][part] = form[:, 0, 1:]
            table['curvature'][part] = form[:, 1:, 1:]
        return spread

    blocks = map_blocks(fill, range(0, len(grid.nodes), _BLOCK), progress)
    table['spread'] = np.sum(blocks, axis=0) / n_cells
    return table


def standard_normal(n: int) -> np.ndarray:
    """Return points that represent a standard Gaussian, float64 [n, 3]; n is a power of two."""
    # The points are kept with the table because these imports take longer than loading a table.
    from scipy.special import ndtri
    from scipy.stats import qmc

    return ndtri(np.clip(qmc.Sobol(3, seed=0).random(n), 1e-6, 1 - 1e-6))


class TemplateTable:
    """Fast evaluation of the log-likelihood over the whole region of interest.

    `arrays` is the result of `tabulate`; its `normal`, `spread` and `energy` become attributes.
    """

    def __init__(self, scenario: Scenario, arrays: Mapping[str, np.ndarray]) -> None:
        self.normal, self.spread = arrays['normal'], arrays['spread']
        self.grid = grid = lay_grid(scenario)
        self._resolution = Resolution.of(scenario)
        self._filters, self._slope_filters = arrays['filters'], arrays['slope_filters']
        self._whitener = arrays['whitener']
        self.energy, self._energy_slope = arrays['energy'], arrays['energy_slope']
        self._curvature = arrays['curvature'] + np.diag(self._resolution.curvature_floor)
        self._inverse = np.linalg.inv(self._curvature).astype(np.float32)
        # Largest loss of log-likelihood between the directions of the grid.
        half = PHASE_ERROR * self._resolution.direction
        across = np.abs(arrays['curvature'][:, 1:, 1:])
        self._loss = np.einsum('a,cab,b->c', half, across, half) / 2 + _TABLE_ERROR * self.energy
        self._bounds = self._resolution.bounds_m
        self._wavenumbers = subband_wavenumbers(scenario)
        self._cell_turns = self._turns(grid.ranges_m).astype(np.complex64)
        self._set_windows(scenario)

    def _set_windows(self, scenario: Scenario) -> None:
        """Divide range cells into windows of similar widths, with the same fine steps."""
        grid, wavelength_m = self.grid, self._resolution.wavelength_m
        counts = np.ceil(grid.widths_m / grid.widths_m.min() - 1e-9).astype(int)
        self._first_window, self._n_windows = np.cumsum(counts) - counts, counts
        place = np.arange(counts.sum()) - np.repeat(self._first_window, counts)
        width_m = np.repeat(grid.widths_m / counts, counts)
        low_m = np.repeat(grid.ranges_m - grid.widths_m / 2, counts)
        self._window_ranges_m, self._window_widths_m = low_m + (place + 0.5) * width_m, width_m
        self._window_turns = self._turns(self._window_ranges_m).astype(np.complex64)
        n_fine = int(np.ceil(width_m.max() / wavelength_m * _STEPS_PER_WAVELENGTH))
        self.window_m = width_m.max()
        # One more step at either end keeps every maximum inside some window.
        self._step_m = width_m.max() / n_fine
        self._offsets_m = (np.arange(n_fine + 2) - (n_fine + 1) / 2) * self._step_m
        phase = np.exp(1j * carrier_wavenumbers(scenario) * self._offsets_m[:, None])
        self._rotation = (2 * np.hstack([phase.real, -phase.imag])).astype(np.float32)
        self._fine = np.ascontiguousarray(phase.T.astype(np.complex64))

    def _turns(self, ranges_m: np.ndarray) -> np.ndarray:
        """Return ratios of conjugate means to conjugate templates at ranges, [N_B, N_SB, R]."""
        return np.exp(1j * self._wavenumbers[..., None] * ranges_m) / ranges_m

    def starts(self, whitened: np.ndarray, prior: NuisancePrior, margin: float,
               draw: Callable[['Query', int], bool] | None = None) -> 'Starts':
        """Find the most likely separate points, to the accuracy of one Gauss-Newton step.

        `whitened` are the signals of N phases, complex128 [N, N_B, N_SB F], without offsets of
        carrier and timing. `margin` is the negative logarithm of the share of the posterior that
        may be left out. The points of a phase do not depend on the other phases. If a phase has
        weak signals and very many relevant cells, `draw` is called with the query and the phase's
        row in it. If `draw` returns True, the phase has no points.
        """
        n = max(1, _N_OUTPUTS // (len(self.energy) * len(self._wavenumbers)))
        parts = []
        for first in range(0, len(whitened), n):
            query = self.query(whitened[first:first + n], prior, margin)._replace(first=first)
            part = self._starts(query, draw)
            parts.append(part._replace(phases=part.phases + first))
        return concatenate(*parts)

    def query(self, whitened: np.ndarray, prior: NuisancePrior, margin: float) -> 'Query':
        """Apply the matched filters to whitened signals, complex128 [N, N_B, N_SB F]."""
        weighted = np.swapaxes(np.matmul(np.swapaxes(whitened, 0, 1), self._whitener.conj()), 0, 1)
        n, n_bands = weighted.shape[:2]
        signals = weighted.reshape(n, n_bands, -1, self._filters.shape[3]).astype(np.complex64)
        outputs = np.ascontiguousarray(np.moveaxis(np.matmul(
            self._filters, np.moveaxis(signals, 0, 3)), 3, 0))
        energies = np.sum(np.abs(whitened)**2, axis=(1, 2))
        query = Query(0, signals, outputs, energies, np.empty(()), prior, margin)
        return query._replace(bound=self._bound(query))

    def _starts(self, query: 'Query', draw: Callable[['Query', int], bool] | None) -> 'Starts':
        prior, margin = query.prior, query.margin
        peaks = self._peaks(query, draw)
        points = self._points(peaks)
        values = np.zeros((len(points), len(prior)))
        if len(prior):
            values = prior.start(peaks.outputs.T, peaks.gain)
        value = peaks.value
        if not prior.is_coarse:
            step, value = self._step(query, peaks, points, values)
            points = points + step
        error = _STEP_ERROR * self._loss[peaks.cell]
        curvature = self._curvature[peaks.cell]
        # Moves into the region lower the likelihood.
        value = value - likelihood_loss(offset_to_roi(
            points, curvature, self._bounds, self._resolution.tolerance_m), curvature)
        order = np.lexsort((-value, peaks.phases))
        firsts = first_of_each(peaks.phases[order])
        slack = error[order] + np.repeat(error[order[firsts]], np.diff(firsts, append=len(order)))
        order = order[heaviest(peaks.phases[order], value[order], margin + slack)]
        phases, points, values = peaks.phases[order], points[order], values[order]
        chosen = separate(phases, points, self._resolution.separation(prior.is_coarse),
                          curvature[order])
        return Starts(phases[chosen], points[chosen], values[chosen])

    def _peaks(self, query: 'Query', draw: Callable[['Query', int], bool] | None) -> '_Peaks':
        """Find the probable peaks along the range for all phases."""
        bound = query.bound
        n, n_first = len(bound), min(_N_FIRST, bound.shape[1])
        first = np.sort(np.argpartition(bound, -n_first, axis=1)[:, -n_first:], axis=1)
        rows = np.repeat(np.arange(n), n_first)
        peaks = self._peaks_of(rows, first.ravel(), query)
        best = np.full(n, -np.inf)
        np.maximum.at(best, peaks.phases, peaks.value)
        limit = best - query.margin
        likely = bound + self._loss >= limit[:, None]
        likely[rows, first.ravel()] = False
        if draw:
            many = (np.count_nonzero(likely, axis=1) > _MAX_CELLS) & (best <= _MAX_DRAWN)
            drawn = [row for row in np.flatnonzero(many).tolist() if draw(query, row)]
            if drawn:
                likely[drawn] = False
                peaks = select(peaks, ~np.isin(peaks.phases, drawn))
        rows, others = np.nonzero(likely)
        if len(rows):
            peaks = concatenate(peaks, self._peaks_of(rows, others, query))
        order = np.flatnonzero(peaks.value + self._loss[peaks.cell] >= limit[peaks.phases])
        order = order[np.lexsort((-peaks.value[order], peaks.phases[order]))]
        phases = peaks.phases[order]
        place = np.arange(len(order)) - np.searchsorted(phases, phases)
        peaks = select(peaks, order[place < _MAX_PEAKS])
        radii = self._resolution.separation(query.prior.is_coarse)
        return select(peaks, separate(peaks.phases, self._points(peaks), radii))

    def _points(self, peaks: '_Peaks') -> np.ndarray:
        """Return the points (r [m], u, v) of peaks, float64 [P, 3]."""
        points: np.ndarray = self.grid.nodes[self.grid.node[peaks.cell]]
        points[:, 0] = peaks.range_m
        return points

    def _bound(self, query: 'Query') -> np.ndarray:
        """Bound the log-likelihood in all cells, as if all bands were in phase, [N, C]."""
        grid, outputs = self.grid, query.outputs
        amplitude = np.empty((len(outputs), len(grid.node)), np.float32)
        turns = np.swapaxes(self._cell_turns, 1, 2)
        for nodes, cells, pairs in grid.segments:
            by_range = np.abs(np.matmul(turns[:, cells], outputs[..., nodes])).sum(axis=1)
            dense = ((grid.cell[pairs] - cells.start) * by_range.shape[2]
                     + grid.node[pairs] - nodes.start)
            amplitude[:, pairs] = by_range.reshape(len(outputs), -1)[:, dense]
        if not query.prior.gain_std:
            amplitude *= 2
            amplitude -= self.energy
            return amplitude
        n_rows = query.signals[0].size
        bounds = [query.prior.over_gain(one, energy, n_rows)[0]
                  for one, energy in zip(amplitude, query.energies.tolist(), strict=True)]
        return np.stack(bounds) - self.energy

    def _peaks_of(self, phases: np.ndarray, cells: np.ndarray, query: 'Query') -> '_Peaks':
        """Find all peaks along the range in (template, cell) pairs [K] of ascending phases [K]."""
        grid, outputs, prior = self.grid, query.outputs, query.prior
        pair, window = self._windows_of(cells)
        phases, cells = phases[pair], cells[pair]
        # Complex64 [W, N_B, N_SB], then the outputs of the bands, [N_B, W].
        by_subband = outputs[phases, :, :, grid.node[cells]]
        of_band = np.einsum('wis,isw->iw', by_subband, self._window_turns[:, :, window])
        scale = self._cell_ranges(cells) / self._window_ranges_m[window]
        energy = self.energy[cells] * (scale**2).astype(np.float32)
        fine = np.ones_like(self._fine[:, :1]) if prior.is_coarse else self._fine
        if prior.phase_covariance.any():
            likelihood = 2 * prior.amplitude(fine[..., None] * of_band[:, None])
        else:
            likelihood = self._rotation @ np.concatenate([of_band.real, of_band.imag])
        gain = np.zeros_like(likelihood) if prior.gain_std else None
        if gain is not None:
            ends = np.searchsorted(phases, np.arange(len(outputs) + 1))
            for (first, last), of_phase in zip(
                    itertools.pairwise(ends), query.energies.tolist(), strict=True):
                if last > first:
                    part = np.s_[:, first:last]
                    likelihood[part], gain[part] = prior.over_gain(
                        likelihood[part] / 2, of_phase, query.signals[0].size)
        likelihood -= energy
        is_peak = np.full(likelihood.shape, prior.is_coarse)
        if not prior.is_coarse:
            # Local maxima along the range, but not at its ends.
            np.greater_equal(likelihood[1:-1], likelihood[:-2], out=is_peak[1:-1])
            is_peak[1:-1] &= likelihood[1:-1] > likelihood[2:]
        step, column = np.nonzero(is_peak)
        value, range_m = likelihood[step, column], self._window_ranges_m[window[column]]
        if not prior.is_coarse:
            # The vertex of a parabola through a maximum and the steps beside it.
            slope = (likelihood[step + 1, column] - likelihood[step - 1, column]) / 2
            bend = 2 * value - likelihood[step + 1, column] - likelihood[step - 1, column]
            offset = slope / np.maximum(bend, np.abs(slope) + 1e-9)
            value = value + slope * offset / 2
            # Within a window, amplitudes decrease with the range.
            centre_m = range_m
            range_m = centre_m + self._offsets_m[step] + offset * self._step_m
            scale, of_template = centre_m / range_m, energy[column]
            value = scale * (value + of_template) - scale**2 * of_template
        at_peak = (of_band[:, column] * fine[:, step]).T
        return _Peaks(
            phases[column], cells[column], range_m, value,
            np.zeros(len(step)) if gain is None else gain[step, column], at_peak)

    def _windows_of(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """List the W windows of pairs [K]: index of each window's pair, and of the window, [W]."""
        ranges = self.grid.cell[cells]
        counts = self._n_windows[ranges]
        pair = np.repeat(np.arange(len(cells)), counts)
        place = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
        return pair, self._first_window[ranges][pair] + place

    def windows(self, query: 'Query', phase: int, cells: np.ndarray, directions: np.ndarray
                ) -> 'Windows':
        """Evaluate range windows of (template, cell) pairs [K] in directions (u, v), [K, 2].

        Means are approximated as linear in the offset from the template's direction, and energies
        as quadratic.
        """
        grid, curvature = self.grid, self._curvature[cells][:, 1:, 1:]
        node, slope, cell_m = grid.node[cells], self._energy_slope[cells], self._cell_ranges(cells)
        node_m, offset = grid.nodes[node, 0], directions - grid.nodes[node, 1:]
        change = np.column_stack([node_m * (1 - node_m / cell_m), offset]).astype(np.float32)
        by_subband = np.moveaxis(query.outputs[phase][:, :, node], 2, 0) + np.einsum(
            'iskqf,isf,kq->kis', self._slope_filters[:, :, node], query.signals[phase], change,
            optimize=True)
        energy = (self.energy[cells] + np.sum(slope[:, 1:] * offset, axis=1)
                  + likelihood_loss(offset, curvature))
        pair, window = self._windows_of(cells)
        outputs = np.einsum('wis,isw->wi', by_subband[pair], self._window_turns[:, :, window])
        range_m = self._window_ranges_m[window]
        along = (slope[:, 0] + 2 * self.energy[cells] / cell_m)[pair]
        energy = (cell_m[pair] / range_m)**2 * (energy[pair] + along * (range_m - cell_m[pair]))
        return Windows(
            pair, range_m, self._window_widths_m[window], outputs, energy.astype(np.float32))

    def _step(self, query: 'Query', peaks: '_Peaks', points: np.ndarray, values: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray]:
        """Compute a Gauss-Newton step [P, 3] for each peak; predict its new log-likelihood [P]."""
        grid, prior, node = self.grid, query.prior, self.grid.node[peaks.cell]
        pairs, index = np.unique(peaks.phases * len(grid.nodes) + node, return_inverse=True)
        phase, its_node = np.divmod(pairs, len(grid.nodes))
        # Axes: peak, band, sub-band and coordinate.
        slopes = np.einsum('iskqf,kisf->kisq', self._slope_filters[:, :, its_node],
                           query.signals[phase])[index]
        node_m = grid.nodes[node, 0]
        ratio = node_m / points[:, 0]
        change = (node_m * (1 - ratio))[:, None, None] * slopes[..., 0]
        value = query.outputs[peaks.phases, :, :, node] + change
        slopes[..., 0] *= (ratio**2)[:, None, None]
        turns = np.moveaxis(self._turns(points[:, 0]), 2, 0)
        if len(prior):
            turns = turns * np.exp(
                -1j * (values @ prior.phases.T) - peaks.gain[:, None])[..., None]
        rate = 1j * self._wavenumbers - 1 / points[:, 0, None, None]
        changes = 2 * np.einsum('pis,pis->p', turns, change).real
        along = np.einsum('pis,pis->p', turns * rate, value).real
        gradient = np.einsum('pis,pisq->pq', turns, slopes).real
        gradient[:, 0] += along
        gradient *= 2
        # Apart from its decrease with the squared range, the energy is linear within a cell.
        cell_m, slope = self._cell_ranges(peaks.cell), self._energy_slope[peaks.cell]
        scale = ((cell_m / points[:, 0])**2)[:, None]
        changes -= scale[:, 0] * (points[:, 0] - cell_m) * (
            slope[:, 0] + 2 * self.energy[peaks.cell] / cell_m)
        gradient -= scale * slope
        step = np.einsum('pij,pj->pi', self._inverse[peaks.cell], gradient) / scale
        limits = self._resolution.step_limits(prior.is_coarse)
        rise = np.sum(gradient * step, axis=1) / 2
        return np.clip(step, -limits, limits), peaks.value + changes + rise

    def _cell_ranges(self, cells: np.ndarray) -> np.ndarray:
        """Return the central range [m] of the cell of each (template, cell) pair, float64 [K]."""
        return self.grid.ranges_m[self.grid.cell[cells]]


class Starts(NamedTuple):
    """Points at which the ascent to the modes of N phases starts, the most likely first."""

    phases: np.ndarray  # Phase of each point, int [M], ascending.
    points: np.ndarray  # (r [m], u, v), float64 [M, 3].
    values: np.ndarray  # Nuisance parameters, float64 [M, Q].


class Query(NamedTuple):
    """Signals of N phases, prepared for comparison with the templates of the grid."""

    first: int  # Index of the first phase.
    signals: np.ndarray  # Weighted with the inverse covariance, complex64 [N, N_B, N_SB, F].
    outputs: np.ndarray  # Filter outputs for all templates, complex64 [N, N_B, N_SB, G].
    energies: np.ndarray  # Energies of the whitened signals, float64 [N].
    bound: np.ndarray  # Bound of the log-likelihood in each cell, [N, C].
    prior: NuisancePrior
    margin: float


class Windows(NamedTuple):
    """W windows of range, in which only the phases of the carriers change."""

    pair: np.ndarray  # Index of the window's pair, int [W], ascending.
    range_m: np.ndarray  # Centre, float64 [W] [m].
    width_m: np.ndarray  # Float64 [W] [m].
    outputs: np.ndarray  # Matched-filter outputs of the bands at the centre, complex64 [W, N_B].
    energy: np.ndarray  # Energy of the whitened mean, float32 [W].


class _Peaks(NamedTuple):
    """P peaks along the range."""

    phases: np.ndarray  # Phase of each, int [P].
    cell: np.ndarray  # Index of the (template, cell) pair, int [P].
    range_m: np.ndarray  # Float64 [P] [m].
    value: np.ndarray  # Log-likelihood, float32 [P].
    gain: np.ndarray  # Most likely gain [nepers], float64 [P].
    outputs: np.ndarray  # Matched-filter outputs of the bands, complex64 [P, N_B].


def first_of_each(phases: np.ndarray) -> np.ndarray:
    """Return the index of the first point of each phase, for phases [M] in ascending order."""
    changes = np.ones(len(phases), bool)
    np.not_equal(phases[1:], phases[:-1], out=changes[1:])
    return np.flatnonzero(changes)


def heaviest(phases: np.ndarray, value: np.ndarray, margin: float | np.ndarray) -> np.ndarray:
    """Mark the points that contain almost all of the weight of their phase, bool [M].

    `phases`, int [M], are in ascending order. The log-likelihoods `value`, float64 [M], are in
    descending order within each phase. `margin`, a number or an array [M], is the negative
    logarithm of the share that may be left out.
    """
    firsts = first_of_each(phases)
    counts = np.diff(firsts, append=len(phases))
    relative = value - np.repeat(value[firsts], counts)
    total = np.add.reduceat(np.exp(relative), firsts)
    # Within a phase, no later point is heavier.
    n_left = np.repeat(firsts + counts, counts) - np.arange(len(phases))
    return relative + np.log(n_left) > np.repeat(np.log(total), counts) - margin


def separate(phases: np.ndarray, points: np.ndarray, radii: np.ndarray,
             curvature: np.ndarray | None = None) -> np.ndarray:
    """Mark the points that do not belong to the mode of a better point, bool [M].

    `phases`, int [M], are in ascending order. The `points` (r [m], u, v), float64 [M, 3], of each
    phase begin with the best one. An ellipsoid with the `radii` [3] around a mode contains no
    other mode. Given the curvature [M, 3, 3] of the log-likelihood, broad modes extend further.
    """
    from scipy.spatial import cKDTree

    scaled, chosen, reach = points / radii, np.ones(len(points), bool), 1.0
    if not len(points):
        return chosen
    if curvature is not None:
        variance = np.diagonal(np.linalg.inv(curvature), axis1=1, axis2=2) / radii**2
        reach = float(np.clip(np.sqrt(_SAME_MODE * variance.max()), 1.0, _MAX_REACH))
    # Move points of different phases far away from each other.
    scaled[:, 0] += phases * (2 * reach + np.ptp(scaled[:, 0]))
    better, worse = cKDTree(scaled).query_pairs(reach, output_type='ndarray').T
    if curvature is not None:
        offset = points[worse] - points[better]
        close = np.sum((offset / radii)**2, axis=1) < 1
        close |= np.einsum('kp,kpq,kq->k', offset, curvature[worse], offset) < _SAME_MODE
        worse, better = worse[close], better[close]
    previous = ~chosen
    # Only better points matter to a point, so each round settles at least one more. A few rounds
    # suffice.
    while (chosen != previous).any():
        previous = chosen
        chosen = np.ones(len(points), bool)
        chosen[worse[previous[better]]] = False
    return chosen
