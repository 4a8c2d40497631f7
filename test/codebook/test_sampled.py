"""Optimisation on samples of pairs, compared with plain L-BFGS-B on all pairs."""

import sys

import numpy as np
import pytest

from rhs_isac_ros.codebook import methods, optimize, random_codebook
from rhs_isac_ros.codebook.methods import minimize_lbfgs
from rhs_isac_ros.codebook.objective import ambiguity
from rhs_isac_ros.codebook.problem import BudgetSpent, Problem, Search

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


def test_samples_lead_to_the_value_that_all_pairs_lead_to(search_from):
    search, plain = search_from(120), search_from(60)
    methods.minimize_sampled(search, ROUNDS)
    minimize_lbfgs(plain)
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
    monkeypatch.setattr(sys.modules[optimize.__module__], 'minimize_sampled',
                        lambda search: used.append(search.problem.n_pairs) or 'done')
    for objective, n_positions in (('ambiguity', 16), ('crlb', N_POSITIONS)):
        optimize(scenario, objective=objective, n_positions=n_positions, max_steps=1)
    assert used == []
    optimize(scenario, objective='ambiguity', n_positions=N_POSITIONS, max_steps=1)
    assert used == [128 * N_POSITIONS]
