"""A table of whitened templates over the region of interest, and the search on it.

The templates' carrier is factored out: exp(i k_i r) t_i(p) changes slowly with the range, so that
a coarse grid holds it, and the log-likelihood at range steps that resolve the carrier follows from
one complex number a band and grid point.
"""

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.region import gap_to_region, loss
from rhs_isac_ros.positioning.whitened import WhitenedModel

RANGE_CELL_M = 0.5
DIRECTION_STEP = 0.025
# Fine range steps in the shortest wavelength; the posterior needs four or more.
STEPS_PER_WAVELENGTH = 8
# Grid points, and peaks along their range, that the search looks at more closely.
_CELLS = 256
_PEAKS = 512
# Peaks closer than this in all of (r in wavelengths, u, v) are one mode.
_SEPARATION = (0.3, 0.05, 0.05)
# What the grid may cost a mode's log-likelihood after that step, as a share of its energy.
_ENERGY_SHARE = 0.05
# Largest sine of the angle from the normal that the grid goes to.
_RIM = 0.995
# Curvature of the log-likelihood in (r, u, v) [1/m^2, 1, 1] that is there even where the signals
# tell nothing; a region of interest of any size knows more.
LEAST_CURVATURE = (1e-3, 1e-1, 1e-1)
# A longer step leaves the range within which the linear model holds.
_LONGEST_STEP = np.array([0.02, 0.03, 0.03])


class TemplateTable:
    """Log-likelihood of a whole region, fast.

    Parameters
    ----------
    model
        The whitened model.

    Attributes
    ----------
    points
        Grid (r [m], u, v), float64 [G, 3].
    range_offsets_m
        Fine ranges around a grid point's, float64 [D] [m].
    """

    def __init__(self, model: WhitenedModel) -> None:
        scenario = model.scenario
        self.points = _grid(scenario)
        centers = np.array(scenario.center_frequencies_hz)
        self._wavenumbers = 2 * np.pi * centers / SPEED_OF_LIGHT_MPS
        self._wavelength_m = SPEED_OF_LIGHT_MPS / centers.max()
        n_fine = int(np.ceil(RANGE_CELL_M / self._wavelength_m * STEPS_PER_WAVELENGTH))
        self.range_offsets_m = ((np.arange(n_fine) + 0.5) / n_fine - 0.5) * RANGE_CELL_M
        parts = [self._tabulate(model, points) for points in np.array_split(
            self.points, max(1, len(self.points) // _CELLS))]
        envelopes, slopes, self._energy, self._energy_slope, curvature = (
            np.concatenate(part) for part in zip(*parts, strict=True))
        self._curvature = curvature + np.diag(LEAST_CURVATURE)
        self._inverse = np.linalg.inv(self._curvature)
        self._bounds = scenario.roi_bounds_m
        # A band in a block, conjugated: what the matched filter multiplies with.
        self._filters = np.ascontiguousarray(np.moveaxis(envelopes.conj(), 1, 0))
        self._slope_filters = slopes.conj()
        carrier = np.exp(1j * self._wavenumbers * self.points[:, :1])
        self._carrier = carrier.astype(np.complex64)
        phase = np.exp(1j * self._wavenumbers[:, None] * self.range_offsets_m)
        self._rotation = (2 * np.concatenate([phase.real, -phase.imag])).astype(np.float32)

    def _tabulate(self, model: WhitenedModel, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Envelopes, their slopes, energies and curvatures at some grid points."""
        mean, by_position = model.mean_and_derivative(to_positions(points))
        slopes = np.einsum('gpq,gpir->gqir', jacobian(points), by_position)
        flat = slopes.reshape(len(points), 3, -1)
        curvature = 2 * np.matmul(flat, np.conj(np.swapaxes(flat, 1, 2))).real
        energy_slope = 2 * np.einsum('gqir,gir->gq', np.conj(slopes), mean).real
        carrier = np.exp(1j * self._wavenumbers * points[:, :1])[..., None]
        return ((mean * carrier).astype(np.complex64),
                (slopes * carrier[:, None]).astype(np.complex64),
                np.sum(np.abs(mean)**2, axis=(1, 2)).astype(np.float32), energy_slope,
                curvature)

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
        signals = whitened.astype(np.complex64)
        filtered = np.stack(
            [block @ y for block, y in zip(self._filters, signals, strict=True)], axis=1)
        filtered *= self._carrier
        # The fine ranges turn the phase of the matched filter's output in every band.
        parts = np.concatenate([filtered.real, filtered.imag], axis=1)
        result = parts @ self._rotation
        result -= self._energy[:, None]
        return result

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
        rotated = (phase[..., None] * whitened).astype(np.complex64)
        slope = np.einsum('cqir,cir->cq', self._slope_filters[cell], rotated).real
        slope = 2 * slope - self._energy_slope[cell]
        step = np.einsum('cpq,cq->cp', self._inverse[cell], slope)
        value = value + np.einsum('cq,cq->c', slope, step) / 2
        points = self.points[cell] + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        points[:, 0] += offset_m
        curvature = self._curvature[cell]
        value -= loss(gap_to_region(points, curvature, self._bounds), curvature)
        order = np.argsort(-value)
        depth += _ENERGY_SHARE * self._energy[cell[order[0]]]
        order = order[value[order] >= value[order[0]] - depth]
        scale = np.array(_SEPARATION) * (self._wavelength_m, 1, 1)
        return points[order][separate(points[order] / scale, n_modes)]

    def _peaks(self, likelihood: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Grid point, range offset and value of the highest peaks along the range."""
        highest = likelihood.max(axis=1)
        cells = np.arange(len(highest))
        if len(cells) > _CELLS:
            cells = np.argpartition(highest, -_CELLS)[-_CELLS:]
        rows = np.pad(likelihood[cells], ((0, 0), (1, 1)), mode='edge')
        inner = rows[:, 1:-1]
        row, fine = np.nonzero((inner >= rows[:, :-2]) & (inner >= rows[:, 2:]))
        value = inner[row, fine]
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
    kept = []
    free = np.arange(len(points))
    while len(free) and len(kept) < n_most:
        best = free[0]
        kept.append(best)
        far = (np.abs(points[free] - points[best]) >= 1).any(axis=1)
        free = free[far]
    return kept


def _grid(scenario: Scenario) -> np.ndarray:
    """Polar grid whose cells cover the region of interest: [G, 3]."""
    low, high = scenario.roi_bounds_m
    axes = [np.linspace(low[u], high[u], 33) for u in range(3)]
    x, y, z = np.meshgrid(*axes, indexing='ij')
    reach = to_polar(np.stack([x, y, z], axis=-1).reshape(-1, 3))
    steps = (RANGE_CELL_M, DIRECTION_STEP, DIRECTION_STEP)
    lines = [np.arange(np.floor(reach[:, a].min() / steps[a]),
                       np.ceil(reach[:, a].max() / steps[a]) + 1) * steps[a] for a in range(3)]
    # No direction belongs to the range 0; its first cell is centred half a step further out.
    lines[0] = np.where(lines[0] > 0, lines[0], RANGE_CELL_M / 4)
    points = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 3)
    # Directions beyond the rim of the half space stand for those just inside it.
    rim = np.maximum(np.hypot(points[:, 1], points[:, 2]) / _RIM, 1.0)
    points = points[rim < 1 + 2 * DIRECTION_STEP]
    points[:, 1:] /= rim[rim < 1 + 2 * DIRECTION_STEP, None]
    # A cell counts if the box around its corners meets the region.
    halves = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing='ij'), axis=-1).reshape(-1, 3)
    corners = to_positions(points[:, None] + halves * steps)
    meets = (corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)
    return points[meets.all(axis=1)]
