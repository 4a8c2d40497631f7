"""Random generators that depend on their purpose, not on the order in which they are used."""

import functools
from collections.abc import Sequence

import numpy as np

(CHANNEL, RECEIVER, USER, BASE_STATION, SAMPLES, START, HELD_OUT, SKETCH, PAIRS,
 METHOD, PHASES, TRAINING, AIR, SURFACE, USER_DEVIATION, CYCLE_DEVIATION, PLANS,
 BLOCKAGE, AGREEMENTS, RADIO) = range(20)
_SOBOL_BITS = 30
# Polynomials over the numbers 0 and 1, by their coefficients as bits, and the first direction
# numbers of Joe and Kuo, for each dimension. SciPy has them, too, but the import of its generator
# takes more than a second, in each process that optimises.
_SOBOL = ((2, (1,)), (3, (1,)), (7, (1, 3)), (11, (1, 3, 1)), (13, (1, 1, 1)), (19, (1, 1, 3, 3)))


def generator(seed: int, stream: int, *key: int) -> np.random.Generator:
    """Create a generator that yields the same sequence for the same arguments.

    `stream` is one of the constants of this module. The non-negative integers `key`, such as the
    numbers of a user and a cycle, distinguish the uses of a stream.
    """
    return np.random.default_rng([seed, stream, *key])


def sobol(n_dimensions: int, log2_n: int, seed: int | np.random.Generator) -> np.ndarray:
    """Return the first points of a scrambled Sobol sequence, float64 [2**log2_n, n_dimensions].

    They are those of SciPy's `qmc.Sobol` in up to 6 dimensions: Matoušek's linear scrambling and
    a digital shift are drawn from a child of a generator, or from the generator of a seed.
    Successive points differ as a reflected Gray code does.
    """
    draw = (seed.spawn(1)[0] if isinstance(seed, np.random.Generator)
            else np.random.default_rng(seed)).integers
    shape = (n_dimensions, _SOBOL_BITS)
    powers = 1 << np.arange(_SOBOL_BITS)
    points = (draw(2, size=shape, dtype=np.uint32) @ powers)[None]
    scrambling = np.tril(draw(2, size=(*shape, _SOBOL_BITS), dtype=np.uint32), -1) + np.eye(
        _SOBOL_BITS, dtype=np.int64)
    directions = np.array(
        [_directions(polynomial, first, log2_n) for polynomial, first in _SOBOL[:n_dimensions]],
        dtype=np.int64)
    # The most significant bits first.
    bits = directions.reshape(n_dimensions, 1, log2_n) >> np.arange(_SOBOL_BITS)[::-1, None] & 1
    for flipped in powers[::-1] @ (scrambling @ bits % 2).transpose(2, 1, 0):
        points = np.concatenate([points, points[::-1] ^ flipped])
    return points / 2.0**_SOBOL_BITS


def _directions(polynomial: int, first: Sequence[int], n: int) -> list[int]:
    """Return the directions of a dimension, which begin with given numbers, as integers."""
    found, degree = list(first), polynomial.bit_length() - 1
    while len(found) < n:
        # The leading coefficient is 1.
        new = found[-degree]
        for power in range(1, degree + 1):
            if polynomial >> (degree - power) & 1:
                new ^= found[-power] << power
        found.append(new)
    return [number << (_SOBOL_BITS - 1 - bit) for bit, number in enumerate(found[:n])]


@functools.cache
def unit_points(n_dimensions: int = 3) -> np.ndarray:
    """Return quasi-random points in the unit cube, float64 [1024, n_dimensions], read-only.

    These are the first points of `sobol` with the seed 0.
    """
    units = sobol(n_dimensions, 10, 0)
    units.flags.writeable = False
    return units
