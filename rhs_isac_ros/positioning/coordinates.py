"""Positions as range and direction cosines, in which the likelihood is nearly Gaussian.

A point q = (r, u, v) is the position r (w, u, v) with w = sqrt(1 - u^2 - v^2), in front of the
surface. The signals determine the range to a fraction of a wavelength, but the direction only to
a fraction of a beam. In Cartesian coordinates, the modes of the likelihood are therefore curved.
"""

import functools
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.model.geometry import element_positions, subband_frequencies_hz

# Alternating projections onto the region and onto a sphere, and the distance from the sphere that
# they may leave, in wavelengths.
_N_PROJECTIONS = 4
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
_COARSE_CELLS = 1.5
# Direction cosines per radian of apertures below a few wavelengths: the gains of elements and of
# the user also change with the direction.
_MAX_DIRECTION = 0.4
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
    """

    wavelength_m: float
    direction: np.ndarray
    curvature_m: float
    delay_m: float
    nearest_m: float
    farthest_m: float
    directions: np.ndarray

    @classmethod
    @functools.lru_cache(maxsize=16)
    def of(cls, scenario: Scenario) -> 'Resolution':
        """Derive the lengths from a scenario."""
        elements = element_positions(scenario)
        wavenumber = subband_wavenumbers(scenario).max()
        low, high = scenario.roi_bounds_m
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
            max(float(np.linalg.norm(nearest)), _MIN_RANGE * farthest_m), farthest_m, directions)

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
        floor: np.ndarray = 12 * _FLOOR / np.maximum(
            extent, _MIN_RANGE * np.array([self.farthest_m, 1.0, 1.0]))**2
        return floor

    @property
    def tolerance_m(self) -> float:
        """Distance in range below which a point is in the region."""
        return _TOLERANCE_WAVELENGTHS * self.wavelength_m


def to_positions(points: np.ndarray) -> np.ndarray:
    """Convert points (r [m], u, v), float64 [..., 3], to positions, float64 [..., 3] [m].

    Directions outside the unit circle have x = 0.
    """
    distance, u, v = points[..., 0], points[..., 1], points[..., 2]
    positions = np.empty_like(points, dtype=float)
    positions[..., 0] = np.sqrt(np.maximum(1 - u**2 - v**2, 0.0))
    positions[..., 1:] = points[..., 1:]
    positions *= distance[..., None]
    return positions


def to_polar(positions: np.ndarray) -> np.ndarray:
    """Convert positions with x > 0, float64 [..., 3] [m], to (r [m], u, v), float64 [..., 3]."""
    points = np.empty(positions.shape)
    points[..., 0] = np.sqrt(np.sum(positions**2, axis=-1))
    points[..., 1:] = positions[..., 1:] / points[..., :1]
    return points


def jacobian(points: np.ndarray) -> np.ndarray:
    """Compute dp/dq at points (r [m], u, v), float64 [N, 3].

    The result is float64 [N, 3, 3], with the coordinates of the position in rows.
    """
    distance, u, v = points.T
    w = np.sqrt(np.maximum(1 - u**2 - v**2, 1e-9))
    matrix = np.zeros((len(points), 3, 3))
    matrix[:, 0, 0], matrix[:, 1, 0], matrix[:, 2, 0] = w, u, v
    matrix[:, 0, 1], matrix[:, 0, 2] = -distance * u / w, -distance * v / w
    matrix[:, 1, 1] = matrix[:, 2, 2] = distance
    return matrix


def carrier_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Return the wavenumbers k_i at the bands' centres, float64 [N_B] [1/m]."""
    return 2 * np.pi * np.array(scenario.center_frequencies_hz) / SPEED_OF_LIGHT_MPS


def subband_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Return the wavenumbers k_n of the sub-bands, float64 [N_B, N_SB] [1/m]."""
    return 2 * np.pi * subband_frequencies_hz(scenario) / SPEED_OF_LIGHT_MPS


def is_inside(positions: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return whether positions, float64 [..., 3] [m], are in the region, bool [...].

    The bounds are those of `offset_to_roi`.
    """
    low, high = bounds
    inside = np.ones(positions.shape[:-1], bool)
    # A reduction over the coordinates takes several times as long.
    for axis in range(positions.shape[-1]):
        coordinate = positions[..., axis]
        inside &= coordinate >= low[axis]
        inside &= coordinate <= high[axis]
    return inside


def offset_to_roi(points: np.ndarray, curvature: np.ndarray, bounds: np.ndarray,
                  tolerance_m: float) -> np.ndarray:
    """Compute the offsets from modes to the nearest points of the region of interest.

    The offset follows the sphere of the mode's range, the coordinate that the signals determine
    best. The range then changes with the direction so that the likelihood is highest.

    Parameters
    ----------
    points
        Modes (r [m], u, v), float64 [M, 3]; the offsets, 0 inside, have the same form.
    curvature
        Curvature of the log-likelihood at each mode, float64 [M, 3, 3].
    bounds
        Lower and upper vertex of the region, float64 [2, 3] [m].
    tolerance_m
        Distance from the sphere that counts as zero.
    """
    positions = to_positions(points)
    result = np.zeros_like(points)
    outside = np.flatnonzero(~is_inside(positions, bounds))
    if not len(outside):
        return result
    points, positions, curvature = points[outside], positions[outside], curvature[outside]
    for _ in range(_N_PROJECTIONS):
        nearest = to_polar(np.clip(positions, *bounds))
        offset: np.ndarray = nearest - points
        nearest[:, 0] = points[:, 0]
        positions = to_positions(nearest)
    # The projections leave a small remainder; a larger one means that the sphere does not
    # intersect the region.
    excess = np.sign(offset[:, 0]) * np.maximum(np.abs(offset[:, 0]) - tolerance_m, 0.0)
    coupling = np.einsum('mq,mq->m', curvature[:, 0, 1:], offset[:, 1:]) / curvature[:, 0, 0]
    offset[:, 0] = excess - coupling
    result[outside] = offset
    return result


def likelihood_loss(offset: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Compute the decrease of the log-likelihood over offsets from modes, float64 [M].

    The arguments have the shapes of `offset_to_roi`.
    """
    loss: np.ndarray = np.einsum('mp,mpq,mq->m', offset, curvature, offset) / 2
    return loss
