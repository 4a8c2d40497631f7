"""Segments of consecutive rows."""

import numpy as np

from rhs_isac_ros.positioning.segments import Segments


def test_segments_divide_rows_by_keys_or_counts():
    keys, values = np.array([2, 2, 5, 7, 7, 7]), np.array([1.0, 4.0, 2.0, 0.0, 3.0, 1.0])
    segments = Segments.of_keys(keys)
    for found, expected in zip(segments, Segments.of_counts(np.array([2, 1, 3])), strict=True):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(segments.sum(values), [5, 2, 4])
    np.testing.assert_array_equal(segments.max(values), [4, 2, 3])
    np.testing.assert_array_equal(segments.first(values), [1, 2, 0])
    np.testing.assert_array_equal(segments.repeat(segments.first(keys)), keys)
    np.testing.assert_array_equal(segments.places, [0, 1, 0, 0, 1, 2])
    assert [values[rows].tolist() for rows in segments.slices] == [[1, 4], [2], [0, 3, 1]]
