"""Random generators that depend on their purpose, not on the order in which they are used."""

import functools
import threading
from typing import Any

import numpy as np

_FIRST_SOBOL = threading.Lock()
(CHANNEL, RECEIVER, USER, BASE_STATION, SAMPLES, START, HELD_OUT, SKETCH, PAIRS,
 METHOD, PHASES, TRAINING, AIR, SURFACE, USER_DEVIATION, CYCLE_DEVIATION, PLANS,
 BLOCKAGE, AGREEMENTS, RADIO) = range(20)
_N_POINTS = 1024


def generator(seed: int, stream: int, *key: int) -> np.random.Generator:
    """Create a generator that yields the same sequence for the same arguments.

    `stream` is one of the constants of this module. The non-negative integers `key`, such as the
    numbers of a user and a cycle, distinguish the uses of a stream.
    """
    return np.random.default_rng([seed, stream, *key])


def sobol(n_dimensions: int, seed: int | np.random.Generator) -> Any:
    """Return a scrambled Sobol sequence of SciPy."""
    # A slow import, which loading a codebook does not need.
    from scipy.stats import qmc

    # SciPy has no lock for the table that the first sequence loads.
    with _FIRST_SOBOL:
        return qmc.Sobol(n_dimensions, scramble=True, seed=seed)


@functools.cache
def unit_points(n_dimensions: int = 3) -> np.ndarray:
    """Return quasi-random points in the unit cube, float64 [1024, n_dimensions], read-only."""
    points = np.asarray(sobol(n_dimensions, 0).random(_N_POINTS))
    points.flags.writeable = False
    return points
