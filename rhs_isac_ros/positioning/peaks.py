"""Peaks of the log-likelihood along the range, in windows that resolve the carriers of the bands.

A maximum is located as if delays and amplitudes in its window were those of the centre, so that
only the phases of the bands turn along the range. Its value is that of the amplitude at its range.
"""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import marked
from rhs_isac_ros.positioning.lattice import Grid
from rhs_isac_ros.positioning.segments import Segments, select
from rhs_isac_ros.positioning.templates import Query, turns_at

# Fine range steps per shortest wavelength; at least four are needed to resolve the posterior.
_STEPS_PER_WAVELENGTH = 8
# Error of an amplitude at the vertex of a parabola through three steps, as a share of it.
_VERTEX_ERROR = 0.01


class RangeWindows:
    """Windows of similar widths that divide the range bins of a grid.

    `range_m` and `width_m`, float64 [R], are their centres and widths; `turns`, complex64 [N_B,
    N_SB, R], are the factors of `turns_at` at their centres.
    """

    def __init__(self, grid: Grid, wavenumbers: np.ndarray) -> None:
        self._range_bin = grid.range_bin
        counts = np.ceil(grid.widths_m / grid.widths_m.min() - 1e-9).astype(int)
        self._of_bin = Segments.of_counts(counts)
        self.width_m = self._of_bin.repeat(grid.widths_m / counts)
        low_m = self._of_bin.repeat(grid.ranges_m - grid.widths_m / 2)
        self.range_m = low_m + (self._of_bin.places + 0.5) * self.width_m
        self.turns = turns_at(wavenumbers, self.range_m).astype(np.complex64)

    def of_cells(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """List the W windows of cells [K].

        Returns two indices for each window, int [W]: that of its cell, from 0 to K - 1, and its
        own.
        """
        windows = select(self._of_bin, self._range_bin[cells])
        of_cell = Segments.of_counts(windows.counts)
        index = of_cell.repeat(np.arange(len(cells)))
        return index, of_cell.repeat(windows.starts) + of_cell.places


class Candidates(NamedTuple):
    """W windows of cells in which peaks are possible, in order of the shots."""

    shots: np.ndarray  # Shot of each, int [W], ascending.
    cell: np.ndarray  # Index of the cell in the grid, int [W].
    range_m: np.ndarray  # Centre, float64 [W] [m].
    outputs: np.ndarray  # Matched-filter outputs of the bands at the centre, complex64 [N_B, W].
    energy: np.ndarray  # Energy of the template at the centre, float32 [W].
    # Decrease from the best value of the shot up to which peaks count, float64 [W].
    margin: np.ndarray


class Peaks(NamedTuple):
    """P peaks along the range."""

    shots: np.ndarray  # Shot of each, int [P].
    cell: np.ndarray  # Index of the cell in the grid, int [P].
    centre_m: np.ndarray  # Centre of the window of range, float64 [P] [m].
    range_m: np.ndarray  # Float64 [P] [m].
    value: np.ndarray  # Log-likelihood, as if delays were those at `centre_m`, float [P].
    gain: np.ndarray  # Most likely gain [nepers], float [P].
    outputs: np.ndarray  # Matched-filter outputs of the bands, complex128 [P, N_B].


class PeakFinder:
    """Search for peaks in windows, in which the bands' carriers [N_B] [1/m] turn along the range.

    With known phases, the log-likelihood is evaluated at fine steps across a window. With uniform
    phases of the bands, it hardly changes within a window.
    """

    def __init__(self, width_m: float, wavelength_m: float, carriers: np.ndarray) -> None:
        n_steps = int(np.ceil(width_m / wavelength_m * _STEPS_PER_WAVELENGTH))
        # One more step at either end keeps every maximum inside some window.
        self._step_m, self._carriers = width_m / n_steps, carriers
        self._offsets_m = (np.arange(n_steps + 2) - (n_steps + 1) / 2) * self._step_m
        turns = np.exp(1j * carriers * self._offsets_m[:, None])
        self._turns = np.ascontiguousarray(turns.T.astype(np.complex64))
        # The real part of the product with complex outputs, as a product of real numbers.
        self._rotation = (2 * np.hstack([turns.real, -turns.imag])).astype(np.float32)

    def find(self, candidates: Candidates, query: Query) -> Peaks:
        """Find the probable peaks, at least one of each shot, in the order of the windows."""
        if query.prior.is_coarse:
            return self._centres(candidates, query)
        return self._maxima(candidates, query)

    def _centres(self, candidates: Candidates, query: Query) -> Peaks:
        """Return the centre of every window."""
        value, gain = _valued(query.prior.amplitude(candidates.outputs), candidates, query)
        return Peaks(candidates.shots, candidates.cell, candidates.range_m, candidates.range_m,
                     value, gain, candidates.outputs.T.astype(complex))

    def _maxima(self, candidates: Candidates, query: Query) -> Peaks:
        """Return the local maxima along the range; see `_inner_maxima`."""
        if query.prior.phase_covariance.any():
            along = 2 * query.prior.amplitude(
                self._turns[..., None] * candidates.outputs[:, None])
        else:
            outputs = candidates.outputs
            along = self._rotation @ np.concatenate([outputs.real, outputs.imag])
        step, window = _inner_maxima(along)
        # The vertex of a parabola through a maximum and the steps beside it.
        before, highest, after = (
            along.take((step + side) * along.shape[1] + window) for side in (-1, 0, 1))
        slope, bend = (after - before) / 2, 2 * highest - after - before
        change = slope / np.maximum(bend, np.abs(slope) + 1e-9)
        found = select(candidates._replace(outputs=candidates.outputs.T), window)
        centre_m = found.range_m
        range_m = centre_m + self._offsets_m[step] + change * self._step_m
        # Within a window, amplitudes decrease with the range.
        scale = centre_m / range_m
        found = found._replace(range_m=range_m, energy=scale**2 * found.energy)
        amplitude = scale * (highest + slope * change / 2) / 2
        value, gain = _valued(amplitude, found, query)
        # Most peaks are far below the best one.
        error, of_shot = np.abs(np.exp(-gain) * amplitude), Segments.of_keys(found.shots)
        error = 2 * _VERTEX_ERROR * (error + of_shot.repeat(of_shot.max(error)))
        kept = value + error >= of_shot.repeat(of_shot.max(value)) - found.margin
        found, centre_m = select(found, kept), centre_m[kept]
        outputs = found.outputs * np.exp(
            1j * self._carriers * (found.range_m - centre_m)[:, None])
        amplitude = scale[kept] * query.prior.amplitude(outputs.T)
        value, gain = _valued(amplitude, found, query)
        return Peaks(found.shots, found.cell, centre_m, found.range_m, value, gain, outputs)


def _inner_maxima(along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return step and window of the local maxima of values [S, W], by window, int [P] each.

    A window without a maximum, as at an end of the region, has its highest value between its ends.
    """
    inner = along[1:-1]
    is_peak = inner >= along[:-2]
    is_peak &= inner > along[2:]
    (lacking,) = np.nonzero(~np.logical_or.reduce(is_peak))
    is_peak[inner[:, lacking].argmax(axis=0), lacking] = True
    step, window = marked(is_peak)
    order = np.argsort(window, kind='stable')
    return step[order] + 1, window[order]


def _valued(amplitude: np.ndarray, found: Candidates, query: Query
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return the log-likelihoods of windows with amplitudes [W], and the gains [nepers], [W]."""
    (value,), (gain,) = _over_gain(2 * amplitude[None], found, query)
    explained = 2 * np.exp(-gain) * amplitude - found.energy
    return value - np.maximum(
        explained - query.explained_at_most(found.shots, gain), 0), gain


def _over_gain(doubled: np.ndarray, candidates: Candidates, query: Query
               ) -> tuple[np.ndarray, np.ndarray]:
    """Maximise the log-likelihood over the gain, for twice the amplitude [S, W].

    Returns the log-likelihood and the gain [nepers], [S, W]; the former overwrites `doubled`.
    """
    gain = np.zeros(doubled.shape)
    if query.prior.gain_std:
        n_measurements = query.signals[0].size
        for part in Segments.of_keys(candidates.shots).slices:
            energy = float(query.energies[candidates.shots[part.start]])
            doubled[:, part], gain[:, part] = query.prior.maximised_over_gain(
                doubled[:, part] / 2, energy, n_measurements)
    doubled -= candidates.energy
    return doubled, gain
