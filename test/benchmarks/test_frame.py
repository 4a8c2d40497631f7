"""The frame of the benchmarks: errors of estimates, intervals and tables."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.positioning import Estimate

FILE = Path(__file__).parents[2] / 'scripts' / 'benchmarks' / 'parts' / 'frame.py'


@pytest.fixture(scope='module')
def frame():
    spec = importlib.util.spec_from_file_location('frame', FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_errors_are_those_of_the_fixes(frame):
    mean = np.array([[1.0, 0, 0], [np.nan] * 3, [0, 6.0, 0]])
    covariance = np.stack([np.eye(3), np.full((3, 3), np.nan), 4 * np.eye(3)])
    fixes = frame.Fixes.of(Estimate(mean, covariance, ('', 'residual', '')), np.zeros((3, 3)))
    assert fixes.fix.tolist() == [True, False, True]
    assert fixes.squared.tolist() == [1.0, 36.0]
    np.testing.assert_allclose(fixes.normalised, [1.0, 9.0])
    # The 95 % quantile of the distribution chi-square with three degrees of freedom is 7.81.
    assert fixes.inside.tolist() == [True, False]
    assert fixes.without_fix[0] == pytest.approx(100 / 3)
    assert fixes.covered[0] == 50.0


def test_the_interval_of_a_mean_covers_it_and_resamples_groups(frame):
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(100), 10)
    samples = rng.normal(size=100)[group]
    value, low, high = frame.mean_interval(samples, group)
    assert value == pytest.approx(samples.mean())
    assert low < value < high
    # A standard error of 0.1, which single samples would understate.
    assert 0.3 < high - low < 0.5
    _, low, high = frame.mean_interval(samples)
    assert high - low < 0.2
    assert frame.mean_interval(samples[:0]) is None


def test_a_table_shows_numbers_and_intervals(frame, capsys):
    table = frame.Table('name', 'value')
    table.row('a', frame.shown(1.25, 1))
    table.row('b', frame.shown((1.0, 0.5, 1.75), 2))
    table.row('c', frame.shown(None, 2))
    assert capsys.readouterr().out.splitlines() == [
        '| name | value |', '|---|---|', '| a | 1.2 |', '| b | 1.00 [0.50, 1.75] |', '| c | - |']
