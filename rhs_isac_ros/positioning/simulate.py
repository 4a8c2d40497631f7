"""Simulated pairs of positions and received signals, to train and to measure estimators."""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.threads import map_blocks

# Number of pairs that share a random generator and all matrix products. Another number would
# change the pairs of every seed.
_CHUNK = 512


def simulate_pairs(
        scenario: Scenario, codebook: Codebook, n: int, seed: int, first: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate positioning phases at random positions of the region of interest.

    A seed defines an infinite sequence of pairs, of which this function returns n, beginning with
    `first`. The pairs do not depend on how calls divide the sequence. Returns positions,
    float64 [n, 3] [m], uniform in the region, and received signals, complex128 [n, N_B, N_SB F],
    sub-band-major. Raises CodebookError if the codebook does not fit the scenario, and ValueError
    if `n`, `seed` or `first` is negative.
    """
    for name, value in (('n', n), ('seed', seed), ('first', first)):
        if value < 0:
            raise ValueError(f'{name}: {value}, expected 0 or more')
    codebook.check(scenario)
    model = MeasurementModel(scenario, codebook)
    positions = np.empty((n, 3))
    received = np.empty((n, *model.shape), complex)

    def fill(chunk: int) -> None:
        begin = chunk * _CHUNK
        part = slice(max(first - begin, 0), min(first + n - begin, _CHUNK))
        target = slice(begin + part.start - first, begin + part.stop - first)
        # Draw the whole chunk, because the rounding of matrix products depends on their sizes.
        rng = streams.generator(seed, streams.PHASES, chunk)
        drawn = scenario.sample_positions(_CHUNK, rng)
        positions[target] = drawn[part]
        received[target] = model.sample(drawn, rng)[part]

    map_blocks(fill, range(first // _CHUNK, -(-(first + n) // _CHUNK)))
    return positions, received
