"""Random generators that depend on their purpose only."""

import itertools

import numpy as np
import pytest

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


def first(key, n=4):
    return tuple(streams.generator(*key).random(n))


def test_purposes_keep_their_numbers():
    """Otherwise, runs of older versions would not be reproducible."""
    assert {name: getattr(streams, name) for name in PURPOSES} == PURPOSES


@pytest.mark.parametrize('key', KEYS)
def test_the_same_key_gives_the_same_sequence(key):
    a, b = streams.generator(*key), streams.generator(*key)
    assert a is not b
    np.testing.assert_array_equal(a.random(100), b.random(100))


def test_different_keys_give_different_sequences():
    sequences = [first(key) for key in KEYS]
    for a, b in itertools.combinations(sequences, 2):
        assert not set(a) & set(b)


def test_a_sequence_does_not_depend_on_what_was_drawn_before():
    key = (5, streams.CHANNEL, 1, 7, 0)
    fresh = first(key)
    for other in KEYS:
        first(other, 50)
    assert first(key) == fresh


def test_the_order_within_a_key_matters():
    assert first((0, streams.CHANNEL, 1, 2, 3)) != first((0, streams.CHANNEL, 2, 1, 3))


def test_a_negative_key_is_an_error():
    with pytest.raises(ValueError, match='non-negative'):
        streams.generator(0, streams.USER, -1)
