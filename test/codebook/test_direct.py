"""The interior-point method on all variables at once."""

import numpy as np
import pytest

from rhs_isac_ros.codebook.methods import minimize_direct


@pytest.mark.parametrize('seed', range(3))
def test_finds_the_minimum_over_analog_and_digital_jointly(quadratic, search_of, seed):
    problem = quadratic(seed)
    search = search_of(problem, 400)
    assert minimize_direct(search) == '400 steps at most'
    np.testing.assert_allclose(search.best, problem.best, atol=0.02)
    joint = [np.all((point != search.start)[[0, 19]]) for point in problem.points[1:]]
    assert np.mean(joint) > 0.9


def test_begins_at_the_start_and_stops_at_the_limit_of_steps(quadratic, search_of):
    problem = quadratic(0)
    search = search_of(problem, 5, start=np.linspace(0.2, 0.7, 20))
    minimize_direct(search)
    np.testing.assert_array_equal(problem.points[0], search.start)
    assert len(search.history) == 5
    assert search.value_m2 < problem.value(search.start)
