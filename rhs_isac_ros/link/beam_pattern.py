"""Beam patterns: the power of a beam over the directions in front of the surface."""

import dataclasses
import functools

import numpy as np

from rhs_isac_ros.link.capacity import Beam, direct_power_w
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support.threads import one_blas_thread


@dataclasses.dataclass(frozen=True, eq=False)
class BeamPattern:
    """Power of a beam over the directions in front of the surface, at one distance.

    Attributes
    ----------
    directions
        Unit vectors from the surface's centre, float64 [n_el, n_az, 3]; elevation grows along
        the first axis, azimuth along the second, both from -90 to 90 degrees.
    relative
        Line-of-sight power relative to that of the peak, the strongest direction, float64
        [n_el, n_az]; zeros if the beam is off.
    """

    directions: np.ndarray
    relative: np.ndarray
    distance_m: float

    def azimuth_cut(self) -> tuple[np.ndarray, np.ndarray]:
        """Cut the pattern at the elevation of the peak: azimuths [rad] and power, both [n_az]."""
        row, _ = self.peak
        x, y, _ = self.directions[len(self.directions) // 2].T
        return np.arctan2(y, x), self.relative[row]

    def elevation_cut(self) -> tuple[np.ndarray, np.ndarray]:
        """Cut the pattern at the azimuth of the peak: elevations [rad] and power, both [n_el]."""
        _, column = self.peak
        return np.arcsin(self.directions[:, column, 2]), self.relative[:, column]

    @property
    def peak(self) -> tuple[int, int]:
        """Row and column of the strongest direction in `relative`."""
        row, column = np.unravel_index(np.argmax(self.relative), self.relative.shape)
        return int(row), int(column)


@one_blas_thread
def beam_pattern(
        scenario: Scenario, beam: Beam, distance_m: float, step_deg: float = 5.0) -> BeamPattern:
    """Compute the pattern of a beam at a distance from the surface's centre, in the near field.

    Neighbouring azimuths, and elevations, are at most `step_deg` apart.

    Raises
    ------
    ValueError
        If the distance or the step is not positive, or the beam does not fit the scenario.
    """
    for name, value in (('distance_m', distance_m), ('step_deg', step_deg)):
        if not value > 0:
            raise ValueError(f'{name}: {value}, expected a positive number')
    directions = _directions(step_deg)
    power_w = direct_power_w(scenario, beam, distance_m * directions.reshape(-1, 3))
    power_w = power_w.reshape(directions.shape[:2])
    max_power_w = power_w.max()
    return BeamPattern(directions, power_w / max_power_w if max_power_w else power_w, distance_m)


@functools.lru_cache(maxsize=4)
def _directions(step_deg: float) -> np.ndarray:
    """Unit vectors over the half space x > 0, float64 [n_el, n_az, 3], read-only."""
    n_half = max(1, int(np.ceil(90 / step_deg)))
    # An odd number of angles, so that the middle ones are on boresight.
    angles = np.linspace(-np.pi / 2, np.pi / 2, 2 * n_half + 1)
    elevation, azimuth = np.meshgrid(angles, angles, indexing='ij')
    directions = np.stack([np.cos(elevation) * np.cos(azimuth),
                           np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1)
    directions.flags.writeable = False
    return directions
