"""The lengths over which signals from the region differ, and the grid that follows from them.

The lengths follow from wavelength, aperture, bandwidth and region. The grid of the search is as
coarse as they permit. A cell is a template in one range bin; the cells of a template share one
expansion of the mean signals.
"""

import functools
import itertools
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import read_only
from rhs_isac_ros.model.geometry import (
    element_positions,
    frame_times_s,
    jacobian,
    polar_bounds,
    subband_frequencies_hz,
    to_positions,
)
from rhs_isac_ros.positioning.segments import Segments

# Phase error of a template at the edge of the aperture or of the band [rad] at which the next
# template or range bin takes over. The slopes of the templates correct the error to first order.
PHASE_ERROR = 0.2
# Error of the amplitude of a template at which the next range bin takes over.
_AMPLITUDE_ERROR = 0.05
# In wavelengths and in radians at the edge of the aperture: longest steps for which the linear
# model of the mean holds, and radii of an ellipsoid around a mode that contains no other mode.
_STEP = 0.2, 0.5
_SEPARATION = 0.37, 0.57
# Range component of both, in range bins, if phases of the bands do not constrain the range.
_COARSE_BINS = 0.75
# Phases by which neighbouring hypotheses of a rate differ [rad]: of the range at the ends of the
# frames of a band, and of u and v at the edge of the aperture at the ends of the cycle.
_RATE = 1.1, 0.85
# Largest value of `Resolution.direction`. It applies to apertures below one wavelength, where the
# gains of elements and of the user also change with the direction.
_DIRECTION = 0.4
# Largest sine of the angle from boresight on the grid; at 1, derivatives are infinite.
_SINE = 0.995
# Smallest range relative to the farthest one, because directions lose their meaning at the
# surface.
_NEAREST = 1e-3
# Information about the position that is added everywhere, relative to a uniform prior over the
# region. It keeps matrices invertible where the signals contain no information.
_FLOOR = 0.01


class Resolution(NamedTuple):
    """Lengths over which signals from the region of interest change."""

    wavelength_m: float  # Shortest wavelength of the bands' centres.
    # Changes of (u, v) that turn the phase at the edge of the aperture by one radian, [2].
    direction: np.ndarray
    curvature_m: float  # Phase [rad] at a corner of the aperture per change of 1 / r.
    delay_m: float  # Change of the range that turns the edge of a band by 1 rad from its centre.
    nearest_m: float
    farthest_m: float
    direction_bounds: np.ndarray  # Extent of the region in u and in v, float64 [2, 2].
    bounds_m: np.ndarray  # Lower and upper vertex of the region, float64 [2, 3].
    # Changes of the rates of (r [m], u, v) over which the signals of a cycle change, [3] [1/s].
    rate_steps: np.ndarray

    @classmethod
    @functools.lru_cache(maxsize=16)
    def of(cls, scenario: Scenario) -> 'Resolution':
        """Derive the lengths from a scenario."""
        elements = element_positions(scenario)
        wavenumber = subband_wavenumbers(scenario).max()
        # The direction also changes the phases of elements in front of the plane or behind it.
        edge_m = np.abs(elements[:, 1:]).max(axis=0) + np.abs(elements[:, 0]).max()
        bounds = scenario.roi_bounds_m
        direction = 1 / np.maximum(wavenumber * edge_m, 1 / _DIRECTION)
        times_s = frame_times_s(scenario)
        # Even a single frame has a duration. It shows no rate, whose step is then huge.
        half_s = np.array([np.ptp(times_s[0]) + scenario.frame_duration_s,
                           *2 * [np.ptp(times_s) + 2 * scenario.frame_duration_s]]) / 2
        counts = np.array([scenario.n_frames, *2 * [times_s.size]])
        half_s *= np.sqrt(np.maximum(1 - 1 / counts**2, np.finfo(np.float32).tiny))
        (nearest_m, *lowest), (farthest_m, *highest) = polar_bounds(bounds).tolist()
        return cls(
            wavelength_m=SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz),
            direction=direction,
            curvature_m=max(wavenumber * np.sum(elements**2, axis=1).max() / 2, 1e-9),
            delay_m=SPEED_OF_LIGHT_MPS / (np.pi * scenario.bandwidth_hz),
            nearest_m=max(nearest_m, _NEAREST * farthest_m), farthest_m=farthest_m,
            direction_bounds=np.stack([lowest, highest], axis=1), bounds_m=bounds,
            rate_steps=np.append(_RATE[0] / wavenumber, _RATE[1] * direction) / half_s)

    def bin_width_m(self, range_m: float) -> float:
        """Return the width of a range bin, in which delays and amplitudes hardly change [m]."""
        return min(2 * _AMPLITUDE_ERROR * range_m, 2 * PHASE_ERROR * self.delay_m)

    def step_limits(self, is_coarse: bool) -> np.ndarray:
        """Return the longest steps in (r [m], u, v) over which the mean is nearly linear, [3]."""
        return self._radii(is_coarse, *_STEP)

    def separation(self, is_coarse: bool) -> np.ndarray:
        """Return the radii in (r [m], u, v) of an ellipsoid that contains only one mode, [3]."""
        return self._radii(is_coarse, *_SEPARATION)

    def _radii(self, is_coarse: bool, wavelengths: float, radians: float) -> np.ndarray:
        range_m = (_COARSE_BINS * self.bin_width_m(self.nearest_m) if is_coarse
                   else wavelengths * self.wavelength_m)
        radii = np.empty(3)
        radii[0], radii[1:] = range_m, radians * self.direction
        return radii

    @property
    def curvature_floor(self) -> np.ndarray:
        """Curvature in (r, u, v) that is added to every log-likelihood, [3]."""
        extent = np.array([self.farthest_m - self.nearest_m,
                           *(self.direction_bounds[:, 1] - self.direction_bounds[:, 0])])
        return 12 * _FLOOR / np.maximum(
            extent, _NEAREST * np.array([self.farthest_m, 1.0, 1.0]))**2


def carrier_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Return the wavenumbers k_i at the bands' centres, float64 [N_B] [1/m]."""
    return 2 * np.pi * np.array(scenario.center_frequencies_hz) / SPEED_OF_LIGHT_MPS


def subband_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Return the wavenumbers k_n of the sub-bands, float64 [N_B, N_SB] [1/m]."""
    return 2 * np.pi * subband_frequencies_hz(scenario) / SPEED_OF_LIGHT_MPS


class Shell(NamedTuple):
    """Parts of a grid: the templates of one range, and the range bins in which they are used."""

    nodes: slice
    bins: slice
    cells: slice  # A subset of all combinations of these templates and range bins.


class Grid(NamedTuple):
    """Templates and range bins that cover the ranges and directions of the region."""

    nodes: np.ndarray  # Points (r [m], u, v) of the templates, float64 [G, 3].
    ranges_m: np.ndarray  # Centres of the range bins, float64 [R].
    widths_m: np.ndarray
    node: np.ndarray  # Index of the template of each cell, int [C].
    range_bin: np.ndarray  # Index of the range bin of each cell, int [C].
    shells: list[Shell]

    def within(self, chosen: np.ndarray) -> 'Grid':
        """Return the grid of the chosen cells, bool [C], and of the templates that they need."""
        needed = np.zeros(len(self.nodes), bool)
        needed[self.node[chosen]] = True
        n_nodes, n_cells = (np.append(0, np.cumsum(one)) for one in (needed, chosen))
        shells = [Shell(slice(n_nodes[nodes.start], n_nodes[nodes.stop]), bins,
                        slice(n_cells[cells.start], n_cells[cells.stop]))
                  for nodes, bins, cells in self.shells]
        return self._replace(
            nodes=self.nodes[needed], node=n_nodes[self.node[chosen]],
            range_bin=self.range_bin[chosen],
            shells=[one for one in shells if one.nodes.start < one.nodes.stop])

    @property
    def points(self) -> np.ndarray:
        """Centres of all cells, (r [m], u, v), float64 [C, 3]."""
        points: np.ndarray = self.nodes[self.node]
        points[:, 0] = self.ranges_m[self.range_bin]
        return points


@functools.lru_cache(maxsize=16)
def lay_grid(scenario: Scenario) -> Grid:
    """Cover the region of interest with a grid; its arrays are read-only."""
    resolution = Resolution.of(scenario)
    edges_m, directions = _range_edges(resolution), _directions(resolution)
    is_used = _meets_region(resolution, edges_m, directions)
    # The curvature of the wavefront hardly changes across the range bins of a shell.
    step = 2 * PHASE_ERROR / resolution.curvature_m
    bins_of_shell = Segments.as_long_as(
        lambda first, end: bool(1 / edges_m[first] - 1 / edges_m[end] <= step), len(edges_m) - 1)
    n_shells = len(bins_of_shell.starts)
    range_m = 2 / (1 / edges_m[bins_of_shell.starts] + 1 / edges_m[bins_of_shell.ends])
    has_template = bins_of_shell.max(is_used)
    # Index of the node of each shell and direction, where there is one.
    node_at = np.cumsum(has_template).reshape(has_template.shape) - 1
    shell_of_node, node_direction = np.nonzero(has_template)
    nodes = np.column_stack([range_m[shell_of_node], directions[node_direction]])
    range_bin, cell_direction = np.nonzero(is_used)
    shell_of_cell = bins_of_shell.repeat(np.arange(n_shells))[range_bin]
    nodes_of_shell, cells_of_shell = (
        Segments.of_counts(np.bincount(shells, minlength=n_shells))
        for shells in (shell_of_node, shell_of_cell))
    return Grid(
        read_only(nodes), read_only((edges_m[1:] + edges_m[:-1]) / 2), read_only(np.diff(edges_m)),
        read_only(node_at[shell_of_cell, cell_direction]), read_only(range_bin),
        [Shell(*one) for one in zip(
            nodes_of_shell.slices, bins_of_shell.slices, cells_of_shell.slices, strict=True)
         if one[0].start < one[0].stop])


def _range_edges(resolution: Resolution) -> np.ndarray:
    """Return the edges of the range bins, float64 [R + 1] [m]."""
    # Modes slightly outside of the region extend into it.
    beyond_m = resolution.wavelength_m / 2
    edges = [max(resolution.nearest_m - beyond_m, resolution.nearest_m / 2)]
    while edges[-1] < resolution.farthest_m + beyond_m:
        edges.append(edges[-1] + resolution.bin_width_m(edges[-1]))
    return np.array(edges)


def _directions(resolution: Resolution) -> np.ndarray:
    """Return the direction cosines (u, v) of all templates, float64 [V, 2]."""
    steps = 2 * PHASE_ERROR * resolution.direction
    lines = [np.arange(np.floor(first / step), np.ceil(last / step) + 1) * step
             for (first, last), step in zip(resolution.direction_bounds, steps, strict=True)]
    directions = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 2)
    # Directions slightly beyond the rim of the half space are moved onto it.
    excess = np.maximum(np.hypot(*directions.T) / _SINE, 1.0)
    return (directions / excess[:, None])[excess < 1 + 2 * steps.max()]


def _meets_region(
        resolution: Resolution, edges_m: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Mark range bins and directions that may meet the region, bool [R, V].

    They do if the bounding box of the vertices of the cell meets the region.
    """
    low, high = resolution.bounds_m
    sides = np.array([-1.0, 1.0])[:, None] * PHASE_ERROR * resolution.direction
    vertices = np.empty((len(directions), 2, 2, 2, 3))
    vertices[..., 1] = (directions[:, None, 0] + sides[:, 0])[:, None, :, None]
    vertices[..., 2] = (directions[:, None, 1] + sides[:, 1])[:, None, None, :]
    found = np.empty((len(edges_m) - 1, len(directions)), bool)
    for index, ends_m in enumerate(itertools.pairwise(edges_m)):
        vertices[..., 0] = np.reshape(ends_m, (2, 1, 1))
        positions = to_positions(vertices).reshape(len(directions), -1, 3)
        found[index] = ((positions.max(axis=1) >= low) & (positions.min(axis=1) <= high)
                        ).all(axis=1)
    return found


class Expansion(NamedTuple):
    """First-order expansion of the mean signals around n points.

    The factor exp(-i k_n r) / r of a sub-band's mean is exact. The rest changes slowly with the
    direction and with the curvature of the wavefront, 1 / r.
    """

    points: np.ndarray  # (r [m], u, v), float64 [n, 3].
    wavenumbers: np.ndarray  # Of each measurement's carrier, float64 [N_B, N_SB F] [1/m].
    mean: np.ndarray  # Mean signals divided by the factor, complex128 [n, N_B, N_SB F].
    slopes: np.ndarray  # Derivatives of `mean`, complex128 [n, 3, N_B, N_SB F].

    @classmethod
    def of(cls, model: MeasurementModel, points: np.ndarray) -> 'Expansion':
        """Expand the mean signals of a model around points."""
        wavenumbers = subband_wavenumbers(model.scenario)
        wavenumbers = np.repeat(wavenumbers, model.shape[1] // wavenumbers.shape[1], axis=1)
        mean, slopes = model.mean_and_jacobian(to_positions(points), jacobian(points))
        range_m = points[:, :1, None]
        factor = range_m * np.exp(1j * wavenumbers * range_m)
        mean, slopes = mean * factor, slopes * factor[:, None]
        slopes[:, 0] += (1j * wavenumbers + 1 / range_m) * mean
        return cls(points, wavenumbers, mean, slopes)

    def template_at(self, index: np.ndarray, range_m: np.ndarray) -> np.ndarray:
        """Return means without their slow changes, at ranges [M], complex128 [M, N_B, N_SB F]."""
        range_m = range_m[:, None, None]
        factor = np.exp(-1j * self.wavenumbers * range_m) / range_m
        return self.mean[index] * factor

    def at(self, index: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the mean signals at points [M, 3]; `index`, int [M], selects expansions.

        Returns means, complex128 [M, N_B, N_SB F], and derivatives, [M, 3, N_B, N_SB F].
        """
        offset, range_m = points - self.points[index], points[:, :1, None]
        ratio = self.points[index, 0] / points[:, 0]
        offset[:, 0] *= ratio
        slopes = self.slopes[index]
        mean = self.mean[index] + np.matmul(
            offset[:, None], slopes.reshape(len(index), 3, -1)).reshape(-1, *self.mean.shape[1:])
        factor = np.exp(-1j * self.wavenumbers * range_m) / range_m
        mean *= factor
        slopes *= factor[:, None]
        slopes[:, 0] *= ratio[:, None, None]**2
        slopes[:, 0] -= (1j * self.wavenumbers + 1 / range_m) * mean
        return mean, slopes


def whiten(whitener: np.ndarray, mean: np.ndarray, slopes: np.ndarray | None = None) -> np.ndarray:
    """Whiten means [M, N_B, N_SB F], and slopes [M, 3, ...] after them, complex128 [M, C, ...]."""
    columns = mean[:, None]
    if slopes is not None:
        columns = np.concatenate([columns, slopes], axis=1)
    n_columns, n_bands, n_rows = columns.shape[1:]
    columns = np.moveaxis(columns, 2, 0).reshape(n_bands, -1, n_rows)
    white = np.matmul(columns, np.swapaxes(whitener, 1, 2))
    return np.moveaxis(white.reshape(n_bands, len(mean), n_columns, -1), 0, 2)
