"""The choice of separate points."""

import numpy as np
import pytest

from rhs_isac_ros.positioning.separation import separate, separate_each


def test_separate_keeps_the_first_of_close_points():
    points = np.random.default_rng(5).uniform(0, 4, (200, 3))
    kept = []
    for n, point in enumerate(points):
        if all(max(abs(point - points[k])) >= 1 for k in kept):
            kept.append(n)
    assert list(separate(points, 1000)) == kept
    assert list(separate(points, 7)) == kept[:7]
    assert len(kept) > 7


def test_separate_accepts_no_points():
    assert list(separate(np.zeros((0, 3)), 5)) == []


@pytest.mark.parametrize('n_points', [1, 30, 150])
@pytest.mark.parametrize('n_lists', [0, 1, 3, 20])
@pytest.mark.parametrize('max_points', [1, 7, 1000])
def test_separate_each_treats_every_list_alone(n_points, n_lists, max_points):
    rng = np.random.default_rng(6)
    points = rng.uniform(0, 4, (n_lists, n_points, 3))
    valid = rng.uniform(size=points.shape[:2]) < rng.uniform(size=(n_lists, 1))
    valid[:1] = False
    lists, indices = separate_each(points, valid, max_points)
    assert (np.diff(lists) >= 0).all()
    for number in range(n_lists):
        (own,) = np.nonzero(valid[number])
        expected = own[separate(points[number, own], max_points)]
        np.testing.assert_array_equal(indices[lists == number], expected)
