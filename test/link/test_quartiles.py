"""Running quartiles, compared with explicit sorting."""

import numpy as np
import pytest

from rhs_isac_ros.link import RunningQuartiles


def by_sorting(values):
    """Quartiles by linear interpolation between the sorted values."""
    ordered, result = sorted(values), []
    for share in (0.25, 0.5, 0.75):
        rank = share * (len(ordered) - 1)
        low = int(rank)
        high = min(low + 1, len(ordered) - 1)
        result.append(ordered[low] + (rank - low) * (ordered[high] - ordered[low]))
    return result


@pytest.mark.parametrize('window', [1, 2, 7, 50])
def test_quartiles_are_exact_over_the_newest_rows(window):
    rng = np.random.default_rng(window)
    running, rows = RunningQuartiles(3, window), []
    for _ in range(60):
        rows.append(rng.normal(size=3) * 10.0**rng.integers(-3, 7, 3))
        running.add(rows[-1])
        newest = np.array(rows[-window:])
        assert len(running) == len(newest)
        expected = [by_sorting(column) for column in newest.T]
        np.testing.assert_allclose(running.quartiles(), expected, rtol=1e-12, atol=1e-12)


def test_all_quartiles_of_one_row_equal_the_row():
    running = RunningQuartiles(2)
    running.add([3.0, -1.0])
    np.testing.assert_array_equal(running.quartiles(), [[3, 3, 3], [-1, -1, -1]])


def test_rows_are_copied():
    running, row = RunningQuartiles(1), np.array([1.0])
    running.add(row)
    row[0] = 2
    assert running.quartiles()[0, 1] == 1


def test_quartiles_of_no_rows_are_an_error():
    running = RunningQuartiles(2)
    assert len(running) == 0
    with pytest.raises(ValueError, match='no rows'):
        running.quartiles()


@pytest.mark.parametrize('row', [[1.0], [1.0, 2.0, 3.0], 1.0, [1.0, np.nan], [np.inf, 0.0]])
def test_an_invalid_row_is_an_error_and_is_not_added(row):
    running = RunningQuartiles(2)
    with pytest.raises(ValueError, match='^row: .*expected 2 finite values'):
        running.add(row)
    assert len(running) == 0


@pytest.mark.parametrize(('n_values', 'window'), [(0, 5), (2, 0), (-1, -1)])
def test_sizes_below_one_are_errors(n_values, window):
    with pytest.raises(ValueError, match=f'{n_values}, {window}, expected at least 1'):
        RunningQuartiles(n_values, window)
