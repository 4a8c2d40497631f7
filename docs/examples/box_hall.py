"""Propagation paths in an empty rectangular hall, computed with the image method.

The surface is on the wall x = -0.05 m of a concrete hall of 20 x 14 x 5 m. Antennas are vertically
polarised and have no pattern. Paths have up to two specular reflections from walls, floor and
ceiling. The script writes the paths of users on a raster, and a survey at random positions:

    python3 docs/examples/box_hall.py hall_paths.npz hall_multipath.npz

With a folder as its only argument, it writes the files of a narrower and lower hall for
``scripts/benchmark channels``.
"""

import dataclasses
import itertools
import sys
from pathlib import Path

import numpy as np

from rhs_isac_ros.calibration import survey
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, PathChannel, Scenario, simulate_received

# Corners of the hall [m], and the frequency of the amplitudes [Hz].
HALL = np.array([[-0.05, -7.0, -2.0], [19.95, 7.0, 3.0]])
NARROW_HALL = np.array([[-0.05, -5.2, -1.5], [24.0, 5.6, 1.8]])
F0_HZ = 2.75e9
# Complex permittivity of concrete by ITU-R P.2040, and the maximum number of reflections.
PERMITTIVITY = 5.24 - 1j * 0.0462 * (F0_HZ / 1e9)**0.7822 * 17.98 / (F0_HZ / 1e9)
MAX_ORDER = 2
# Spacing of the raster, and height of its users relative to the centre of the surface [m].
RASTER_M, HEIGHT_M = 0.5, -0.5
N_SURVEY = 100


def trace(users: np.ndarray, hall: np.ndarray = HALL, max_order: int = MAX_ORDER) -> PathChannel:
    """Compute the paths of users, [N, 3] [m], in a hall between two corners, [2, 3] [m]."""
    low, high = hall
    orders = [order for order in itertools.product(range(-max_order, max_order + 1), repeat=3)
              if sum(map(abs, order)) <= max_order]
    n = np.array(orders)
    # An odd number of reflections along an axis mirrors the user; an even number shifts it.
    sources = np.where(n % 2, low + high - users[:, None], users[:, None]) + n * (high - low)
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
    """Return the positions of a raster in the region of interest, float64 [N, 3] [m]."""
    low, high = scenario.roi_bounds_m
    x, y = (np.arange(low[axis], high[axis] + 1e-9, RASTER_M) for axis in (0, 1))
    return np.array([(a, b, HEIGHT_M) for a, b in itertools.product(x, y)])


def main(paths_file: str, multipath_file: str) -> None:
    """Write the paths of the raster and the multipath of a survey to two files."""
    scenario, codebook = Scenario(), Codebook.default()
    rng = np.random.default_rng(0)
    trace(raster(scenario)).save(paths_file)
    positions = scenario.sample_positions(N_SURVEY, rng)
    hall = dataclasses.replace(scenario, channel=trace(positions))
    received = simulate_received(hall, codebook, positions, rng)
    survey(scenario, codebook, positions, received).save(multipath_file)


def write_scene(folder: Path) -> None:
    """Write the files of the narrow hall for the benchmark to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for name, n, max_order in (('empty_test', 300, 0), ('hall_test', 300, MAX_ORDER),
                               ('hall_survey', 1000, MAX_ORDER)):
        users = Scenario().sample_positions(n, rng)
        trace(users, NARROW_HALL, max_order).save(folder / f'{name}.npz')


if __name__ == '__main__':
    if len(sys.argv) == 2:
        write_scene(Path(sys.argv[1]))
    else:
        main(*sys.argv[1:])
