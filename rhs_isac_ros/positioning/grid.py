"""The search for modes of the likelihood on a grid of templates over the region of interest.

The search has three levels. First, matched filters are evaluated for every template and sub-band;
see `templates`. Second, their outputs are summed over the sub-bands for range bins, within which
delays and amplitudes hardly change. Third, the sum for each band rotates along fine range steps,
which resolve the carriers; see `peaks`.

All lengths of the grid follow from the scenario; see `lattice`.
"""

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import marked, read_only
from rhs_isac_ros.model.gaussian import likelihood_loss
from rhs_isac_ros.positioning.estimate import Fit
from rhs_isac_ros.positioning.lattice import (
    Grid,
    Resolution,
    carrier_wavenumbers,
    lay_grid,
    subband_wavenumbers,
)
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.peaks import Candidates, PeakFinder, Peaks, RangeWindows
from rhs_isac_ros.positioning.segments import Segments, concatenate, select
from rhs_isac_ros.positioning.sheets import move_inside
from rhs_isac_ros.positioning.templates import Cells, Filters, Query, turns_at


class Draw(NamedTuple):
    """How to draw positions for weak signals, in place of a search for modes."""

    # Largest log-likelihood of a shot, relative to no direct path.
    largest: float
    # Computes the posterior of one shot of a query, or returns None if a search is better.
    fit: Callable[[Query, int], Fit | None]


# Number of amplitudes in a block, one for each shot, cell and band, which limits the number of
# shots in it.
_BLOCK = 1 << 18
# Number of cells of a shot that are examined first, to find how likely the others must be.
_FIRST_CELLS = 48
# Number of other relevant cells above which positions are drawn, without a search for modes.
_SEARCHED_CELLS = 100
# Largest number of peaks of a shot that are kept, to limit memory and time. Only signals below the
# noise have more, and the peaks left out have little weight.
_PEAKS = 8192
# Remaining error of the log-likelihood after a step with the slopes, as a share of the loss that
# the step recovers.
_STEP_ERROR = 0.25
# Gain of log-likelihood that a peak may have off a region without extent along an axis.
_OFF_REGION = 3.0
# Squared Mahalanobis distance below which points belong to the same mode, and largest distance at
# which they are compared, in radii of an ellipsoid that contains no other mode.
_SAME_MODE = 2.0
_REACH = 3.0
# Number of points up to which comparing all pairs is faster than a search tree.
_FEW_POINTS = 48


class Starts(NamedTuple):
    """Points at which the ascent to the modes of N shots starts, the most likely first."""

    shots: np.ndarray  # Shot of each point, int [M], ascending.
    points: np.ndarray  # (r [m], u, v), float64 [M, 3].
    values: np.ndarray  # Nuisance parameters, float64 [M, Q].


class Windows(NamedTuple):
    """W windows of range, in which only the phases of the carriers change."""

    row: np.ndarray  # Index of the window's cell in the list of cells, int [W], ascending.
    range_m: np.ndarray  # Centre, float64 [W] [m].
    width_m: np.ndarray  # Float64 [W] [m].
    outputs: np.ndarray  # Matched-filter outputs of the bands at the centre, complex64 [W, N_B].
    energy: np.ndarray  # Energy of the whitened mean, float32 [W].


class TemplateTable:
    """Fast evaluation of the log-likelihood over the whole region of interest.

    `arrays` is the result of `tabulate` for a grid, by default that of the region; its `normal`
    and `spread` become attributes.
    """

    def __init__(self, scenario: Scenario, arrays: Mapping[str, np.ndarray],
                 grid: Grid | None = None) -> None:
        self.normal, self.spread = arrays['normal'], arrays['spread']
        self.grid = grid or lay_grid(scenario)
        self._resolution = resolution = Resolution.of(scenario)
        self.filters = Filters.of(arrays)
        self.cells = Cells.of(self.grid, resolution, arrays)
        self._wavenumbers, self._carriers = (
            subband_wavenumbers(scenario), carrier_wavenumbers(scenario))
        self._bin_turns = turns_at(self._wavenumbers, self.grid.ranges_m).astype(np.complex64)
        self._range_windows = RangeWindows(self.grid, self._wavenumbers)
        self.max_width_m = self._range_windows.width_m.max()
        self._finder = PeakFinder(self.max_width_m, resolution.wavelength_m, self._carriers)

    def starts(self, whitened: np.ndarray, prior: NuisancePrior, margin: float | np.ndarray
               ) -> Starts:
        """Find the most likely separate points; see `search`."""
        return self.search(whitened, prior, margin)[0]

    def search(self, whitened: np.ndarray, prior: NuisancePrior, margin: float | np.ndarray,
               draw: Draw | None = None) -> tuple[Starts, dict[int, Fit]]:
        """Find the most likely separate points, to the accuracy of one Gauss-Newton step.

        `whitened` are the signals of N shots, complex128 [N, N_B, N_SB F], after the
        correction of carrier and timing. `margin` is the negative logarithm of the share of the
        posterior that may be left out, a number or one for each cell, [C]. The points of a shot do
        not depend on the other shots. If a shot has weak signals and very many relevant cells,
        `draw` computes its posterior. A shot for which it returns one has no points. These
        posteriors are returned, too, keyed by the shot.
        """
        n = max(1, _BLOCK // (len(self.cells.template_energy) * len(self._wavenumbers)))
        parts, drawn = [], {}
        for first in range(0, len(whitened), n):
            query = self.query(whitened[first:first + n], prior, margin)
            peaks, fits = self._peaks(query, draw)
            part = self._starts(query, peaks)
            parts.append(part._replace(shots=part.shots + first))
            drawn.update({first + shot: fit for shot, fit in fits.items()})
        return concatenate(*parts), drawn

    def query(self, whitened: np.ndarray, prior: NuisancePrior, margin: float | np.ndarray
              ) -> Query:
        """Apply the matched filters to whitened signals, complex128 [N, N_B, N_SB F]."""
        thin = np.count_nonzero(np.ptp(self._resolution.bounds_m, axis=0) == 0)
        query = Query(*self.filters.apply(whitened), np.empty(()), prior,
                      np.atleast_1d(margin + thin * _OFF_REGION))
        return query._replace(bound=self._bound(query))

    def _starts(self, query: Query, peaks: Peaks) -> Starts:
        """Take a step from each peak, and return the most likely separate points."""
        prior = query.prior
        points, value = self._points(peaks), peaks.value
        values = np.zeros((len(points), len(prior)))
        if len(prior):
            values = prior.start(peaks.outputs.T, peaks.gain)
        if not prior.is_coarse:
            step, value = self._step(query, peaks, points, values)
            points = points + step
        curvature = self.cells.curvature.take(peaks.cell, axis=0)
        # Moving a point into the region lowers its likelihood; the parameters follow.
        marginal = self.cells.marginal.take(peaks.cell, axis=0)
        inside = move_inside(points, marginal, self._resolution.bounds_m)
        value = value - likelihood_loss(inside - points, marginal)
        values += np.einsum('pqa,pa->pq', self.cells.regression[peaks.cell], inside - points)
        order = np.lexsort((-value, peaks.shots))
        of_shot = Segments.of_keys(peaks.shots[order])
        error = _STEP_ERROR * self.cells.loss[peaks.cell[order]]
        # The values of a peak and of the best one may both be in error.
        slack = error + of_shot.repeat(of_shot.first(error))
        margin = np.broadcast_to(query.margin, self.cells.loss.shape)[peaks.cell[order]]
        order = order[heaviest(of_shot, value[order], margin + slack)]
        starts = Starts(peaks.shots[order], inside[order], values[order])
        radii = self._resolution.separation(prior.is_coarse)
        return select(starts, separate(starts.shots, starts.points, radii, curvature[order]))

    def _peaks(self, query: Query, draw: Draw | None = None) -> tuple[Peaks, dict[int, Fit]]:
        """Find the probable peaks along the range, the most likely of each shot first.

        Also returns the posteriors of the shots for which `draw` has returned one.
        """
        bound, loss, shots = query.bound, self.cells.loss, np.arange(len(query.bound))[:, None]
        # The cells with the highest bounds determine how likely peaks in the others must be.
        n_first = min(_FIRST_CELLS, bound.shape[1])
        first = np.sort(np.argpartition(bound, -n_first, axis=1)[:, -n_first:], axis=1)
        peaks = self._peaks_in(np.repeat(shots, n_first), first.ravel(), query)
        best = np.full(len(shots), -np.inf)
        np.maximum.at(best, peaks.shots, peaks.value)
        limit = np.broadcast_to(best[:, None] - query.margin, bound.shape)
        is_likely = bound + loss >= limit
        is_likely[shots, first] = False
        drawn = {}
        if draw:
            (weak,) = (best <= draw.largest).nonzero()
            many = is_likely[weak].sum(axis=1) > _SEARCHED_CELLS
            drawn = {shot: fit for shot in weak[many].tolist()
                     if (fit := draw.fit(query, shot)) is not None}
        if drawn:
            is_likely[[*drawn]] = False
            peaks = select(peaks, ~np.isin(peaks.shots, [*drawn]))
        others, cells = marked(is_likely)
        if len(others):
            peaks = concatenate(peaks, self._peaks_in(others, cells, query))
        (kept,) = (peaks.value + loss[peaks.cell] >= limit[peaks.shots, peaks.cell]).nonzero()
        kept = kept[np.lexsort((-peaks.value[kept], peaks.shots[kept]))]
        peaks = select(
            peaks, kept[Segments.of_keys(peaks.shots[kept]).places < _PEAKS])
        radii = self._resolution.separation(query.prior.is_coarse)
        return select(peaks, separate(peaks.shots, self._points(peaks), radii)), drawn

    def _points(self, peaks: Peaks) -> np.ndarray:
        """Return the points (r [m], u, v) of peaks, float64 [P, 3]."""
        points: np.ndarray = self.grid.nodes.take(self.grid.node[peaks.cell], axis=0)
        points[:, 0] = peaks.range_m
        return points

    def _bound(self, query: Query) -> np.ndarray:
        """Bound the log-likelihood in all cells, as if all bands were in phase, [N, C].

        It is relative to no direct path if the gain is known, and includes the energy of the
        signals otherwise.
        """
        grid, outputs = self.grid, query.outputs
        amplitude = np.empty((len(outputs), len(grid.node)), np.float32)
        turns = np.swapaxes(self._bin_turns, 1, 2)
        for nodes, bins, cells in grid.shells:
            by_range = np.abs(np.matmul(turns[:, bins], outputs[..., nodes])).sum(axis=1)
            # Place of each cell among all combinations of bins and templates of the shell.
            place = ((grid.range_bin[cells] - bins.start) * by_range.shape[2]
                     + grid.node[cells] - nodes.start)
            amplitude[:, cells] = by_range.reshape(len(outputs), -1)[:, place]
        if not query.prior.gain_std:
            amplitude *= 2
            amplitude -= self.cells.template_energy
            return amplitude
        n_measurements = query.signals[0].size
        bounds = [query.prior.maximised_over_gain(one, energy, n_measurements)[0]
                  for one, energy in zip(amplitude, query.energies.tolist(), strict=True)]
        return np.stack(bounds) - self.cells.template_energy

    def _peaks_in(self, shots: np.ndarray, cells: np.ndarray, query: Query) -> Peaks:
        """Find all peaks along the range in cells [K] of ascending shots [K]."""
        row, window = self._range_windows.of_cells(cells)
        shots, cells, range_m = shots[row], cells[row], self._range_windows.range_m[window]
        # Complex64 [W, N_B, N_SB], then the outputs of the bands, [N_B, W].
        by_subband = query.outputs[shots, :, :, self.grid.node[cells]]
        of_band = np.einsum(
            'wis,isw->iw', by_subband, self._range_windows.turns.take(window, axis=2))
        energy = self.cells.template_energy_at(cells, range_m)
        margin = (query.margin + self.cells.loss).take(cells)
        return self._finder.find(
            Candidates(shots, cells, range_m, of_band, energy, margin), query)

    def evaluate_windows(self, query: Query, shot: int, cells: np.ndarray, directions: np.ndarray
                ) -> Windows:
        """Evaluate range windows of cells [K] in directions (u, v), [K, 2].

        Means are approximated as linear in the offset from the template's direction, and energies
        as quadratic.
        """
        grid, node, cell = self.grid, self.grid.node[cells], select(self.cells, cells)
        # Templates are linear in 1 / r: r0^2 (1 / r0 - 1 / r).
        node_m, offset = grid.nodes[node, 0], directions - grid.nodes[node, 1:]
        change = np.column_stack([node_m * (1 - node_m / cell.range_m), offset]).astype(np.float32)
        by_subband = np.moveaxis(query.outputs[shot][:, :, node], 2, 0) + np.einsum(
            'iskqf,isf,kq->kis', self.filters.slopes[:, :, node], query.signals[shot], change,
            optimize=True)
        energy = (cell.energy + np.sum(cell.energy_slope[:, 1:] * offset, axis=1)
                  + likelihood_loss(offset, cell.curvature[:, 1:, 1:]))
        row, window = self._range_windows.of_cells(cells)
        outputs = np.einsum(
            'wis,isw->wi', by_subband[row], self._range_windows.turns[:, :, window])
        range_m, cell_m = self._range_windows.range_m[window], cell.range_m[row]
        energy = (cell_m / range_m)**2 * (energy[row] + cell.along[row] * (range_m - cell_m))
        return Windows(
            row, range_m, self._range_windows.width_m[window], outputs, energy.astype(np.float32))

    def _step(self, query: Query, peaks: Peaks, points: np.ndarray, values: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray]:
        """Compute a Gauss-Newton step [P, 3] for each peak, and predict its result [P].

        The result is the log-likelihood after the step.
        """
        cells, range_m, centre_m = self.cells, points[:, 0], peaks.centre_m
        outputs, at_point, slopes = self._outputs(query, peaks, range_m)
        turns, at_window = (turns_at(self._wavenumbers, at_m).transpose(2, 0, 1)
                            for at_m in (range_m, centre_m))
        # The value of a peak was computed with the delays of the centre of its window. It also
        # contains priors and, with an unknown gain, the energy of the signals, so only the part
        # of the direct path is replaced.
        fading = centre_m / range_m
        at_window *= (fading[:, None] * np.exp(
            1j * self._carriers * (range_m - centre_m)[:, None]))[..., None]
        if len(query.prior):
            factor = np.exp(-1j * (values @ query.prior.phases.T) - peaks.gain[:, None])[..., None]
            turns, at_window = turns * factor, at_window * factor
        approximate = (2 * np.einsum('pis,pis->p', at_window, outputs).real
                       - fading**2 * cells.template_energy_at(peaks.cell, centre_m))
        exact = (2 * np.einsum('pis,pis->p', turns, at_point).real
                 - cells.energy_at(peaks.cell, range_m))
        # The gradient of `exact`. Energies decrease with the squared range.
        gradient = 2 * np.einsum('pis,pisq->pq', turns, slopes).real
        rate = 1j * self._wavenumbers - 1 / range_m[:, None, None]
        gradient[:, 0] += 2 * np.einsum('pis,pis->p', turns * rate, at_point).real
        decrease = ((cells.range_m[peaks.cell] / range_m)**2)[:, None]
        gradient -= decrease * cells.energy_slope[peaks.cell]
        step = np.einsum('pij,pj->pi', cells.inverse[peaks.cell], gradient) / decrease
        limits = self._resolution.step_limits(query.prior.is_coarse)
        step = np.minimum(np.maximum(step, -limits), limits)
        rise = np.sum(gradient * step, axis=1) - decrease[:, 0] * likelihood_loss(
            step, cells.curvature[peaks.cell])
        most = query.explained_at_most(peaks.shots, peaks.gain)
        change = np.minimum(exact + rise, most) - np.minimum(approximate, most)
        return step, peaks.value + change

    def _outputs(self, query: Query, peaks: Peaks, range_m: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return filter outputs of peaks, and their derivatives, at ranges [P] [m].

        The outputs, [P, N_B, N_SB], are those with the wavefront's curvature at the range of the
        template, and those with the curvature at the given ranges. The derivatives of the latter
        are [P, N_B, N_SB, 3].
        """
        nodes = self.grid.node[peaks.cell]
        slopes = np.einsum('iskqf,kisf->kisq', self.filters.slopes.take(nodes, axis=2),
                           query.signals.take(peaks.shots, axis=0))
        outputs, node_m = query.outputs[peaks.shots, :, :, nodes], self.grid.nodes[nodes, 0]
        ratio = node_m / range_m
        # Linear in 1 / r, as in `evaluate_windows`.
        at_range = outputs + (node_m * (1 - ratio))[:, None, None] * slopes[..., 0]
        slopes[..., 0] *= (ratio**2)[:, None, None]
        return outputs, at_range, slopes


def heaviest(of_shot: Segments, value: np.ndarray, margin: float | np.ndarray) -> np.ndarray:
    """Mark the points that contain almost all of the weight of their shot, bool [M].

    The log-likelihoods `value`, float64 [M], are in descending order within each shot. `margin`, a
    number or an array [M], is the negative logarithm of the share that may be left out.
    """
    relative = value - of_shot.repeat(of_shot.first(value))
    total = of_shot.sum(np.exp(relative))
    # Within a shot, no later point is heavier.
    n_left = of_shot.repeat(of_shot.ends) - np.arange(len(value))
    return relative + np.log(n_left) > of_shot.repeat(np.log(total)) - margin


def _near(shots: np.ndarray, scaled: np.ndarray, reach: float
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of points of a shot within `reach`, the first one first, and their squares."""
    if len(scaled) <= _FEW_POINTS:
        first, last = _all_pairs(len(scaled))
    else:
        from scipy.spatial import cKDTree

        # Move points of different shots far away from each other.
        moved = scaled.copy()
        moved[:, 0] += shots * (2 * reach + np.ptp(scaled[:, 0]))
        first, last = cKDTree(moved).query_pairs(reach, output_type='ndarray').T
    offsets = scaled.take(last, axis=0) - scaled.take(first, axis=0)
    squares = np.einsum('kp,kp->k', offsets, offsets)
    (near,) = ((squares <= reach**2) & (shots[first] == shots[last])).nonzero()
    return first[near], last[near], squares[near]


@functools.cache
def _all_pairs(n: int) -> tuple[np.ndarray, np.ndarray]:
    first, last = np.triu_indices(n, 1)
    return read_only(first), read_only(last)


def separate(shots: np.ndarray, points: np.ndarray, radii: np.ndarray,
             curvature: np.ndarray | None = None) -> np.ndarray:
    """Mark the points that do not belong to the mode of a better point, bool [M].

    `shots`, int [M], are in ascending order. The `points` (r [m], u, v), float64 [M, 3], of each
    shot begin with the best one; they may have further coordinates. An ellipsoid with the `radii`
    [3] around a mode contains no other mode. Given the curvature [M, 3, 3] of the log-likelihood,
    broad modes extend further, but not in the further coordinates.
    """
    chosen = np.ones(len(points), bool)
    if len(points) < 2:
        return chosen
    better, worse, squares = _near(
        shots, points / radii, 1.0 if curvature is None else _REACH)
    if curvature is not None:
        offset, close = points[worse] - points[better], squares < 1
        close |= (2 * likelihood_loss(
            offset[:, :3], curvature.take(worse, axis=0)) < _SAME_MODE) & (
                np.sum((offset / radii)[:, 3:]**2, axis=1) < 1)
        worse, better = worse[close], better[close]
    previous = chosen if not len(worse) else ~chosen
    # A point depends only on better points, so each round settles at least one more. A few rounds
    # suffice.
    while (chosen != previous).any():
        previous = chosen
        chosen = np.ones(len(points), bool)
        chosen[worse[previous[better]]] = False
    return chosen
