"""The interior-point method, on functions with a known minimum."""

import numpy as np
import pytest

from rhs_isac_ros.codebook.methods import minimize_interior_point


@pytest.mark.parametrize('seed', range(4))
def test_changes_only_the_free_variables_and_finds_their_minimum(quadratic, search_of, seed):
    problem = quadratic(seed)
    free = np.random.default_rng(seed).uniform(size=20) < 0.5
    assert free[:10].any() and free[10:].any() and not free.all()
    start = np.linspace(0.3, 0.6, 20)
    found = minimize_interior_point(search_of(problem, start=start), start, free, 400)
    assert len(problem.points) > 5
    for point in problem.points:
        np.testing.assert_array_equal(point[~free], start[~free])
    np.testing.assert_array_equal(found[~free], start[~free])
    np.testing.assert_allclose(found[free], problem.best[free], atol=0.02)


@pytest.mark.parametrize('part', [slice(0, 10), slice(10, 20)], ids=['bounded', 'unbounded'])
def test_the_free_variables_may_all_be_bounded_or_all_be_unbounded(quadratic, search_of, part):
    problem, start = quadratic(5), np.full(20, 0.5)
    free = np.zeros(20, bool)
    free[part] = True
    found = minimize_interior_point(search_of(problem), start, free, 400)
    np.testing.assert_allclose(found[free], problem.best[free], atol=0.02)


def test_returns_the_best_point_evaluated(quadratic, search_of):
    problem, start = quadratic(2), np.full(20, 0.5)
    search = search_of(problem)
    found = minimize_interior_point(search, start, np.ones(20, bool), 6)
    values = [problem.value(point) for point in list(problem.points)]
    assert len(values) > 3
    assert problem.value(found) == min(values) == search.value_m2


def test_returns_the_start_if_no_point_is_better(flat, search_of):
    start = np.linspace(0.3, 0.6, 20)
    found = minimize_interior_point(search_of(flat, start=start), start, np.ones(20, bool), 10)
    np.testing.assert_array_equal(found, start)


@pytest.mark.parametrize('max_steps', [1, 4, 9])
def test_stops_at_the_limit_of_steps(quadratic, search_of, max_steps):
    search = search_of(quadratic(3))
    minimize_interior_point(search, search.start, np.ones(20, bool), max_steps)
    assert len(search.history) == max_steps


def test_does_not_depend_on_the_scale_of_the_objective(quadratic, search_of):
    """The barrier's weight is relative to the objective at the start."""
    class Scaled(quadratic):
        def value(self, variables):
            return 1024 * super().value(variables)

        def value_and_gradient(self, variables):
            value, gradient = super().value_and_gradient(variables)
            return value, 1024 * gradient

    found = [minimize_interior_point(
        search_of(make(4)), np.full(20, 0.5), np.ones(20, bool), 15) for make in (
            quadratic, Scaled)]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)
