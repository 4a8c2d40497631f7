"""Templates of the mean signals, and their energies and derivatives in the cells of the grid.

A template is a mean signal times the range, without the carriers of its sub-bands: exp(i k_n r) r
mu_n(p). It changes with the direction at the resolution of the aperture, but with the range only
through the curvature of the wavefront, so many ranges share one template.
"""

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import adjoint, multiply_rows, read_only
from rhs_isac_ros.model.gaussian import marginalise, quadratic_form
from rhs_isac_ros.model.geometry import to_positions, velocity_std_mps
from rhs_isac_ros.positioning.lattice import (
    PHASE_ERROR,
    Expansion,
    Grid,
    Resolution,
    lay_grid,
    whiten,
)
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.segments import Segments
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.threads import map_blocks

# Number of points that represent a standard Gaussian.
N_NORMAL = 128
# Number of templates computed at a time.
_BLOCK = 128
# Number of positions in the second moments of the means in a part of the region.
_PART_MOMENTS = 32
# Largest mean energy of a component of the whitened signals. The error of a template is about
# `PHASE_ERROR` times its amplitude. With this limit, it does not exceed the noise.
_ENERGY = 1 / PHASE_ERROR**2
# Error within a range bin, as a share of the energy of the template.
_ERROR = 0.015
# Smallest information about a parameter.
_LEAST = 1e-9


def tabulate(model: MeasurementModel, progress: Callable[[float], None] | None = None,
             grid: Grid | None = None, prior: NuisancePrior | None = None
             ) -> dict[str, np.ndarray]:
    """Compute the arrays of a `TemplateTable`, for G templates and C cells.

    The table covers a grid, by default that of the region, and has the nuisance parameters of a
    prior, by default that of the model. The arrays are ``filters``, the conjugate templates,
    complex64 [N_B, N_SB, G, F]; ``slope_filters``, their derivatives with respect to (r [m], u,
    v), complex64 [N_B, N_SB, G, 3, F]; ``energy`` of the whitened means, float32 [C];
    ``energy_slope``, its derivative, float32 [C, 3]; ``template_energy`` and ``error``, energies
    of the whitened templates and of their differences from the means, float32 [C]; ``curvature``
    of the log-likelihood, float64 [C, 3, 3]; ``marginal``, the curvature with the Q nuisance
    parameters that fit best, float64 [C, 3, 3], and ``regression``, the derivatives of these,
    float64 [C, Q, 3]; ``spread``, the mean of the outer products of the whitened means,
    ``limiter``, which multiplies whitened signals, and ``whitener``, which whitens and limits
    signals, complex128 [N_B, N_SB F, N_SB F]; and ``normal``, points that represent a standard
    Gaussian, float64 [128, 3]. Energies and derivatives are those of limited means.
    """
    part, grid = grid, grid or lay_grid(model.scenario)
    points, (n_bands, n_rows) = grid.points, model.shape
    n_subbands = model.scenario.n_subbands
    n_frames, n_cells = n_rows // n_subbands, len(grid.node)
    shape = n_bands, n_subbands, len(grid.nodes)
    prior = NuisancePrior(model) if prior is None else prior
    table: dict[str, np.ndarray] = {
        'filters': np.empty((*shape, n_frames), np.complex64),
        'slope_filters': np.empty((*shape, 3, n_frames), np.complex64),
        'energy': np.empty(n_cells, np.float32),
        'energy_slope': np.empty((n_cells, 3), np.float32),
        'template_energy': np.empty(n_cells, np.float32),
        'error': np.empty(n_cells, np.float32),
        'curvature': np.empty((n_cells, 3, 3)),
        'marginal': np.empty((n_cells, 3, 3)),
        'regression': np.empty((n_cells, len(prior), 3)),
        'normal': standard_normal(N_NORMAL),
    }
    positions, std = _positions_in(model.scenario, part), velocity_std_mps(model.scenario)
    if std.any():
        rng = np.random.default_rng(0)
        positions = np.hstack([positions, std * rng.standard_normal(positions.shape)])
    table['spread'], table['limiter'] = _moments(model, positions)
    table['whitener'] = np.matmul(table['limiter'], model.whitener)
    by_node = np.argsort(grid.node, kind='stable')
    of_node = Segments.of_counts(np.bincount(grid.node, minlength=len(grid.nodes)))

    def fill(start: int) -> None:
        nodes = slice(start, min(start + _BLOCK, len(grid.nodes)))
        expansion = Expansion.of(model, grid.nodes[nodes])
        by_frame = expansion.mean.conj().reshape(-1, n_bands, n_subbands, n_frames)
        table['filters'][:, :, nodes] = np.moveaxis(by_frame, 0, 2)
        by_frame = expansion.slopes.conj().reshape(-1, 3, n_bands, n_subbands, n_frames)
        table['slope_filters'][:, :, nodes] = np.moveaxis(by_frame, (0, 1), (2, 3))
        first, n = of_node.starts[start], of_node.counts[nodes].sum()
        for cells in np.array_split(by_node[first:first + n], -(-n // _BLOCK)):
            of_cells = _of_cells(
                expansion, table['whitener'], grid.node[cells] - start, points[cells], prior)
            for name, values in of_cells.items():
                table[name][cells] = values

    map_blocks(fill, range(0, len(grid.nodes), _BLOCK), progress)
    return table


def _of_cells(expansion: Expansion, whitener: np.ndarray, index: np.ndarray, points: np.ndarray,
              prior: NuisancePrior) -> dict[str, np.ndarray]:
    """Compute arrays of `tabulate` for cells with the templates `index` [M] and centres [M, 3]."""
    mean, slopes = expansion.at(index, points)
    white = whiten(whitener, mean, np.concatenate(
        [slopes, prior.scaled_patterns * mean[:, None]], axis=1))
    template = whiten(whitener, expansion.template_at(index, points[:, 0]))
    # Products of the means, in the first row and column, and of their derivatives.
    form = quadratic_form(white.reshape(len(points), 4 + len(prior), -1))
    information = form[:, 1:, 1:].copy()
    information[:, 3:, 3:] += prior.information + np.diag(prior.precision + _LEAST)
    marginal = marginalise(information, np.zeros(information.shape[:2]))
    return {
        'template_energy': np.sum(np.abs(template)**2, axis=(1, 2, 3)),
        'error': np.sum(np.abs(template - white[:, :1])**2, axis=(1, 2, 3)),
        'energy': form[:, 0, 0] / 2,
        'energy_slope': form[:, 0, 1:4],
        'curvature': form[:, 1:4, 1:4],
        'marginal': marginal.information,
        'regression': marginal.regression,
    }


def _positions_in(scenario: Scenario, part: Grid | None) -> np.ndarray:
    """Return evenly spread positions in the region, or in the box of a part of its grid."""
    low, high = scenario.roi_bounds_m
    if part is None:
        return low + (high - low) * streams.unit_points()
    centres = to_positions(part.points)
    low, high = (np.clip(edge, low, high) for edge in (centres.min(axis=0), centres.max(axis=0)))
    return low + (high - low) * streams.unit_points()[:_PART_MOMENTS]


def _moments(model: MeasurementModel, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `spread` and `limiter` of `tabulate`.

    Where sub-bands fade alike, the energy of some components of whitened signals is so large that
    errors of templates in them outweigh all else. The limiter scales such a component to a mean
    energy of `_ENERGY`. For the limiter, stronger signals are scaled down to the median
    energy.
    """
    white = np.matmul(
        np.moveaxis(model.mean(positions), 1, 0), np.swapaxes(model.whitener, 1, 2))
    energy = np.sum(np.abs(white)**2, axis=(0, 2))
    shares = np.minimum(np.median(energy) / np.maximum(energy, np.finfo(float).tiny), 1.0)
    spread, typical = (np.matmul(np.swapaxes(white * weights[:, None], 1, 2), white.conj())
                       / len(positions) for weights in (np.ones(len(positions)), shares))
    energies, components = np.linalg.eigh(typical)
    scale = 1 / np.sqrt(np.maximum(energies / _ENERGY, 1.0)) - 1
    limiter = np.eye(spread.shape[1]) + np.matmul(
        components * scale[:, None], adjoint(components))
    return spread, limiter


@functools.cache
def standard_normal(n: int, size: int = 3) -> np.ndarray:
    """Return points that represent a Gaussian, float64 [n, size]; n is 1, 2, 4, ..., or 1024.

    The array is read-only.
    """
    # The points are kept with the table because these imports take longer than loading a table.
    from scipy.special import ndtri

    return read_only(ndtri(np.clip(streams.unit_points(size)[:n], 1e-6, 1 - 1e-6)))


class Filters(NamedTuple):
    """Matched filters for the G templates; the fields are arrays of `tabulate`."""

    templates: np.ndarray
    slopes: np.ndarray
    limiter: np.ndarray
    whitener: np.ndarray

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> 'Filters':
        """Take the filters from the result of `tabulate`."""
        return cls(*(arrays[name] for name in ('filters', 'slope_filters', 'limiter', 'whitener')))

    @property
    def is_exact(self) -> bool:
        """Whether the likelihood is exact, apart from the errors of the templates."""
        return bool((self.limiter == np.eye(self.limiter.shape[1])).all())

    def apply(self, whitened: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Filter the whitened signals of N shots, complex128 [N, N_B, N_SB F].

        Returns signals weighted with the inverse covariance, complex64 [N, N_B, N_SB, F]; filter
        outputs, complex64 [N, N_B, N_SB, G]; and energies of limited signals, float64 [N].
        """
        limited = whitened if self.is_exact else multiply_rows(self.limiter, whitened)
        weighted = multiply_rows(adjoint(self.whitener), limited)
        n, n_bands = weighted.shape[:2]
        signals = weighted.reshape(n, n_bands, -1, self.templates.shape[3]).astype(np.complex64)
        outputs = multiply_rows(self.templates, signals)
        return signals, outputs, np.sum(np.abs(limited)**2, axis=(1, 2))


class Cells(NamedTuple):
    """Energies of the means and curvatures of the log-likelihood in the C cells.

    Energies are those at the centre of the cell.
    """

    range_m: np.ndarray  # Centre of the range bin, float64 [C] [m].
    template_energy: np.ndarray  # Of the whitened template, float32 [C].
    energy: np.ndarray  # Of the whitened mean, float32 [C].
    energy_slope: np.ndarray  # Derivative of `energy`, float32 [C, 3].
    # Derivative of r^2 E with respect to the range r, divided by r^2, with E = `energy`,
    # float64 [C].
    along: np.ndarray
    curvature: np.ndarray  # Float64 [C, 3, 3].
    inverse: np.ndarray  # Inverse of `curvature`, float32 [C, 3, 3].
    # Curvature with the parameters that fit best, float64 [C, 3, 3], and their derivatives,
    # [C, Q, 3].
    marginal: np.ndarray
    regression: np.ndarray
    # Largest loss of log-likelihood because the direction lies between those of the grid, or the
    # curvature of the wavefront differs, float64 [C].
    loss: np.ndarray

    @classmethod
    def of(cls, grid: Grid, resolution: Resolution, arrays: Mapping[str, np.ndarray]) -> 'Cells':
        """Take the energies and curvatures from the result of `tabulate`."""
        range_m, energy = grid.ranges_m[grid.range_bin], arrays['energy']
        slope = arrays['energy_slope']
        floor = np.diag(resolution.curvature_floor)
        curvature = arrays['curvature'] + floor
        half = PHASE_ERROR * resolution.direction
        across = np.abs(arrays['curvature'][:, 1:, 1:])
        loss = np.einsum('a,cab,b->c', half, across, half) / 2 + (
            arrays['error'] + _ERROR * energy)
        return cls(
            range_m, arrays['template_energy'], energy, slope, slope[:, 0] + 2 * energy / range_m,
            curvature, np.linalg.inv(curvature).astype(np.float32), arrays['marginal'] + floor,
            arrays['regression'], loss)

    def template_energy_at(self, cells: np.ndarray, range_m: np.ndarray) -> np.ndarray:
        """Return the energies of templates [K] at ranges in their cells, float32 [K]."""
        return self._at(self.template_energy[cells], cells, range_m)

    def energy_at(self, cells: np.ndarray, range_m: np.ndarray) -> np.ndarray:
        """Return the energies of means [K] at ranges in their cells, float32 [K]."""
        return self._at(self.energy[cells], cells, range_m)

    def _at(self, energy: np.ndarray, cells: np.ndarray, range_m: np.ndarray) -> np.ndarray:
        # Apart from its decrease with the squared range, the energy is linear within a cell.
        cell_m = self.range_m[cells]
        change = self.along[cells] * (range_m - cell_m)
        return ((cell_m / range_m)**2 * (energy + change)).astype(np.float32)


class Query(NamedTuple):
    """Signals of N shots, prepared for comparison with the templates of the grid."""

    signals: np.ndarray  # Weighted with the inverse covariance, complex64 [N, N_B, N_SB, F].
    outputs: np.ndarray  # Filter outputs for all templates, complex64 [N, N_B, N_SB, G].
    energies: np.ndarray  # Energies of the limited signals, float64 [N].
    bound: np.ndarray  # Bound of the log-likelihood in each cell, [N, C].
    prior: NuisancePrior
    # Negative logarithm of the share of the posterior that may be left out, [1] or for each cell.
    margin: np.ndarray

    def explained_at_most(self, shots: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """Return the energies of shots [P] without their gains [nepers], float64 [P].

        No position explains more than all of the energy; only approximations seem to.
        """
        return np.exp(-2 * gain) * self.energies[shots]


def turns_at(wavenumbers: np.ndarray, ranges_m: np.ndarray) -> np.ndarray:
    """Return ratios of conjugate means to conjugate templates at ranges, [N_B, N_SB, R]."""
    return np.exp(1j * wavenumbers[..., None] * ranges_m) / ranges_m
