"""The quasi-Newton method, on functions with a known minimum."""

import numpy as np
import pytest

from rhs_isac_ros.codebook.methods import minimize_lbfgs


@pytest.mark.parametrize('seed', range(4))
def test_finds_the_minimum_and_reports_every_step(quadratic, search_of, seed):
    problem = quadratic(seed)
    search = search_of(problem, 200)
    reason = minimize_lbfgs(search)
    np.testing.assert_allclose(search.best, problem.best, atol=1e-3)
    assert search.value_m2 == pytest.approx(1.0, abs=1e-5)
    assert all((0 <= x[:10]).all() and (x[:10] <= 1).all() for x in problem.points)
    assert 2 < len(search.history) < 200
    evaluations = [entry.evaluations for entry in search.history]
    assert evaluations == sorted(set(evaluations))
    assert evaluations[-1] == len(problem.points)
    assert 'CONVERGENCE' in reason.upper()


def test_stops_at_the_limit_of_steps(quadratic, search_of):
    problem = quadratic(0)
    search = search_of(problem, 3)
    reason = minimize_lbfgs(search)
    assert len(search.history) == 3
    assert len(problem.points) <= 60
    assert reason == 'max_steps reached'


def test_begins_at_the_start(quadratic, search_of):
    problem = quadratic(1)
    start = np.linspace(0.2, 0.7, 20)
    minimize_lbfgs(search_of(problem, 3, start=start))
    np.testing.assert_array_equal(problem.points[0], start)


@pytest.mark.parametrize('unit', [2.0**-40, 2.0**40])
def test_does_not_depend_on_the_unit_of_the_objective(quadratic, search_of, unit):
    """In nanometres or in kilometres, the steps are the same."""
    class Scaled(quadratic):
        def value(self, variables):
            return unit * super().value(variables)

        def value_and_gradient(self, variables):
            value, gradient = super().value_and_gradient(variables)
            return value, unit * gradient

    plain, scaled = (make(2) for make in (quadratic, Scaled))
    reasons = [minimize_lbfgs(search_of(problem, 200)) for problem in (plain, scaled)]
    assert reasons[0] == reasons[1]
    np.testing.assert_array_equal(scaled.points, plain.points)
