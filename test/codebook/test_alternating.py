"""Algorithm 1: the variables of each sub-problem, the steps, and the stopping rules."""

import numpy as np
import pytest

from rhs_isac_ros.codebook import methods
from rhs_isac_ros.codebook.methods import minimize_alternating


class Phase:
    """One call of the interior-point method."""

    def __init__(self, start, free, max_steps):
        self.start, self.free, self.max_steps = np.array(start), np.array(free), max_steps
        self.points, self.found = [], None


@pytest.fixture
def phases(monkeypatch):
    """Record the sub-problems with the points evaluated in each."""
    seen, minimize = [], methods.minimize_interior_point

    def spy(search, start, free, max_steps):
        phase = Phase(start, free, max_steps)
        seen.append(phase)
        evaluate = search.value_and_gradient

        def record(variables):
            phase.points.append(np.array(variables))
            return evaluate(variables)

        with monkeypatch.context() as patch:
            patch.setattr(search, 'value_and_gradient', record)
            phase.found = minimize(search, start, free, max_steps)
        return phase.found

    monkeypatch.setattr(methods, 'minimize_interior_point', spy)
    return seen


@pytest.mark.parametrize('seed', range(3))
def test_changes_only_analog_in_sp1_and_only_digital_in_sp2(quadratic, search_of, phases, seed):
    problem = quadratic(seed)
    search = search_of(problem, 80)
    minimize_alternating(search)
    assert len(phases) >= 4
    analog = np.arange(20) < 10
    for number, phase in enumerate(phases):
        changed = np.array(phase.points) != phase.start
        assert changed.any() or number >= 2
        # sP1 changes the configurations, sP2 the combining vectors.
        assert not changed[:, ~analog if number % 2 == 0 else analog].any()


def test_each_sub_problem_starts_at_the_best_point_of_the_last(quadratic, search_of, phases):
    problem = quadratic(1)
    search = search_of(problem, 80, start=np.linspace(0.2, 0.8, 20))
    minimize_alternating(search)
    np.testing.assert_array_equal(phases[0].start, search.start)
    for before, after in zip(phases, phases[1:], strict=False):
        np.testing.assert_array_equal(after.start, before.found)
        best = min(before.points, key=problem.value)
        assert problem.value(after.start) == problem.value(best)
    np.testing.assert_array_equal(phases[-1].found, search.best)


@pytest.mark.parametrize(('max_steps', 'each'), [(400, 50), (80, 10), (47, 5), (16, 2)])
def test_sub_problems_share_the_steps_evenly(quadratic, search_of, phases, max_steps, each):
    """Table I: 4 iterations with 50 steps each of sP1 and of sP2."""
    search = search_of(quadratic(2), max_steps)
    minimize_alternating(search)
    assert {phase.max_steps for phase in phases} == {each}
    assert len(phases) <= 8
    assert len(search.history) <= max_steps


def test_all_iterations_run_while_variables_change(quadratic, search_of):
    search = search_of(quadratic(3), 17)
    assert minimize_alternating(search) == '4 iterations of 2 x 2 steps'
    assert len(search.history) == 16


@pytest.mark.parametrize('max_steps', [1, 8, 15])
def test_a_few_steps_suffice_for_progress_and_are_not_exceeded(quadratic, search_of, max_steps):
    problem = quadratic(3)
    search = search_of(problem, max_steps)
    minimize_alternating(search)
    assert search.value_m2 < problem.value(search.start)
    assert len(search.history) <= max_steps


def test_stops_when_an_iteration_changes_nothing(flat, search_of, phases):
    assert minimize_alternating(search_of(flat, 80)) == 'iteration 1 changed nothing'
    assert len(phases) == 2


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


def test_finds_the_minimum_of_a_separable_function(quadratic, search_of):
    problem = quadratic(4)
    search = search_of(problem, 800)
    minimize_alternating(search)
    np.testing.assert_allclose(search.best, problem.best, atol=0.02)
