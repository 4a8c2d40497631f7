"""Codebooks that follow a prediction: blocks of positions and walks."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks import adaptive

LIBRARY = str(Path(__file__).parents[2] / 'config' / 'library_bandplan.npz')


@pytest.mark.parametrize(('function', 'case'), [('located', 1), ('misled', 0), ('jumped', 0)])
def test_blocks_have_the_random_numbers_of_all_positions(monkeypatch, function, case):
    """However large they are."""
    monkeypatch.setattr(adaptive, 'N_BEFORE', 1)
    known = {'plan': 'bandplan', 'library': LIBRARY, 'case': case, 'n_positions': 6, 'n_walks': 2,
             'seed': 1}

    def all_blocks(size):
        for name in ('POSITIONS', 'WALKS'):
            monkeypatch.setattr(adaptive, name, size)
        blocks = [adaptive.block(function, first=first, **known) for first in range(0, 2, size)]
        return [one.get('found', one.get('fixes', [None, None])[1]) for one in blocks]
    whole, parts = all_blocks(2), all_blocks(1)
    np.testing.assert_array_equal(np.concatenate(whole), np.concatenate(parts))
