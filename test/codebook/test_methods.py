"""The optimisation methods, on functions with a known minimum and on small problems."""

import dataclasses
import itertools
import sys
from typing import NamedTuple

import numpy as np
import pytest

from rhs_isac_ros.codebook import (
    Codebook,
    CodebookError,
    directional_codebook,
    methods,
    optimize,
    random_codebook,
)
from rhs_isac_ros.codebook.objective import OBJECTIVES, ambiguity
from rhs_isac_ros.codebook.problem import BudgetSpent, Problem, Search
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import on_levels
from rhs_isac_ros.support.optional import MissingLibraryError

ALL = np.ones(20, bool)


def minimize_all(search):
    """The interior-point method on all variables."""
    methods.minimize_interior_point(search, search.start, ALL, search.max_steps)


class Case(NamedTuple):
    """A method, steps that suffice for the minimum, its accuracy, and the reason at the limit."""

    minimize: object
    steps: int
    tolerance: float
    at_limit: str | None


CASES = {
    'alternating': Case(methods.minimize_alternating, 800, 0.02, None),
    'direct': Case(methods.minimize_direct, 400, 0.02, '5 steps at most'),
    'interior point': Case(minimize_all, 400, 0.02, None),
    'lbfgs': Case(methods.minimize_exactly, 200, 1e-3, 'max_steps reached'),
}
GRADIENT = pytest.mark.parametrize('case', CASES.values(), ids=CASES)


@pytest.mark.slow
@GRADIENT
@pytest.mark.parametrize('seed', range(2))
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
@pytest.mark.parametrize('max_steps', [1, 5, 15])
def test_begins_at_the_start_and_stops_at_the_limit_of_steps(
        quadratic, search_of, case, max_steps):
    problem = quadratic(3)
    search = search_of(problem, max_steps, start=np.linspace(0.2, 0.7, 20))
    reason = case.minimize(search)
    np.testing.assert_array_equal(problem.points[0], search.start)
    assert len(search.history) <= max_steps
    assert search.value_m2 < problem.value(search.start)
    if case.minimize is not methods.minimize_alternating:
        assert len(search.history) == max_steps
    if max_steps == 5 and case.at_limit:
        assert reason == case.at_limit


@pytest.mark.slow
@pytest.mark.parametrize('unit', [2.0**-40, 2.0**10, 2.0**40])
@pytest.mark.parametrize('minimize', [methods.minimize_exactly, methods.minimize_direct])
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


@pytest.mark.parametrize('seed', range(2))
def test_changes_only_the_free_variables_and_finds_their_minimum(quadratic, search_of, seed):
    problem = quadratic(seed)
    free = np.random.default_rng(seed).uniform(size=20) < 0.5
    assert free[:10].any() and free[10:].any() and not free.all()
    start = np.linspace(0.3, 0.6, 20)
    found = methods.minimize_interior_point(search_of(problem, start=start), start, free, 400)
    assert len(problem.points) > 5
    for point in problem.points:
        np.testing.assert_array_equal(point[~free], start[~free])
    np.testing.assert_array_equal(found[~free], start[~free])
    np.testing.assert_allclose(found[free], problem.best[free], atol=0.02)


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


def test_changes_only_analog_in_sp1_and_only_digital_in_sp2(quadratic, search_of, sub_problems):
    """Each sub-problem starts at the best point of the last."""
    problem = quadratic(1)
    search = search_of(problem, 80, start=np.linspace(0.2, 0.8, 20))
    methods.minimize_alternating(search)
    assert len(sub_problems) >= 4
    np.testing.assert_array_equal(sub_problems[0].start, search.start)
    for before, after in itertools.pairwise(sub_problems):
        np.testing.assert_array_equal(after.start, before.found)
        assert problem.value(after.start) == min(map(problem.value, before.points))
    np.testing.assert_array_equal(sub_problems[-1].found, search.best)
    analog = np.arange(20) < 10
    for number, sub_problem in enumerate(sub_problems):
        changed = np.array(sub_problem.points) != sub_problem.start
        assert changed.any() or number >= 2
        # sP1 changes the configurations, sP2 the combining vectors.
        assert not changed[:, ~analog if number % 2 == 0 else analog].any()


@pytest.mark.parametrize(('max_steps', 'each'), [(400, 50), (47, 5)])
def test_sub_problems_share_the_steps_evenly(quadratic, search_of, sub_problems, max_steps, each):
    """Table I: 4 iterations with 50 steps each of sP1 and of sP2."""
    search = search_of(quadratic(2), max_steps)
    methods.minimize_alternating(search)
    assert {sub_problem.max_steps for sub_problem in sub_problems} == {each}
    assert len(sub_problems) <= 8
    assert len(search.history) <= max_steps


@pytest.mark.parametrize(('changing', 'calls'), [((), 2), ((0, 1, 2), 6), ((0, 3), 6), ((1,), 4)])
def test_a_change_in_one_sub_problem_suffices_to_continue(
        flat, search_of, monkeypatch, changing, calls):
    """Even numbers are sP1, odd numbers sP2."""
    seen = []

    def minimize(search, start, free, max_steps):
        seen.append(free)
        return start + 0.01 * free if len(seen) - 1 in changing else start

    monkeypatch.setattr(methods, 'minimize_interior_point', minimize)
    reason = methods.minimize_alternating(search_of(flat, 80))
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
    assert methods.minimize_genetic(search) == '6 generations'
    assert len(search.history) == 6
    values = [entry.value_m2 for entry in search.history]
    assert values == sorted(values, reverse=True)
    assert values[-1] < 0.9 * values[0]
    points = np.array(problem.points)
    assert points[:, :10].min() >= 0
    assert np.abs(points).max() <= 1
    # Configurations are at least 0, parts of combining vectors at least -1.
    assert points[:200, 10:].min() < -0.9


def test_the_generator_determines_all_points(quadratic, search_of, pymoo):
    def points(seed):
        problem = quadratic(0)
        methods.minimize_genetic(search_of(problem, 2, seed=seed))
        return np.array(problem.points)

    one, same, other = points(1), points(1), points(2)
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one[200:], other[200:])
    assert not np.array_equal(one[1:200], other[1:200])


# With 128 pairs each: 5120 pairs.
N_POSITIONS = 40
ROUNDS = ((500, 15), (1000, 15))


@pytest.fixture(scope='module')
def problem(scenario):
    positions = scenario.sample_positions(N_POSITIONS, np.random.default_rng(0))
    return Problem(scenario, ambiguity(scenario, positions, np.random.default_rng(1)))


@pytest.fixture
def search_from(problem, scenario):
    """Callable that returns a search from a random codebook, and the values of its samples."""
    def make(max_steps, max_evaluations=None):
        start = problem.pack(random_codebook(scenario, np.random.default_rng(0)))
        search = Search(
            problem, start, max_steps, max_evaluations, np.random.default_rng(2), None)
        search.begin()
        return search
    return make


@pytest.mark.slow
def test_samples_lead_to_the_value_that_all_pairs_lead_to(search_from):
    search, plain = search_from(120), search_from(60)
    methods.minimize_sampled(search, ROUNDS)
    methods.minimize_exactly(plain)
    start = search.history[0].value_m2
    assert plain.value_m2 < 0.6 * start
    assert search.value_m2 < plain.value_m2 + 0.05 * start


def test_the_value_is_that_of_all_pairs(search_from, problem):
    search = search_from(40)
    assert methods.minimize_sampled(search, ROUNDS) == 'max_steps reached'
    assert search.value_m2 == problem.value(search.best)
    assert len(search.history) == 41
    # The value falls at the end of a round, of which there are three.
    values = [entry.value_m2 for entry in search.history]
    falls = np.flatnonzero(np.diff(values)) + 1
    assert set(falls) <= {15, 30, 40}
    assert 15 in falls


@pytest.mark.parametrize('budget', [2, 3, 10, 25])
def test_the_last_evaluation_of_a_budget_is_with_all_pairs(search_from, budget, problem):
    search = search_from(1000, budget)
    with pytest.raises(BudgetSpent):
        methods.minimize_sampled(search, ROUNDS)
    search.finish()
    assert search.history[-1].evaluations <= budget
    assert search.value_m2 == problem.value(search.best)
    assert budget < 10 or search.value_m2 < search.history[0].value_m2


def test_ctrl_c_keeps_the_steps_of_an_unfinished_round(search_from, monkeypatch):
    search, evaluate, calls = search_from(1000), Problem.value_and_gradient, []

    def interrupted(self, *arguments, **options):
        calls.append(None)
        if len(calls) == 20:
            raise KeyboardInterrupt
        return evaluate(self, *arguments, **options)
    monkeypatch.setattr(Problem, 'value_and_gradient', interrupted)
    with pytest.raises(KeyboardInterrupt):
        methods.minimize_sampled(search)
    assert search.value_m2 < search.history[0].value_m2


def test_a_round_without_success_ends_the_search(search_from, monkeypatch):
    monkeypatch.setattr(methods, 'run_lbfgs', lambda *arguments: None)
    search = search_from(1000)
    assert 'no round' in methods.minimize_sampled(search)
    assert len(search.history) == 1


def test_optimize_uses_samples_of_many_pairs_only(scenario, monkeypatch):
    used = []
    monkeypatch.setattr(methods, 'minimize_sampled',
                        lambda search: used.append(search.problem.n_pairs) or 'done')
    for objective, n_positions in (('ambiguity', 16), ('crlb', N_POSITIONS)):
        optimize(scenario, objective=objective, n_positions=n_positions, max_steps=1)
    assert used == []
    optimize(scenario, objective='ambiguity', n_positions=N_POSITIONS, max_steps=1)
    assert used == [128 * N_POSITIONS]


SCENARIO = Scenario(n_subbands=2, n_frames=3, n_feeds=2, elements_per_side=6)
POSITIONS = SCENARIO.sample_positions(32, np.random.default_rng(0))


def with_levels(levels):
    return dataclasses.replace(SCENARIO, amplitude_levels=levels)


@pytest.fixture(scope='module')
def continuous():
    return optimize(SCENARIO, POSITIONS, max_steps=150)


def test_levels_are_equally_spaced_from_0_to_1():
    analog = np.linspace(0, 1, 101)
    for levels in (2, 3, 16):
        rounded = on_levels(with_levels(levels), analog)
        np.testing.assert_allclose(np.unique(rounded), np.arange(levels) / (levels - 1))
        assert np.abs(rounded - analog).max() <= 0.5 / (levels - 1) + 1e-12
    assert on_levels(SCENARIO, analog) is analog


@pytest.mark.slow
@pytest.mark.parametrize('levels', [2, 4])
def test_optimised_levels_beat_rounding(continuous, levels):
    scenario = with_levels(levels)
    result = optimize(scenario, POSITIONS, max_steps=200)
    result.codebook.check(scenario)
    values = np.unique(result.codebook.analog * (levels - 1))
    np.testing.assert_allclose(values, np.rint(values), atol=1e-12)
    found = result.history[-1].value_m2
    problem = Problem(scenario, OBJECTIVES['crlb'](scenario, POSITIONS, np.random.default_rng(0)))
    rounded = problem.pack(problem.unpack(problem.pack(continuous.codebook)))
    assert found < 0.85 * problem.value(rounded)
    # Combining vectors that are optimised for the rounded configurations do not make up for it.
    analog, digital = np.split(rounded, [problem.n_analog])

    def objective(digital):
        value, gradient = problem.value_and_gradient(np.concatenate([analog, digital]))
        return value, gradient[problem.n_analog:]

    best = methods.run_lbfgs(
        objective, digital, problem.bounds[problem.n_analog:], 200, lambda: None)
    assert found < 0.95 * objective(best.x)[0] < 0.95 * problem.value(rounded)
    assert continuous.history[-1].value_m2 < found
    assert result.codebook.average_crlb_m2 == pytest.approx(found, rel=2e-3)


@pytest.mark.slow
def test_the_penalty_moves_the_amplitudes_to_the_levels(monkeypatch):
    rounds, run_lbfgs = [], methods.run_lbfgs

    def recording(objective, *arguments):
        result = run_lbfgs(objective, *arguments)
        rounds.append((objective, result.x))
        return result

    monkeypatch.setattr(methods, 'run_lbfgs', recording)
    optimize(with_levels(3), POSITIONS, max_steps=100)
    n_analog = random_codebook(SCENARIO, np.random.default_rng(0)).analog.size

    def distance(variables):
        return np.abs(2 * variables[:n_analog] - np.rint(2 * variables[:n_analog])).mean()

    (_, relaxed), (objective, penalised) = rounds[0], rounds[5]
    assert distance(penalised) < 0.5 * distance(relaxed)
    point = relaxed.copy()
    point[:n_analog] = np.clip(point[:n_analog], 0.01, 0.99)
    step = 1e-6 * np.random.default_rng(0).normal(size=len(point))
    difference = objective(point + step)[0] - objective(point - step)[0]
    assert difference == pytest.approx(2 * objective(point)[1] @ step, rel=1e-4)


def test_the_result_is_a_local_minimum_over_single_exchanges():
    scenario = Scenario(n_subbands=2, n_frames=2, n_feeds=2, elements_per_side=3,
                        center_frequencies_hz=(3e9,), amplitude_levels=2)
    positions = scenario.sample_positions(8, np.random.default_rng(1))
    result = optimize(scenario, positions, max_steps=300)
    assert result.reason == 'no exchange of an amplitude lowers the objective'
    problem = Problem(scenario, OBJECTIVES['crlb'](scenario, positions, np.random.default_rng(0)))
    variables = problem.pack(result.codebook)
    best = problem.value(variables)
    assert best == pytest.approx(result.history[-1].value_m2, rel=1e-9)
    for entry in range(problem.n_analog):
        changed = variables.copy()
        changed[entry] = 1 - changed[entry]
        assert problem.value(changed) >= best


@pytest.mark.parametrize('max_steps', [1, 3, 6, 30])
def test_the_limit_of_steps_holds_in_every_phase(max_steps):
    result = optimize(with_levels(2), POSITIONS[:4], max_steps=max_steps)
    assert result.history[-1].step == max_steps
    assert result.reason == 'max_steps reached'


def test_starts_use_the_levels():
    scenario = with_levels(2)
    for codebook in (random_codebook(scenario, np.random.default_rng(0)),
                     directional_codebook(scenario)):
        codebook.check(scenario)
        assert set(np.unique(codebook.analog)) == {0.0, 1.0}


def test_other_amplitudes_do_not_fit():
    codebook, levels = random_codebook(SCENARIO, np.random.default_rng(0)), with_levels(3)
    codebook.check(SCENARIO)
    rounded = Codebook(on_levels(levels, codebook.analog), codebook.digital)
    rounded.check(levels)
    for one in (0.499, 0.501):
        analog = rounded.analog.copy()
        analog[0, 1, 2] = one
        with pytest.raises(CodebookError, match=rf'^analog: {one}, expected one of '
                                                'amplitude_levels = 3 levels from 0 to 1'):
            Codebook(analog, codebook.digital).check(levels)


@pytest.mark.parametrize('method', ['alternating', 'direct'])
def test_methods_for_continuous_amplitudes_are_refused(method):
    with pytest.raises(ValueError, match=f"^method: '{method}' with amplitude_levels = 2, "
                                         "expected 'lbfgs' or 'genetic'"):
        optimize(with_levels(2), POSITIONS[:4], method=method, max_steps=1)
