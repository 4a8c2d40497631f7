"""The optimisation methods, on functions with a known minimum."""

import sys
from typing import NamedTuple

import numpy as np
import pytest

from rhs_isac_ros.codebook import methods, optimize
from rhs_isac_ros.codebook.methods import (
    minimize_alternating,
    minimize_direct,
    minimize_genetic,
    minimize_interior_point,
    minimize_lbfgs,
)
from rhs_isac_ros.support.optional import MissingLibraryError

ALL = np.ones(20, bool)


def minimize_all(search):
    """The interior-point method on all variables."""
    minimize_interior_point(search, search.start, ALL, search.max_steps)


class Case(NamedTuple):
    """A method, steps that suffice for the minimum, its accuracy, and the reason at the limit."""

    minimize: object
    steps: int
    tolerance: float
    at_limit: str | None


CASES = {
    'alternating': Case(minimize_alternating, 800, 0.02, None),
    'direct': Case(minimize_direct, 400, 0.02, '5 steps at most'),
    'interior point': Case(minimize_all, 400, 0.02, None),
    'lbfgs': Case(minimize_lbfgs, 200, 1e-3, 'max_steps reached'),
}
GRADIENT = pytest.mark.parametrize('case', CASES.values(), ids=CASES)


@GRADIENT
@pytest.mark.parametrize('seed', range(3))
def test_finds_the_minimum_and_counts_every_evaluation(quadratic, search_of, case, seed):
    problem = quadratic(seed)
    search = search_of(problem, case.steps)
    case.minimize(search)
    np.testing.assert_allclose(search.best, problem.best, atol=case.tolerance)
    assert 2 < len(search.history) <= case.steps
    evaluations = [entry.evaluations for entry in search.history]
    assert evaluations == sorted(evaluations)
    assert evaluations[-1] <= len(problem.points)


@GRADIENT
@pytest.mark.parametrize('max_steps', [1, 5, 8, 15])
def test_begins_at_the_start_and_stops_at_the_limit_of_steps(
        quadratic, search_of, case, max_steps):
    problem = quadratic(3)
    search = search_of(problem, max_steps, start=np.linspace(0.2, 0.7, 20))
    reason = case.minimize(search)
    np.testing.assert_array_equal(problem.points[0], search.start)
    assert len(search.history) <= max_steps
    assert search.value_m2 < problem.value(search.start)
    if case.minimize is not minimize_alternating:
        assert len(search.history) == max_steps
    if max_steps == 5 and case.at_limit:
        assert reason == case.at_limit


@pytest.mark.parametrize('unit', [2.0**-40, 2.0**10, 2.0**40])
@pytest.mark.parametrize('minimize', [minimize_lbfgs, minimize_direct])
def test_the_unit_of_the_objective_does_not_matter(quadratic, search_of, minimize, unit):
    """In nanometres or in kilometres, the steps are the same."""
    class Scaled(quadratic):
        def value(self, variables):
            return unit * super().value(variables)

        def value_and_gradient(self, variables):
            value, gradient = super().value_and_gradient(variables)
            return value, unit * gradient

    plain, scaled = (make(2) for make in (quadratic, Scaled))
    reasons = [minimize(search_of(problem, 15)) for problem in (plain, scaled)]
    assert reasons[0] == reasons[1]
    np.testing.assert_allclose(scaled.points, plain.points, rtol=1e-9)


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


class SubProblem:
    """One call of the interior-point method."""

    def __init__(self, start, free, max_steps):
        self.start, self.free, self.max_steps = np.array(start), np.array(free), max_steps
        self.points, self.found = [], None


@pytest.fixture
def sub_problems(monkeypatch):
    """Record the sub-problems with the points evaluated in each."""
    seen, minimize = [], methods.minimize_interior_point

    def spy(search, start, free, max_steps):
        sub_problem = SubProblem(start, free, max_steps)
        seen.append(sub_problem)
        evaluate = search.value_and_gradient

        def record(variables):
            sub_problem.points.append(np.array(variables))
            return evaluate(variables)

        with monkeypatch.context() as patch:
            patch.setattr(search, 'value_and_gradient', record)
            sub_problem.found = minimize(search, start, free, max_steps)
        return sub_problem.found

    monkeypatch.setattr(methods, 'minimize_interior_point', spy)
    return seen


@pytest.mark.parametrize('seed', range(3))
def test_changes_only_analog_in_sp1_and_only_digital_in_sp2(
        quadratic, search_of, sub_problems, seed):
    problem = quadratic(seed)
    search = search_of(problem, 80)
    minimize_alternating(search)
    assert len(sub_problems) >= 4
    analog = np.arange(20) < 10
    for number, sub_problem in enumerate(sub_problems):
        changed = np.array(sub_problem.points) != sub_problem.start
        assert changed.any() or number >= 2
        # sP1 changes the configurations, sP2 the combining vectors.
        assert not changed[:, ~analog if number % 2 == 0 else analog].any()


def test_each_sub_problem_starts_at_the_best_point_of_the_last(quadratic, search_of, sub_problems):
    problem = quadratic(1)
    search = search_of(problem, 80, start=np.linspace(0.2, 0.8, 20))
    minimize_alternating(search)
    np.testing.assert_array_equal(sub_problems[0].start, search.start)
    for before, after in zip(sub_problems, sub_problems[1:], strict=False):
        np.testing.assert_array_equal(after.start, before.found)
        best = min(before.points, key=problem.value)
        assert problem.value(after.start) == problem.value(best)
    np.testing.assert_array_equal(sub_problems[-1].found, search.best)


@pytest.mark.parametrize(('max_steps', 'each'), [(400, 50), (80, 10), (47, 5), (16, 2)])
def test_sub_problems_share_the_steps_evenly(quadratic, search_of, sub_problems, max_steps, each):
    """Table I: 4 iterations with 50 steps each of sP1 and of sP2."""
    search = search_of(quadratic(2), max_steps)
    minimize_alternating(search)
    assert {sub_problem.max_steps for sub_problem in sub_problems} == {each}
    assert len(sub_problems) <= 8
    assert len(search.history) <= max_steps


def test_all_iterations_run_while_variables_change(quadratic, search_of):
    search = search_of(quadratic(3), 17)
    assert minimize_alternating(search) == '4 iterations of 2 x 2 steps'
    assert len(search.history) == 16


def test_stops_when_an_iteration_changes_nothing(flat, search_of, sub_problems):
    assert minimize_alternating(search_of(flat, 80)) == 'iteration 1 changed nothing'
    assert len(sub_problems) == 2


@pytest.mark.parametrize(('changing', 'calls'), [((0, 1, 2), 6), ((0, 3), 6), ((1,), 4)])
def test_a_change_in_one_sub_problem_suffices_to_continue(
        flat, search_of, monkeypatch, changing, calls):
    """Even numbers are sP1, odd numbers sP2."""
    seen = []

    def minimize(search, start, free, max_steps):
        seen.append(free)
        return start + 0.01 * free if len(seen) - 1 in changing else start

    monkeypatch.setattr(methods, 'minimize_interior_point', minimize)
    reason = minimize_alternating(search_of(flat, 80))
    assert len(seen) == calls
    assert reason == f'iteration {calls // 2} changed nothing'


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


def test_the_generator_determines_all_points(quadratic, search_of, pymoo):
    def points(seed):
        problem = quadratic(0)
        minimize_genetic(search_of(problem, 2, seed=seed))
        return np.array(problem.points)

    one, same, other = points(1), points(1), points(2)
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one[200:], other[200:])
    assert not np.array_equal(one[1:200], other[1:200])
