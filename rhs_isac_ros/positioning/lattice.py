"""The lengths over which signals from the region differ, and the grid that follows from them.

The lengths follow from wavelength, aperture, bandwidth and region. The grid of the search is as
coarse as they permit. The cells of a template share one expansion of the mean signals.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, MeasurementModel, Scenario
from rhs_isac_ros.model.geometry import (
    element_positions,
    polar_bounds,
    subband_frequencies_hz,
)
from rhs_isac_ros.positioning.coordinates import jacobian, to_positions

# Largest sine of the angle from boresight on the grid; at 1, derivatives are infinite.
_MAX_SINE = 0.995
# Distance in range up to which a point counts as inside the region, in wavelengths.
_TOLERANCE_WAVELENGTHS = 0.2
# Longest steps for which the linear model of the mean holds, in wavelengths and in radians at the
# edge of the aperture.
_STEP_WAVELENGTHS = 0.2
_STEP_RAD = 0.5
# Phase error of a template at the edge of the aperture or of the band [rad], and error of its
# amplitude, at which the next template or range cell takes over. The slopes of the templates
# correct both errors to first order.
PHASE_ERROR = 0.2
_AMPLITUDE_ERROR = 0.05
# Radii of an ellipsoid around a mode that contains no other mode, in wavelengths and radians.
_SEPARATION_WAVELENGTHS = 0.37
_SEPARATION_RAD = 0.57
# Steps and radii in range, in cells, if the phases of the bands do not constrain the range.
_COARSE_CELLS = 0.75
# Largest value of `Resolution.direction`. It applies to apertures below one wavelength, where
# the gains of elements and of the user also change with the direction.
_MAX_DIRECTION = 0.4
# Smallest thickness of the region, in wavelengths.
_MIN_THICKNESS = 0.2
# Smallest range relative to the farthest one, because directions lose their meaning at the
# surface.
_MIN_RANGE = 1e-3
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
    directions: np.ndarray  # Extent of the region in u and in v, float64 [2, 2].
    # Lower and upper vertex of the region, float64 [2, 3]. A flat region is a fraction of a
    # wavelength thick, so that samples of a posterior can be inside.
    bounds_m: np.ndarray

    @classmethod
    @functools.lru_cache(maxsize=16)
    def of(cls, scenario: Scenario) -> 'Resolution':
        """Derive the lengths from a scenario."""
        elements = element_positions(scenario)
        wavenumber = subband_wavenumbers(scenario).max()
        wavelength_m = SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz)
        thickness_m, center = _MIN_THICKNESS * wavelength_m, np.array(scenario.roi_center_m)
        thick = np.stack([center - thickness_m / 2, center + thickness_m / 2])
        bounds = np.where(
            np.array(scenario.roi_size_m) < thickness_m, thick, scenario.roi_bounds_m)
        (nearest_m, *lowest), (farthest_m, *highest) = polar_bounds(bounds).tolist()
        return cls(
            wavelength_m,
            1 / np.maximum(wavenumber * np.abs(elements[:, 1:]).max(axis=0), 1 / _MAX_DIRECTION),
            max(wavenumber * np.sum(elements**2, axis=1).max() / 2, 1e-9),
            SPEED_OF_LIGHT_MPS / (np.pi * scenario.n_subbands * scenario.subband_width_hz),
            max(nearest_m, _MIN_RANGE * farthest_m), farthest_m,
            np.stack([lowest, highest], axis=1), bounds)

    @property
    def volume_m3(self) -> float:
        """Volume of the region between the bounds."""
        return float(np.prod(self.bounds_m[1] - self.bounds_m[0]))

    def cell_width_m(self, range_m: float) -> float:
        """Return the width of a range cell, in which delays and amplitudes hardly change [m]."""
        return min(2 * _AMPLITUDE_ERROR * range_m, 2 * PHASE_ERROR * self.delay_m)

    def step_limits(self, is_coarse: bool) -> np.ndarray:
        """Return the longest steps in (r [m], u, v) over which the mean is nearly linear, [3]."""
        return self._radii(is_coarse, _STEP_WAVELENGTHS, _STEP_RAD)

    def separation(self, is_coarse: bool) -> np.ndarray:
        """Return the radii in (r [m], u, v) of an ellipsoid that contains only one mode, [3]."""
        return self._radii(is_coarse, _SEPARATION_WAVELENGTHS, _SEPARATION_RAD)

    def _radii(self, is_coarse: bool, wavelengths: float, radians: float) -> np.ndarray:
        range_m = (_COARSE_CELLS * self.cell_width_m(self.nearest_m) if is_coarse
                   else wavelengths * self.wavelength_m)
        return np.array([range_m, *radians * self.direction])

    @property
    def curvature_floor(self) -> np.ndarray:
        """Curvature in (r, u, v) that is added to every log-likelihood, [3]."""
        extent = np.array([self.farthest_m - self.nearest_m,
                           *(self.directions[:, 1] - self.directions[:, 0])])
        return 12 * _FLOOR / np.maximum(
            extent, _MIN_RANGE * np.array([self.farthest_m, 1.0, 1.0]))**2

    @property
    def tolerance_m(self) -> float:
        """Distance in range up to which a point counts as inside the region."""
        return _TOLERANCE_WAVELENGTHS * self.wavelength_m


def subband_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Return the wavenumbers k_n of the sub-bands, float64 [N_B, N_SB] [1/m]."""
    return 2 * np.pi * subband_frequencies_hz(scenario) / SPEED_OF_LIGHT_MPS


class Grid(NamedTuple):
    """Templates and range cells that cover the ranges and directions of the region."""

    nodes: np.ndarray  # Points (r [m], u, v) of the templates, float64 [G, 3].
    ranges_m: np.ndarray  # Centres of the range cells, float64 [R].
    widths_m: np.ndarray
    node: np.ndarray  # Index of the template of each pair in the grid, int [C].
    cell: np.ndarray  # Index of the range cell of each pair, int [C].
    # Slices of templates, range cells and pairs, one segment for each range of the templates. The
    # pairs of a segment are a subset of all combinations of its templates and range cells.
    segments: list[tuple[slice, slice, slice]]

    @property
    def points(self) -> np.ndarray:
        """Centres of all pairs of template and range cell, (r [m], u, v), float64 [C, 3]."""
        points: np.ndarray = self.nodes[self.node]
        points[:, 0] = self.ranges_m[self.cell]
        return points


def lay_grid(scenario: Scenario) -> Grid:
    """Cover the region of interest with a grid."""
    resolution = Resolution.of(scenario)
    # Modes slightly outside of the region extend into it.
    beyond_m = resolution.wavelength_m / 2
    edges = [max(resolution.nearest_m - beyond_m, resolution.nearest_m / 2)]
    while edges[-1] < resolution.farthest_m + beyond_m:
        edges.append(edges[-1] + resolution.cell_width_m(edges[-1]))
    edges_m = np.array(edges)
    ranges_m, widths_m = (edges_m[1:] + edges_m[:-1]) / 2, np.diff(edges_m)
    steps = 2 * PHASE_ERROR * resolution.direction
    low, high = resolution.bounds_m
    lines = [np.arange(np.floor(first / step), np.ceil(last / step) + 1) * step
             for (first, last), step in zip(resolution.directions, steps, strict=True)]
    directions = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 2)
    # Directions slightly beyond the rim of the half space are moved onto it.
    excess = np.maximum(np.hypot(*directions.T) / _MAX_SINE, 1.0)
    directions = (directions / excess[:, None])[excess < 1 + 2 * steps.max()]
    halves = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing='ij'), axis=-1).reshape(-1, 3)
    nodes, node, cell, segments, n_nodes, n_pairs = [], [], [], [], 0, 0
    inverse_step = 2 * PHASE_ERROR / resolution.curvature_m
    for first, last in groups(len(ranges_m), lambda first, end: bool(
            1 / edges_m[first] - 1 / edges_m[end] <= inverse_step)):
        inside = []
        for index in range(first, last):
            centres = np.insert(directions, 0, ranges_m[index], axis=1)
            # A cell belongs to the grid if the bounding box of its vertices meets the region.
            vertices = to_positions(
                centres[:, None] + halves * np.array([widths_m[index], *steps]))
            inside.append(((vertices.max(axis=1) >= low) & (vertices.min(axis=1) <= high)
                           ).all(axis=1))
        used = np.flatnonzero(np.any(inside, axis=0))
        range_m = 2 / (1 / edges_m[first] + 1 / edges_m[last])
        nodes.append(np.insert(directions[used], 0, range_m, axis=1))
        which, direction = np.nonzero(np.array(inside)[:, used])
        node.append(direction + n_nodes)
        cell.append(which + first)
        segments.append((slice(n_nodes, n_nodes + len(used)), slice(first, last),
                         slice(n_pairs, n_pairs + len(which))))
        n_nodes, n_pairs = n_nodes + len(used), n_pairs + len(which)
    return Grid(np.concatenate(nodes), ranges_m, widths_m, np.concatenate(node),
                np.concatenate(cell), segments)


def groups(n: int, fits: Callable[[int, int], bool]) -> list[tuple[int, int]]:
    """Divide n items into groups (first, end), each as long as `fits` allows, or of one item."""
    result, first = [], 0
    for end in range(1, n + 1):
        if end == n or not fits(first, end + 1):
            result.append((first, end))
            first = end
    return result


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


def whiten(model: MeasurementModel, mean: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Whiten both results of `Expansion.at`; return one array, complex128 [M, 4, N_B, N_SB F]."""
    n_bands, n_rows = model.shape
    columns = np.moveaxis(np.concatenate([mean[:, None], slopes], axis=1), 2, 0)
    white = np.matmul(columns.reshape(n_bands, -1, n_rows), np.swapaxes(model.whitener, 1, 2))
    return np.moveaxis(white.reshape(n_bands, len(mean), 4, n_rows), 0, 2)
