"""The search for modes of the likelihood on a table of templates.

The log-likelihood at range steps that resolve the carrier follows from one complex number a band
and grid point: the fine ranges turn the phase of the matched filter's output.
"""

from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.positioning.polar import to_positions
from rhs_isac_ros.positioning.region import gap_to_region, loss
from rhs_isac_ros.positioning.templates import RANGE_CELL_M, carrier_wavenumbers

# Fine range steps in the shortest wavelength; the posterior needs four or more.
STEPS_PER_WAVELENGTH = 8
# Grid points, and peaks along their range, that the search looks at more closely.
_CELLS = 192
_PEAKS = 256
# Points that are compared with each other at a time.
_BLOCK = 64
# Peaks closer than this in all of (r in wavelengths, u, v) are one mode.
_SEPARATION = (0.3, 0.05, 0.05)
# What the grid may cost a mode's log-likelihood after that step, as a share of its energy.
_ENERGY_SHARE = 0.05
# Curvature of the log-likelihood in (r, u, v) [1/m^2, 1, 1] that is there even where the signals
# tell nothing; a region of interest of any size knows more.
LEAST_CURVATURE = (1e-3, 1e-1, 1e-1)
# A longer step leaves the range within which the linear model holds.
_LONGEST_STEP = np.array([0.02, 0.03, 0.03])


class TemplateTable:
    """Log-likelihood of a whole region, fast.

    Parameters
    ----------
    scenario
        The scenario.
    arrays
        What `tabulate` returns for it and a codebook.

    Attributes
    ----------
    points
        Grid (r [m], u, v), float64 [G, 3].
    range_offsets_m
        Fine ranges around a grid point's, float64 [D] [m].
    normal
        Points that represent a standard Gaussian, float64 [128, 3].
    """

    def __init__(self, scenario: Scenario, arrays: Mapping[str, np.ndarray]) -> None:
        self.points, self.normal = arrays['points'], arrays['normal']
        self._filters, self._slope_filters = arrays['filters'], arrays['slope_filters']
        self._energy, self._energy_slope = arrays['energy'], arrays['energy_slope']
        self._curvature = arrays['curvature'] + np.diag(LEAST_CURVATURE)
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

    def log_likelihood(self, whitened: np.ndarray) -> np.ndarray:
        """Log-likelihood on the fine grid, up to a constant.

        Parameters
        ----------
        whitened
            Whitened signals of one positioning phase, complex128 [N_B, N_SB F].

        Returns
        -------
        numpy.ndarray
            Float32 [G, D].
        """
        filtered = np.matmul(self._filters, whitened.astype(np.complex64)[..., None])[..., 0]
        filtered *= self._carrier
        result = self._rotation @ np.concatenate([filtered.real, filtered.imag])
        result -= self._energy
        return result.T

    def modes(self, whitened: np.ndarray, n_modes: int, depth: float) -> np.ndarray:
        """Find the most likely separate modes, to the accuracy of one Gauss-Newton step.

        Parameters
        ----------
        whitened
            Whitened signals of one positioning phase, complex128 [N_B, N_SB F].
        n_modes
            How many at most.
        depth
            How far below the best log-likelihood a mode may be, besides what the grid costs.

        Returns
        -------
        numpy.ndarray
            (r [m], u, v), float64 [M, 3], the most likely first, 1 <= M <= n_modes.
        """
        cell, offset_m, value = self._peaks(self.log_likelihood(whitened))
        # One Gauss-Newton step from each peak: off the grid, a sharp mode stands much higher.
        phase = np.exp(1j * self._wavenumbers * (self.points[cell, :1] + offset_m[:, None]))
        rotated = (phase[..., None] * whitened).astype(np.complex64).reshape(len(cell), -1)
        slope = np.einsum('cqi,ci->cq', self._slope_filters[cell], rotated).real
        slope = 2 * slope - self._energy_slope[cell]
        step = np.matmul(self._inverse[cell], slope[..., None])[..., 0]
        value = value + np.sum(slope * step, axis=1) / 2
        points = self.points[cell] + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        points[:, 0] += offset_m
        value -= self._loss(points, cell, value, depth)
        order = np.argsort(-value)
        depth += _ENERGY_SHARE * self._energy[cell[order[0]]]
        order = order[value[order] >= value[order[0]] - depth]
        scale = np.array(_SEPARATION) * (self._wavelength_m, 1, 1)
        return points[order][separate(points[order] / scale, n_modes)]

    def _loss(self, points: np.ndarray, cell: np.ndarray, value: np.ndarray,
              depth: float) -> np.ndarray:
        """What points lose outside the region: [C]; infinite where they do not count anyway."""
        low, high = self._bounds
        positions = to_positions(points)
        inside = ((positions >= low) & (positions <= high)).all(axis=1)
        result = np.where(inside, 0.0, np.inf)
        best = np.max(value, where=inside, initial=-np.inf)
        depth += _ENERGY_SHARE * self._energy[cell[np.argmax(np.where(inside, value, -np.inf))]]
        (outside,) = np.nonzero(~inside & (value >= best - depth))
        if len(outside):
            curvature = self._curvature[cell[outside]]
            gap = gap_to_region(points[outside], curvature, self._bounds)
            result[outside] = loss(gap, curvature)
        return result

    def _peaks(self, likelihood: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Grid point, range offset and value of the highest peaks along the range."""
        highest = likelihood.max(axis=1)
        cells = np.arange(len(highest))
        if len(cells) > _CELLS:
            cells = np.argpartition(highest, -_CELLS)[-_CELLS:]
        rows = likelihood[cells]
        rising = rows[:, 1:] >= rows[:, :-1]
        falling = rows[:, 1:] <= rows[:, :-1]
        peak = np.ones(rows.shape, bool)
        peak[:, 1:] &= rising
        peak[:, :-1] &= falling
        row, fine = np.nonzero(peak)
        value = rows[row, fine]
        if len(value) > _PEAKS:
            best = np.argpartition(value, -_PEAKS)[-_PEAKS:]
            row, fine, value = row[best], fine[best], value[best]
        return cells[row], self.range_offsets_m[fine], value


def separate(points: np.ndarray, n_most: int) -> list[int]:
    """Choose points, first come first served, that lie apart from each other.

    Parameters
    ----------
    points
        Points in units of the separation, float64 [N, D].
    n_most
        How many at most.

    Returns
    -------
    list of int
        Indices of points that lie no nearer than 1 in all coordinates to an earlier one.
    """
    kept: list[int] = []
    for start in range(0, len(points), _BLOCK):
        block = np.arange(start, min(start + _BLOCK, len(points)))
        block = block[~_near(points[block], points[kept]).any(axis=1)]
        near = _near(points[block], points[block])
        free = np.ones(len(block), bool)
        for row, index in enumerate(block.tolist()):
            if free[row]:
                kept.append(index)
                free &= ~near[row]
        if len(kept) >= n_most:
            break
    return kept[:n_most]


def _near(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Tell which points are nearer than 1 in all coordinates: [N, M]."""
    return (np.abs(points[:, None] - others) < 1).all(axis=2)
