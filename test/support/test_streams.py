"""Random generators that depend on their purpose only."""

import itertools

import numpy as np
import pytest
from scipy.stats import qmc

from rhs_isac_ros.support import streams

PURPOSES = {'CHANNEL': 0, 'RECEIVER': 1, 'USER': 2, 'BASE_STATION': 3, 'SAMPLES': 4, 'START': 5,
            'HELD_OUT': 6}
# Keys as the roles use them: multipath by user, cycle and band; noise by user and cycle; users.
KEYS = [
    *((seed, streams.CHANNEL, user, cycle, band)
      for seed in (0, 1) for user in (1, 2) for cycle in (1, 2) for band in (0, 1)),
    *((seed, streams.RECEIVER, user, cycle)
      for seed in (0, 1) for user in (1, 2) for cycle in (1, 2)),
    *((seed, streams.USER, user) for seed in (0, 1) for user in (1, 2)),
    *((seed, streams.BASE_STATION) for seed in (0, 1)),
]


def test_purposes_keep_their_numbers():
    """Otherwise, runs of older versions would not be reproducible."""
    assert {name: getattr(streams, name) for name in PURPOSES} == PURPOSES


def test_equal_keys_give_equal_sequences_and_others_different_ones():
    first, again = ([tuple(streams.generator(*key).random(4)) for key in KEYS] for _ in range(2))
    assert first == again
    for a, b in itertools.combinations(first, 2):
        assert not set(a) & set(b)


@pytest.mark.parametrize('n_dimensions', [1, 3, 6])
def test_points_are_a_sobol_sequence_of_scipy(n_dimensions):
    expected = qmc.Sobol(n_dimensions, scramble=True, seed=0).random(1024)
    assert streams.unit_points(n_dimensions).tolist() == expected.tolist()
    generators = [np.random.default_rng(5) for _ in range(2)]
    for log2_n in (0, 1, 6, 11):
        ours, theirs = generators
        expected = qmc.Sobol(n_dimensions, scramble=True, seed=theirs).random_base2(log2_n)
        assert streams.sobol(n_dimensions, log2_n, ours).tolist() == expected.tolist()
