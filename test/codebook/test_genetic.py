"""The genetic algorithm, which needs an optional library."""

import sys

import numpy as np
import pytest

from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.codebook.methods import minimize_genetic
from rhs_isac_ros.support.optional import MissingLibraryError


def test_without_pymoo_the_error_names_the_extra(scenario, monkeypatch):
    for name in [name for name in sys.modules if name.partition('.')[0] == 'pymoo']:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'pymoo', None)
    words = r"^method 'genetic' needs pymoo, .*pip install 'rhs_isac_ros\[genetic\]'"
    with pytest.raises(MissingLibraryError, match=words):
        optimize(scenario, method='genetic', n_positions=4, max_steps=1)


@pytest.fixture
def pymoo():
    return pytest.importorskip('pymoo')


@pytest.mark.parametrize('seed', range(2))
def test_improves_with_every_generation_and_stays_in_range(
        quadratic, search_of, pymoo, seed):
    problem = quadratic(seed)
    start = np.full(20, 0.5)
    search = search_of(problem, 6, start=start, seed=seed)
    assert minimize_genetic(search) == '6 generations'
    assert len(search.history) == 6
    values = [entry.value_m2 for entry in search.history]
    assert values == sorted(values, reverse=True)
    assert values[-1] < 0.9 * values[0]
    points = np.array(problem.points)
    assert points[:, :10].min() >= 0
    assert np.abs(points).max() <= 1
    # Configurations are at least 0, parts of combining vectors at least -1.
    assert points[:200, 10:].min() < -0.9


@pytest.mark.parametrize('low', [0.2, -0.6])
def test_the_start_is_in_the_first_generation(quadratic, search_of, pymoo, low):
    problem = quadratic(3)
    start = np.concatenate([np.linspace(0, 1, 10), np.linspace(low, 0.7, 10)])
    search = search_of(problem, 1, start=start)
    minimize_genetic(search)
    assert len(problem.points) == 200
    assert sum(np.array_equal(point, start) for point in problem.points) == 1


def test_keeps_a_start_that_is_optimal(quadratic, search_of, pymoo):
    problem = quadratic(4)
    problem.center = np.clip(problem.center, 0, 1)
    search = search_of(problem, 2, start=problem.center)
    minimize_genetic(search)
    np.testing.assert_array_equal(search.best, problem.center)


def test_the_generator_determines_all_points(quadratic, search_of, pymoo):
    def points(seed):
        problem = quadratic(0)
        minimize_genetic(search_of(problem, 2, seed=seed))
        return np.array(problem.points)

    one, same, other = points(1), points(1), points(2)
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one[200:], other[200:])
    assert not np.array_equal(one[1:200], other[1:200])
