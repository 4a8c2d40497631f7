"""The lattice of directions and ranges on which signals from the region differ.

All its lengths follow from wavelength, aperture, bandwidth and region, so that the number of
points is that of distinguishable positions.
"""

import functools
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.model.geometry import element_positions, subband_frequencies_hz
from rhs_isac_ros.positioning.coordinates import to_positions

# Largest sine of the angle from boresight on the grid: directions have no derivative at the rim.
_MAX_SINE = 0.995
# Distance in range below which a point is in the region, in wavelengths.
_TOLERANCE_WAVELENGTHS = 0.2
# The linear model of the mean does not hold beyond these steps, in wavelengths and in radians at
# the edge of the aperture.
_STEP_WAVELENGTHS = 0.2
_STEP_RAD = 0.5
# Phase error of a template at the edge of the aperture or of the band [rad], and error of its
# amplitude, from which another template or range cell takes over. The slopes of the templates
# correct the errors to first order.
PHASE_ERROR = 0.2
_AMPLITUDE_ERROR = 0.05
# Radii of an ellipsoid around a mode that contains no other, in the same units.
_SEPARATION_WAVELENGTHS = 0.37
_SEPARATION_RAD = 0.57
# Steps and radii in range cells if the phases of the bands carry no information about the range.
_COARSE_CELLS = 0.75
# Direction cosines per radian of apertures below a few wavelengths: the gains of elements and of
# the user also change with the direction.
_MAX_DIRECTION = 0.4
# Smallest thickness of the region, in wavelengths.
_MIN_THICKNESS = 0.2
# Smallest range relative to the farthest one: directions lose their meaning at the surface.
_MIN_RANGE = 1e-3
# Information about the position that is added everywhere, relative to that of a uniform prior on
# the region. It keeps matrices regular where the signals contain none.
_FLOOR = 0.01


class Resolution(NamedTuple):
    """Lengths over which signals from the region of interest change.

    Attributes
    ----------
    wavelength_m
        Shortest wavelength of the bands' centres.
    direction
        Changes of (u, v) that turn the phase at the edge of the aperture by one radian, [2].
    curvature_m
        Phase [rad] at the vertex of the aperture per change of the inverse range.
    delay_m
        Change of the range that turns the phase at the edge of a band by one radian.
    nearest_m, farthest_m
        Extent of the region in range.
    directions
        Extent of the region in u and in v, float64 [2, 2].
    bounds_m
        Lower and upper vertex of the region, float64 [2, 3]. A flat region is a fraction of a
        wavelength thick, so that samples of a posterior can be inside.
    """

    wavelength_m: float
    direction: np.ndarray
    curvature_m: float
    delay_m: float
    nearest_m: float
    farthest_m: float
    directions: np.ndarray
    bounds_m: np.ndarray

    @classmethod
    @functools.lru_cache(maxsize=16)
    def of(cls, scenario: Scenario) -> 'Resolution':
        """Derive the lengths from a scenario."""
        elements = element_positions(scenario)
        wavenumber = subband_wavenumbers(scenario).max()
        bounds = _thick_bounds(scenario)
        low, high = bounds
        nearest, farthest = np.clip(0.0, low, high), np.maximum(np.abs(low), np.abs(high))
        directions = np.empty((2, 2))
        for axis, other in ((1, 2), (2, 1)):
            near, far = (np.hypot(ends[0], ends[other]) for ends in (nearest, farthest))
            directions[axis - 1] = [
                low[axis] / np.hypot(low[axis], near if low[axis] < 0 else far),
                high[axis] / np.hypot(high[axis], far if high[axis] < 0 else near)]
        farthest_m = float(np.linalg.norm(farthest))
        return cls(
            SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz),
            1 / np.maximum(wavenumber * np.abs(elements[:, 1:]).max(axis=0), 1 / _MAX_DIRECTION),
            max(wavenumber * np.sum(elements**2, axis=1).max() / 2, 1e-9),
            SPEED_OF_LIGHT_MPS / (np.pi * scenario.n_subbands * scenario.subband_width_hz),
            max(float(np.linalg.norm(nearest)), _MIN_RANGE * farthest_m), farthest_m, directions,
            bounds)

    @property
    def volume_m3(self) -> float:
        """Volume of the region between the bounds."""
        return float(np.prod(self.bounds_m[1] - self.bounds_m[0]))

    def cell_width_m(self, range_m: float) -> float:
        """Change of a range over which delays and amplitudes hardly change."""
        return min(2 * _AMPLITUDE_ERROR * range_m, 2 * PHASE_ERROR * self.delay_m)

    def step_limits(self, is_coarse: bool) -> np.ndarray:
        """Longest steps in (r [m], u, v) for which the linear model of the mean holds, [3].

        They are longer if the phases of the bands carry no information about the range.
        """
        return self._radii(is_coarse, _STEP_WAVELENGTHS, _STEP_RAD)

    def separation(self, is_coarse: bool) -> np.ndarray:
        """Radii in (r [m], u, v) of an ellipsoid around a mode that contains no other, [3]."""
        return self._radii(is_coarse, _SEPARATION_WAVELENGTHS, _SEPARATION_RAD)

    def _radii(self, is_coarse: bool, wavelengths: float, radians: float) -> np.ndarray:
        range_m = (_COARSE_CELLS * self.cell_width_m(self.nearest_m) if is_coarse
                   else wavelengths * self.wavelength_m)
        return np.array([range_m, *radians * self.direction])

    @property
    def curvature_floor(self) -> np.ndarray:
        """Curvature of the log-likelihood in (r, u, v) to add everywhere, [3]."""
        extent = np.array([self.farthest_m - self.nearest_m,
                           *(self.directions[:, 1] - self.directions[:, 0])])
        return 12 * _FLOOR / np.maximum(
            extent, _MIN_RANGE * np.array([self.farthest_m, 1.0, 1.0]))**2

    @property
    def tolerance_m(self) -> float:
        """Distance in range below which a point is in the region."""
        return _TOLERANCE_WAVELENGTHS * self.wavelength_m


def _thick_bounds(scenario: Scenario) -> np.ndarray:
    """Return the bounds of the region, at least a fraction of a wavelength apart, [2, 3]."""
    thickness_m = _MIN_THICKNESS * SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz)
    center = np.array(scenario.roi_center_m)
    thick = np.stack([center - thickness_m / 2, center + thickness_m / 2])
    return np.where(np.array(scenario.roi_size_m) < thickness_m, thick, scenario.roi_bounds_m)


def subband_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Return the wavenumbers k_n of the sub-bands, float64 [N_B, N_SB] [1/m]."""
    return 2 * np.pi * subband_frequencies_hz(scenario) / SPEED_OF_LIGHT_MPS


class Grid(NamedTuple):
    """Templates and range cells that cover ranges and directions.

    Attributes
    ----------
    nodes
        Points (r [m], u, v) of the templates, float64 [G, 3].
    ranges_m, widths_m
        Centres and widths of the range cells, float64 [R].
    node, cell
        Template and range cell of each pair that belongs to the grid, int [C].
    segments
        Successive templates, range cells and pairs of one range of templates: a segment's pairs
        are some of all pairs of its range cells and templates.
    """

    nodes: np.ndarray
    ranges_m: np.ndarray
    widths_m: np.ndarray
    node: np.ndarray
    cell: np.ndarray
    segments: list[tuple[slice, slice, slice]]

    @property
    def points(self) -> np.ndarray:
        """Centres of all pairs, (r [m], u, v), float64 [C, 3]."""
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
    lines = []
    for axis in range(2):
        limit = resolution.directions[axis]
        lines.append(np.arange(np.floor(limit[0] / steps[axis]),
                               np.ceil(limit[1] / steps[axis]) + 1) * steps[axis])
    directions = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 2)
    # Directions slightly beyond the rim of the half space are moved onto it.
    excess = np.maximum(np.hypot(*directions.T) / _MAX_SINE, 1.0)
    directions = (directions / excess[:, None])[excess < 1 + 2 * steps.max()]
    halves = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing='ij'), axis=-1).reshape(-1, 3)
    nodes, node, cell, segments, n_nodes, n_pairs = [], [], [], [], 0, 0
    for first, last in _shared_ranges(edges_m, 2 * PHASE_ERROR / resolution.curvature_m):
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


def _shared_ranges(edges_m: np.ndarray, inverse_step: float) -> list[tuple[int, int]]:
    """Group successive cells whose inverse ranges differ by at most a step."""
    groups, first = [], 0
    for last in range(1, len(edges_m)):
        if last + 1 == len(edges_m) or 1 / edges_m[first] - 1 / edges_m[last + 1] > inverse_step:
            groups.append((first, last))
            first = last
    return groups
