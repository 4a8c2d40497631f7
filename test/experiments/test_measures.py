"""Measures of a sweep: statistics, intervals, and the syntax that selects them."""

import numpy as np
import pytest

from rhs_isac_ros.experiments.sweep_settings import MEASURES, measured, names_of, parse_measures


@pytest.fixture
def squares():
    return np.random.default_rng(1).exponential(4.0, (1, 400))


def test_a_mean_has_the_interval_of_its_standard_error(squares):
    value, low, high = measured(MEASURES['mse'], squares)
    error = squares.std() / np.sqrt(squares.size)
    assert value == pytest.approx(squares.mean(), rel=1e-12)
    assert low == pytest.approx(value - 1.96 * error, abs=0.25 * error)
    assert high == pytest.approx(value + 1.96 * error, abs=0.25 * error)


def test_roots_and_quantiles(squares):
    assert measured(MEASURES['rmse'], squares) == pytest.approx(
        np.sqrt(measured(MEASURES['mse'], squares)))
    value, low, high = measured(MEASURES['error_p95'], squares)
    assert low < value < high
    assert np.mean(np.sqrt(squares) <= value) == pytest.approx(0.95, abs=0.005)


def test_the_interval_includes_the_codebooks(squares):
    one = measured(MEASURES['mse'], squares)
    three = measured(MEASURES['mse'], squares * [[0.5], [1.0], [1.5]])
    assert three.value == pytest.approx(one.value, rel=1e-6)
    assert three.high - three.low > 2 * (one.high - one.low)


def test_a_share_of_all_positions_has_an_interval_too():
    value, low, high = measured(MEASURES['coverage'], np.ones((1, 100)))
    assert (value, high) == (100, pytest.approx(100))
    assert 96 < low < 97
    # Codebooks that agree everywhere have no more positions than one of them.
    assert measured(MEASURES['coverage'], np.ones((3, 100))) == (value, low, high)
    apart = measured(MEASURES['coverage'], np.repeat([[0.0], [1.0]], 20, axis=1))
    assert apart == (50, 0, 100)


def test_infinite_and_missing_results_are_not_left_out():
    results = np.array([[1.0, 2.0, 3.0, np.inf]])
    value, *ends = measured(MEASURES['crlb'], results)
    assert value == np.inf and np.isnan(ends).all()
    value, low, high = measured(MEASURES['crlb_median'], results)
    assert (value, high) == (2, np.inf) and low < 2
    assert measured(MEASURES['crlb_p95'], results)[0] == np.inf
    assert np.isnan(measured(MEASURES['global_bound'], np.array([[1.0, np.nan]]))).all()


def test_plus_joins_measures_of_a_panel():
    panels = parse_measures('rmse+root_crlb,capacity')
    assert panels == [['rmse', 'root_crlb'], ['capacity']]
    assert names_of(panels) == ['rmse', 'root_crlb', 'capacity']


@pytest.mark.parametrize(('text', 'expected'), [
    ('', "'', expected one of crlb"),
    ('mse,speed', "'speed', expected one of crlb"),
    ('mse,mse', 'mse more than once'),
    ('mse+rmse', r'rmse \[m\] joined to mse, expected a measure in m²')])
def test_an_error_names_the_measure(text, expected):
    with pytest.raises(ValueError, match=expected):
        parse_measures(text)
