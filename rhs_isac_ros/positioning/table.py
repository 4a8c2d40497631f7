"""The search for modes of the likelihood on a table of templates.

The log-likelihood at range steps that resolve the carrier follows from one complex number per
band and grid point: the fine range steps rotate the phase of the matched filter's output.
"""

from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.positioning.polar import to_positions
from rhs_isac_ros.positioning.region import likelihood_loss, offset_to_roi
from rhs_isac_ros.positioning.templates import RANGE_CELL_M, carrier_wavenumbers

# Fine range steps per shortest wavelength; at least four are needed to resolve the posterior.
STEPS_PER_WAVELENGTH = 8
# Number of grid points, and of peaks along their range, that the search examines closely.
_MAX_CELLS = 192
_MAX_PEAKS = 256
# Number of points to compare with each other at a time.
_BLOCK = 64
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
        cell, offset_m, value = self._peaks(self.log_likelihood(whitened))
        # One Gauss-Newton step from each peak: between grid points, a sharp mode is much higher.
        phase = np.exp(1j * self._wavenumbers * (self.points[cell, :1] + offset_m[:, None]))
        rotated = (phase[..., None] * whitened).astype(np.complex64).reshape(len(cell), -1)
        gradient = np.einsum('cqi,ci->cq', self._slope_filters[cell], rotated).real
        gradient = 2 * gradient - self._energy_slope[cell]
        step = np.matmul(self._inverse[cell], gradient[..., None])[..., 0]
        value = value + np.sum(gradient * step, axis=1) / 2
        points = self.points[cell] + np.clip(step, -_STEP_LIMITS, _STEP_LIMITS)
        points[:, 0] += offset_m
        value -= self._loss_outside(points, cell, value, margin)
        order = np.argsort(-value)
        margin += _GRID_ERROR * self._energy[cell[order[0]]]
        order = order[value[order] >= value[order[0]] - margin]
        scale = np.array(_MIN_SEPARATION) * (self._wavelength_m, 1, 1)
        chosen: np.ndarray = points[order][separate(points[order] / scale, max_modes)]
        return chosen

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
        """Loss of log-likelihood from points to the region, [C]: 0 inside.

        The loss is infinite for points that are too unlikely even without it.
        """
        low, high = self._bounds
        positions = to_positions(points)
        inside = ((positions >= low) & (positions <= high)).all(axis=1)
        result = np.where(inside, 0.0, np.inf)
        best = np.max(value, where=inside, initial=-np.inf)
        margin += _GRID_ERROR * self._energy[cell[np.argmax(np.where(inside, value, -np.inf))]]
        (outside,) = np.nonzero(~inside & (value >= best - margin))
        if len(outside):
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


def separate(points: np.ndarray, max_points: int) -> list[int]:
    """Return indices of points that are separate from each other; of close points, the first.

    Points, float64 [N, D], are separate if they are at least 1 apart in some coordinate.
    """
    kept: list[int] = []
    for start in range(0, len(points), _BLOCK):
        block = np.arange(start, min(start + _BLOCK, len(points)))
        block = block[~_close(points[block], points[kept]).any(axis=1)]
        close = _close(points[block], points[block])
        free = np.ones(len(block), bool)
        for row, index in enumerate(block.tolist()):
            if free[row]:
                kept.append(index)
                free &= ~close[row]
        if len(kept) >= max_points:
            break
    return kept[:max_points]


def _close(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return which points are closer than 1 in all coordinates, bool [N, M]."""
    close: np.ndarray = (np.abs(points[:, None] - others) < 1).all(axis=2)
    return close
