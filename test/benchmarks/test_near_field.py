"""The bound of users with unknown gain, phase and clock, against published ones."""

import math

import pytest
from benchmarks.near_field import PUBLISHED, RANGES_M, bound_m


@pytest.mark.parametrize(('spacing', 'clock', 'range_m'), [
    (2.0, 'known', 2), (0.5, 'unknown', 8)])
def test_the_bound_agrees_with_the_published_one(spacing, clock, range_m):
    published = PUBLISHED[spacing][clock == 'unknown'][RANGES_M.index(range_m)]
    found = bound_m(spacing, range_m, clock_is_known=clock == 'known')
    assert math.sqrt(2) * found == pytest.approx(published, rel=1.1e-3)
