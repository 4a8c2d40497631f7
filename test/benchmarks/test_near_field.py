"""The bound of users with unknown gain, phase and clock, against published ones."""

import math

import pytest
from benchmarks.near_field import PUBLISHED, RANGES_M, bound_m


def test_the_bound_agrees_with_the_published_one():
    """The clock is unknown. It costs 6 % at this range, so a known one would be noticed."""
    published = PUBLISHED[2.0][1][RANGES_M.index(2)]
    found = bound_m(2.0, 2, clock_is_known=False)
    assert math.sqrt(2) * found == pytest.approx(published, rel=1.1e-3)
