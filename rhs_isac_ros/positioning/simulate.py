"""Pairs of positions and received signals: for training, and to measure estimators with."""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, mean_received, streams
from rhs_isac_ros.model.measurement import covariance
from rhs_isac_ros.model.multipath import complex_normal
from rhs_isac_ros.model.surface import radiation_matrix

# Pairs that share a random generator and every matrix product: part of what a seed means.
_CHUNK = 512


def simulate_pairs(
        scenario: Scenario, codebook: Codebook, n: int, seed: int, first: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate positioning phases at random positions of the region of interest.

    A seed stands for one endless sequence of pairs, of which this returns a part, bit for bit the
    same however the sequence is cut. Multipath and noise are drawn as the signals see them, with
    the covariance of Eq. (14); `simulate_received` draws every element's gain, for the same
    distribution in a hundred times the time.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook.
    n
        How many pairs.
    seed
        Which sequence.
    first
        Index of the first pair in the sequence.

    Returns
    -------
    positions : numpy.ndarray
        Uniform in the region of interest, float64 [n, 3] [m].
    received : numpy.ndarray
        Complex128 [n, N_B, N_SB F], sub-band-major.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    ValueError
        If `n`, `seed` or `first` is negative.
    """
    for name, value in (('n', n), ('seed', seed), ('first', first)):
        if value < 0:
            raise ValueError(f'{name}: {value}, expected 0 or more')
    codebook.check(scenario)
    roots = np.linalg.cholesky(covariance(scenario, radiation_matrix(scenario, codebook)))
    positions = np.empty((n, 3))
    received = np.empty((n, *roots.shape[:2]), complex)
    for chunk in range(first // _CHUNK, -(-(first + n) // _CHUNK)):
        begin = chunk * _CHUNK
        part = slice(max(first - begin, 0), min(first + n - begin, _CHUNK))
        place = slice(begin + part.start - first, begin + part.stop - first)
        # The whole chunk, whatever the part: rounding in products depends on their sizes.
        rng = streams.generator(seed, streams.PHASES, chunk)
        there = scenario.sample_positions(_CHUNK, rng)
        random = complex_normal((_CHUNK, *roots.shape[:2]), rng)
        signals = mean_received(scenario, codebook, there)
        for band, root in enumerate(roots):
            signals[:, band] += random[:, band] @ root.T
        positions[place], received[place] = there[part], signals[part]
    return positions, received
