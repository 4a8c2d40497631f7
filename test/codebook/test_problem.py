"""Problem P1: variables and constraints; and the search: the best point, and repeated ones."""

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb
from rhs_isac_ros.codebook.problem import Problem


@pytest.fixture(scope='module')
def problem(small):
    return Problem(small.scenario, AverageCrlb(small.scenario, small.vectors['positions']))


def test_variables_are_configurations_then_combining_vectors(problem, small):
    variables = problem.pack(small.codebook)
    assert problem.n_analog == 32
    assert variables.shape == (32 + 2 * 12,)
    np.testing.assert_array_equal(variables[:32], small.vectors['analog'].ravel())
    digital = (variables[32:44] + 1j * variables[44:]).reshape(1, 3, 2, 2)
    np.testing.assert_allclose(digital, small.vectors['digital'] / np.sqrt(1e-3), rtol=1e-12)
    back = problem.unpack(variables)
    np.testing.assert_array_equal(back.analog, small.codebook.analog)
    np.testing.assert_allclose(back.digital, small.codebook.digital, rtol=1e-12)


def test_only_the_configurations_are_bounded(problem):
    assert problem.bounds == [(0.0, 1.0)] * 32 + [(None, None)] * 24


def test_any_variables_yield_a_feasible_codebook(problem, small):
    rng = np.random.default_rng(0)
    for scale in (1e-3, 1.0, 1e3):
        variables = scale * rng.normal(size=56)
        codebook = problem.unpack(variables)
        codebook.check(small.scenario)
        for q in range(2):
            power = sum(abs(codebook.digital[0, j, q, k])**2 for j in range(3) for k in range(2))
            assert power == pytest.approx(1e-3, rel=1e-12)
        expected = [min(max(value, 0.0), 1.0) for value in variables[:32]]
        np.testing.assert_array_equal(codebook.analog.ravel(), expected)


def test_the_scale_of_the_combining_vectors_has_no_effect(problem, small):
    variables = problem.pack(small.codebook)
    scaled = variables.copy()
    scaled[32:] *= 7.0
    np.testing.assert_allclose(
        problem.unpack(scaled).digital, problem.unpack(variables).digital, rtol=1e-12)
    value, gradient = problem.value_and_gradient(scaled)
    assert value == pytest.approx(float(small.vectors['average_crlb']), rel=1e-8)
    # The gradient has no component along the scale.
    assert abs(gradient[32:] @ scaled[32:]) < 1e-8 * np.linalg.norm(gradient[32:]) * 7


START = np.full(20, 0.5)


@pytest.mark.parametrize('seed', range(3))
def test_keeps_the_best_point_of_both_kinds_of_evaluation(quadratic, search_of, seed):
    problem, rng = quadratic(seed), np.random.default_rng(seed)
    search = search_of(problem)
    reference = quadratic(seed)
    best = None
    for n in range(30):
        point = rng.normal(size=20)
        if n % 2:
            value = search.value(point)
        else:
            value, gradient = search.value_and_gradient(point)
            np.testing.assert_array_equal(gradient, reference.value_and_gradient(point)[1])
        assert value == reference.value(point)
        if best is None or value < best[0]:
            best = value, point.copy()
        # A method may reuse the array.
        point[:] = 0
        assert search.value_m2 == best[0]
        np.testing.assert_array_equal(search.best, best[1])


def test_nan_is_never_the_best_value(flat, search_of):
    search = search_of(flat)
    search.value(START)
    flat.value = lambda variables: np.nan
    assert np.isnan(search.value(START + 1))
    assert search.value_m2 == 3.0
    np.testing.assert_array_equal(search.best, START)


def test_a_repeated_point_is_not_evaluated_again(quadratic, search_of):
    problem = quadratic(0)
    search = search_of(problem)
    point = START.copy()
    first = search.value_and_gradient(point)
    again = search.value_and_gradient(START)
    assert len(problem.points) == 1
    assert first[0] == again[0]
    np.testing.assert_array_equal(first[1], again[1])
    # A change in place makes it another point.
    point[3] = 0.25
    moved = search.value_and_gradient(point)
    assert len(problem.points) == 2
    assert moved[0] == quadratic(0).value(point)
