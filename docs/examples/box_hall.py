"""Propagation paths in an empty rectangular hall, computed with the image method.

The surface is on the wall x = -0.05 m of a concrete hall of 20 x 14 x 5 m. Antennas are vertically
polarised and have no pattern. Walls, floor and ceiling reflect specularly, up to two times. The
script writes the paths of users on a raster, and a survey of users at random positions:

    python3 docs/examples/box_hall.py hall_paths.npz hall_multipath.npz
"""

import dataclasses
import itertools
import sys

import numpy as np

from rhs_isac_ros.calibration import survey
from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, PathChannel, Scenario, simulate_received

# Corners of the hall [m], and the frequency of the amplitudes [Hz].
LOW, HIGH, F0_HZ = np.array([-0.05, -7.0, -2.0]), np.array([19.95, 7.0, 3.0]), 2.75e9
# Relative permittivity and conductivity of concrete, ITU-R P.2040, and the number of reflections.
PERMITTIVITY = 5.24 - 1j * 0.0462 * (F0_HZ / 1e9)**0.7822 * 17.98 / (F0_HZ / 1e9)
MAX_ORDER = 2
# Distance of the users on the raster, and their height relative to the surface [m].
RASTER_M, HEIGHT_M = 0.5, -0.5
N_SURVEY = 100


def trace(users: np.ndarray) -> PathChannel:
    """Return the paths of users, float64 [N, 3] [m]."""
    orders = [order for order in itertools.product(range(-MAX_ORDER, MAX_ORDER + 1), repeat=3)
              if sum(map(abs, order)) <= MAX_ORDER]
    n = np.array(orders)
    # An odd number of reflections along an axis mirrors the user; an even number shifts it.
    sources = np.where(n % 2, LOW + HIGH - users[:, None], users[:, None]) + n * (HIGH - LOW)
    # The elements receive nothing from behind the surface.
    in_front = sources[..., 0] > 0
    distance = np.linalg.norm(sources, axis=2)
    cosines = np.abs(sources) / distance[..., None]
    # The field is perpendicular to the plane of incidence at walls, and parallel to it at floor
    # and ceiling.
    refracted = np.sqrt(PERMITTIVITY - 1 + cosines**2)
    perpendicular = (cosines - refracted) / (cosines + refracted)
    parallel = ((PERMITTIVITY * cosines - refracted) / (PERMITTIVITY * cosines + refracted))
    coefficients = np.where([False, False, True], parallel, perpendicular)
    a = (SPEED_OF_LIGHT_MPS / (4 * np.pi * F0_HZ * distance)
         * np.prod(coefficients**np.abs(n), axis=2) * in_front)
    return PathChannel(users, a, sources, np.where(in_front, np.abs(n).sum(axis=1), -1), F0_HZ)


def raster(scenario: Scenario) -> np.ndarray:
    """Return users on a raster in the region of interest, float64 [N, 3] [m]."""
    low, high = scenario.roi_bounds_m
    x, y = (np.arange(low[axis], high[axis] + 1e-9, RASTER_M) for axis in (0, 1))
    return np.array([(a, b, HEIGHT_M) for a, b in itertools.product(x, y)])


def main(paths_file: str, multipath_file: str) -> None:
    """Write both files."""
    scenario, codebook = Scenario(), Codebook.load(default_codebook_file())
    rng = np.random.default_rng(0)
    trace(raster(scenario)).save(paths_file)
    positions = scenario.sample_positions(N_SURVEY, rng)
    hall = dataclasses.replace(scenario, channel=trace(positions))
    received = simulate_received(hall, codebook, positions, rng)
    survey(scenario, codebook, positions, received).save(multipath_file)


if __name__ == '__main__':
    main(*sys.argv[1:])
