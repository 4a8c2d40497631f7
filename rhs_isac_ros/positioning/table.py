"""The search for modes of the likelihood on a table of templates.

The log-likelihood at range steps that resolve the carrier follows from one complex number per
band and grid point: the fine range steps rotate the phase of the matched filter's output.
"""

from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.positioning.polar import to_positions
from rhs_isac_ros.positioning.region import is_inside, likelihood_loss, offset_to_roi
from rhs_isac_ros.positioning.separation import separate, separate_each
from rhs_isac_ros.positioning.templates import RANGE_CELL_M, carrier_wavenumbers

# Fine range steps per shortest wavelength; at least four are needed to resolve the posterior.
STEPS_PER_WAVELENGTH = 8
# Number of grid points, and of peaks along their range, that the search examines closely.
_MAX_CELLS = 256
_MAX_PEAKS = 256
# Number of phases to search at a time.
_BLOCK = 32
# Peaks closer than this in all of (r in wavelengths, u, v) are one mode.
_MIN_SEPARATION = (0.3, 0.05, 0.05)
# Error of a mode's log-likelihood due to the grid, as a share of the template's energy.
_GRID_ERROR = 0.05
# Curvature of the log-likelihood in (r, u, v) [1/m^2, 1, 1] to add everywhere. It keeps matrices
# regular where the signals carry no information, and is weaker than the prior on any usual region
# of interest.
MIN_CURVATURE = (1e-3, 1e-1, 1e-1)
# The linear model does not hold for longer steps.
_STEP_LIMITS = np.array([0.02, 0.03, 0.03])


class TemplateTable:
    """Fast evaluation of the log-likelihood over the whole region of interest.

    Parameters
    ----------
    arrays
        The arrays that `tabulate` returns for the scenario and a codebook.

    Attributes
    ----------
    points
        Grid (r [m], u, v), float64 [G, 3].
    range_offsets_m
        Fine range steps, relative to the range of a grid point, float64 [D] [m].
    normal
        Points that represent a standard Gaussian, float64 [128, 3].
    """

    def __init__(self, scenario: Scenario, arrays: Mapping[str, np.ndarray]) -> None:
        self.points, self.normal = arrays['points'], arrays['normal']
        self._filters, self._slope_filters = arrays['filters'], arrays['slope_filters']
        self._energy, self._energy_slope = arrays['energy'], arrays['energy_slope']
        self._curvature = arrays['curvature'] + np.diag(MIN_CURVATURE)
        self._inverse = np.linalg.inv(self._curvature)
        self._bounds = scenario.roi_bounds_m
        self._wavelength_m = SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz)
        self._wavenumbers = carrier_wavenumbers(scenario)
        n_fine = int(np.ceil(RANGE_CELL_M / self._wavelength_m * STEPS_PER_WAVELENGTH))
        self.range_offsets_m = ((np.arange(n_fine) + 0.5) / n_fine - 0.5) * RANGE_CELL_M
        self._carrier = np.exp(
            1j * self._wavenumbers[:, None] * self.points[:, 0]).astype(np.complex64)
        phase = np.exp(1j * self._wavenumbers * self.range_offsets_m[:, None])
        self._rotation = (2 * np.hstack([phase.real, -phase.imag])).astype(np.float32)
        self._fine = np.ascontiguousarray(phase.T.astype(np.complex64))

    @property
    def energy(self) -> np.ndarray:
        """Energy of the templates, float32 [G]."""
        return self._energy

    @property
    def wavelength_m(self) -> float:
        """Shortest wavelength of the bands' centres [m]."""
        return self._wavelength_m

    @property
    def filters(self) -> np.ndarray:
        """Conjugate templates without their carrier, complex64 [N_B, G, N_SB F]."""
        return self._filters

    def band_outputs(self, whitened: np.ndarray) -> np.ndarray:
        """Compute the outputs of the matched filters at the grid points, complex64 [N_B, G].

        The whitened signals are those of one positioning phase, complex128 [N_B, N_SB F].
        """
        filtered = np.matmul(self._filters, whitened.astype(np.complex64)[..., None])[..., 0]
        filtered *= self._carrier
        outputs: np.ndarray = filtered
        return outputs

    def rotations(self, offsets_m: np.ndarray) -> np.ndarray:
        """Compute the rotations of the outputs over range offsets [D] [m], complex64 [N_B, D]."""
        rotations: np.ndarray = np.exp(
            1j * self._wavenumbers[:, None] * offsets_m).astype(np.complex64)
        return rotations

    def log_likelihood(self, whitened: np.ndarray) -> np.ndarray:
        """Compute the log-likelihood on the fine grid, up to a constant, float32 [G, D].

        The whitened signals are those of one positioning phase, complex128 [N_B, N_SB F].
        """
        filtered = self.band_outputs(whitened)
        result: np.ndarray = self._rotation @ np.concatenate([filtered.real, filtered.imag])
        result -= self._energy
        return np.transpose(result)

    def modes(self, whitened: np.ndarray, max_modes: int, margin: float) -> np.ndarray:
        """Find the most likely separate modes, to the accuracy of one Gauss-Newton step.

        The whitened signals are those of one positioning phase, complex128 [N_B, N_SB F]. The
        log-likelihood of a mode may be lower than the best by up to `margin` plus the error of
        the grid. The result is (r [m], u, v), float64 [M, 3], the most likely first, with
        1 <= M <= max_modes.
        """
        return self.modes_of_each(whitened[None], max_modes, margin)[1]

    def modes_of_each(
            self, whitened: np.ndarray, max_modes: int, margin: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find the `modes` of many phases, complex128 [N, N_B, N_SB F].

        Those of a phase do not depend on the other phases.

        Returns
        -------
        tuple of numpy.ndarray
            The phase of each mode, int [M], ascending, and the modes, float64 [M, 3].
        """
        starts = range(0, len(whitened), _BLOCK)
        found = [self._modes_of_block(whitened[start:start + _BLOCK], max_modes, margin)
                 for start in starts]
        if len(found) == 1:
            return found[0]
        phases = [start + phase for start, (phase, _) in zip(starts, found, strict=True)]
        return np.concatenate(phases), np.concatenate([points for _, points in found])

    def _modes_of_block(
            self, whitened: np.ndarray, max_modes: int, margin: float
    ) -> tuple[np.ndarray, np.ndarray]:
        signals = whitened.astype(np.complex64)
        cells, outputs = self._best_cells(signals)
        index, fine, value = self._peaks_of_each(cells, outputs)
        cell = np.take_along_axis(cells, index, axis=1)
        # One Gauss-Newton step from each peak: between grid points, a sharp mode is much higher.
        slopes = self._products(self._slope_filters, cells, signals)
        phase = np.moveaxis(self._carrier[:, cell] * self._fine[:, fine], 0, 1)
        slopes = np.take_along_axis(slopes, index[:, None, :, None], axis=2)
        gradient = 2 * np.sum(slopes * phase[..., None], axis=1).real - self._energy_slope[cell]
        step = np.einsum('npij,npj->npi', self._inverse[cell], gradient)
        value = value + np.sum(gradient * step, axis=2) / 2
        points = self.points[cell] + np.clip(step, -_STEP_LIMITS, _STEP_LIMITS)
        points[..., 0] += self.range_offsets_m[fine]
        value -= self._loss_outside(points, cell, value, margin)
        order = np.argsort(-value, axis=1)
        value, rows = np.take_along_axis(value, order, axis=1), np.arange(len(value))[:, None]
        margins = margin + _GRID_ERROR * self._energy[cell[rows, order[:, :1]]]
        points = points[rows, order]
        scale = np.array(_MIN_SEPARATION) * (self._wavelength_m, 1, 1)
        phases, chosen = separate_each(points / scale, value >= value[:, :1] - margins, max_modes)
        return phases, points[phases, chosen]

    def _best_cells(self, signals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Grid points with the highest bounds of the log-likelihood, and the outputs there.

        Takes complex64 [N, N_B, N_SB F]; returns int [N, C] and complex64 [N, N_B, C].
        """
        outputs = np.matmul(np.swapaxes(signals, 0, 1), np.swapaxes(self._filters, 1, 2))
        # Along the range, the log-likelihood is at most that of outputs in phase.
        highest = np.abs(outputs).sum(axis=0)
        highest *= 2
        highest -= self._energy
        n_cells = min(_MAX_CELLS, highest.shape[1])
        cells = np.sort(np.argpartition(highest, -n_cells, axis=1)[:, -n_cells:], axis=1)
        # Products of equal sizes round the same, whatever the number of phases.
        products = self._products(self._filters[:, :, None], cells, signals)[..., 0]
        return cells, products * np.moveaxis(self._carrier[:, cells], 0, 1)

    def _products(
            self, filters: np.ndarray, cells: np.ndarray, signals: np.ndarray) -> np.ndarray:
        """Products of filters [N_B, G, Q, N_SB F] with signals, complex64 [N, N_B, C, Q]."""
        (n, n_cells), (n_bands, _, *shape) = cells.shape, filters.shape
        products = np.empty((n, n_bands, n_cells * shape[0], 1), np.complex64)
        # One buffer for all phases remains in the cache.
        gathered = np.empty((n_bands, n_cells, *shape), np.complex64)
        rows = gathered.reshape(n_bands, -1, shape[1])
        for chosen, phase, result in zip(cells, signals[..., None], products, strict=True):
            for band, target in enumerate(gathered):
                # The mode without checks needs no copy of the result.
                filters[band].take(chosen, axis=0, out=target, mode='clip')
            np.matmul(rows, phase, out=result)
        return products.reshape(n, n_bands, n_cells, -1)

    def _peaks_of_each(
            self, cells: np.ndarray, outputs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the highest peaks along the range among the grid points of each phase.

        Returns the indices of the grid point in `cells` and of the range step, int [N, P], and
        the value, float32 [N, P], which is -inf where there is no further peak.
        """
        likelihood = np.matmul(
            self._rotation, np.concatenate([outputs.real, outputs.imag], axis=1))
        likelihood -= self._energy[cells][:, None]
        rising = likelihood[:, 1:] >= likelihood[:, :-1]
        falling = likelihood[:, 1:] <= likelihood[:, :-1]
        peak = np.ones(likelihood.shape, bool)
        peak[:, 1:] &= rising
        peak[:, :-1] &= falling
        place = np.zeros((len(cells), _MAX_PEAKS), int)
        value = np.full(place.shape, -np.inf, np.float32)
        for row, (peaks, flat) in enumerate(zip(
                peak.reshape(len(cells), -1), likelihood.reshape(len(cells), -1), strict=True)):
            found = np.flatnonzero(peaks)
            if len(found) > _MAX_PEAKS:
                found = found[np.sort(np.argpartition(flat[found], -_MAX_PEAKS)[-_MAX_PEAKS:])]
            place[row, :len(found)] = found
            value[row, :len(found)] = flat[found]
        fine, index = np.divmod(place, cells.shape[1])
        return index, fine, value

    def peaks_under(self, whitened: np.ndarray, factor: np.ndarray, max_points: int) -> np.ndarray:
        """Find the highest separate points of the grid for another covariance of the signals.

        Parameters
        ----------
        whitened
            Signals of one positioning phase, whitened as the templates, complex128
            [N_B, N_SB F].
        factor
            F of the inverse F F^H of the other covariance after this whitening, complex128
            [N_B, N_SB F, N_SB F].

        Returns
        -------
        numpy.ndarray
            Points (r [m], u, v), the most likely first, float64 [P, 3].
        """
        turned = np.matmul(self._filters, factor.astype(np.complex64))
        signals = np.einsum('bsr,bs->br', factor.conj(), whitened).astype(np.complex64)
        filtered = np.matmul(turned, signals[..., None])[..., 0] * self._carrier
        likelihood = self._rotation @ np.concatenate([filtered.real, filtered.imag])
        likelihood -= np.sum(turned.real**2 + turned.imag**2, axis=(0, 2))
        cell, offset_m, value = self._peaks(np.transpose(likelihood))
        order = np.argsort(-value)
        points = self.points[cell[order]]
        points[:, 0] += offset_m[order]
        scale = np.array(_MIN_SEPARATION) * (self._wavelength_m, 1, 1)
        chosen: np.ndarray = points[separate(points / scale, max_points)]
        return chosen

    def _loss_outside(self, points: np.ndarray, cell: np.ndarray, value: np.ndarray,
                      margin: float) -> np.ndarray:
        """Loss of log-likelihood from points to the region, [N, P]: 0 inside.

        The loss is infinite for points that are too unlikely even without it.
        """
        inside = is_inside(to_positions(points), self._bounds)
        result = np.where(inside, 0.0, np.inf)
        values = np.where(inside, value, -np.inf)
        best, rows = values.argmax(axis=1)[:, None], np.arange(len(cell))[:, None]
        limit = values[rows, best] - margin - _GRID_ERROR * self._energy[cell[rows, best]]
        outside = ~inside & (value >= limit)
        if outside.any():
            curvature = self._curvature[cell[outside]]
            offset = offset_to_roi(points[outside], curvature, self._bounds)
            result[outside] = likelihood_loss(offset, curvature)
        return result

    def _peaks(self, likelihood: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Grid point, range offset and value of the highest peaks along the range."""
        highest = likelihood.max(axis=1)
        cells = np.arange(len(highest))
        if len(cells) > _MAX_CELLS:
            cells = np.argpartition(highest, -_MAX_CELLS)[-_MAX_CELLS:]
        rows = likelihood[cells]
        rising = rows[:, 1:] >= rows[:, :-1]
        falling = rows[:, 1:] <= rows[:, :-1]
        peak = np.ones(rows.shape, bool)
        peak[:, 1:] &= rising
        peak[:, :-1] &= falling
        row, fine = np.nonzero(peak)
        value = rows[row, fine]
        if len(value) > _MAX_PEAKS:
            best = np.argpartition(value, -_MAX_PEAKS)[-_MAX_PEAKS:]
            row, fine, value = row[best], fine[best], value[best]
        return cells[row], self.range_offsets_m[fine], value
