"""Optimisation of codebooks, on a small scenario."""

import dataclasses
import functools
import importlib.util
import re
import sys

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from rhs_isac_ros.bounds import crlb, rows
from rhs_isac_ros.bounds.rows import MeasurementRows
from rhs_isac_ros.codebook import (
    METHODS,
    OBJECTIVES,
    SAMPLINGS,
    Codebook,
    CodebookError,
    Provenance,
    directional_codebook,
    optimize,
    random_codebook,
)
from rhs_isac_ros.codebook.optimize import DEFAULT_POSITIONS, Method, _Report
from rhs_isac_ros.codebook.problem import Problem, Progress
from rhs_isac_ros.codebook.unoptimised import STARTS
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import multipath_covariance

STEPS = 30
# Ubuntu has no package of pymoo.
MARKS = {'genetic': pytest.mark.skipif(
    importlib.util.find_spec('pymoo') is None, reason='needs pymoo')}
# A new method needs a number of steps that suffices to lower every objective, but no test.
FEW_STEPS = {'alternating': 24, 'direct': 12, 'genetic': 2, 'lbfgs': 10}
SEARCHING = [pytest.param(name, marks=MARKS.get(name, ()))
             for name, method in METHODS.items() if method.minimize]
# The objective's rows are not exact, see ROW_TOLERANCE.
ABOUT = 1e-3


@pytest.fixture(scope='module')
def positions(scenario):
    return scenario.sample_positions(30, np.random.default_rng(0))


@pytest.fixture(scope='module')
def result(scenario, positions):
    return optimize(scenario, positions, seed=3, max_steps=STEPS)


class Evaluations(list):
    """Values and codebooks; Ctrl-C interrupts an evaluation."""

    interrupt_at: int | None = None


@pytest.fixture
def evaluated(monkeypatch):
    """Record all evaluations of the objective."""
    seen = Evaluations()
    for name in ('value', 'value_and_gradient'):
        def spy(problem, variables, *, evaluate):
            if len(seen) + 1 == seen.interrupt_at:
                raise KeyboardInterrupt
            outcome = evaluate(problem, variables)
            seen.append((outcome[0] if isinstance(outcome, tuple) else outcome,
                         problem.unpack(variables)))
            return outcome
        monkeypatch.setattr(Problem, name, functools.partialmethod(
            spy, evaluate=getattr(Problem, name)))
    return seen


def test_the_best_codebook_is_feasible_and_has_the_reported_bound(
        scenario, positions, result, plain):
    result.codebook.check(scenario)
    p = plain(scenario, result.codebook.analog, result.codebook.digital)
    expected = p.crlb(positions, multipath_covariance(scenario)).mean()
    assert result.codebook.average_crlb_m2 == pytest.approx(expected, rel=1e-7)
    assert result.history[-1].value_m2 == pytest.approx(expected, rel=ABOUT)


def test_the_provenance_contains_arguments_and_progress(scenario, result):
    end = result.history[-1]
    assert Provenance.parse(result.codebook.provenance) == Provenance(
        method='lbfgs', objective='crlb', seed=3, sampling='given', positions=30,
        scenario=scenario.changes(), steps=STEPS, evaluations=end.evaluations,
        value_m2=end.value_m2, reason=result.reason)


def assert_consistent(history):
    assert [entry.step for entry in history] == list(range(len(history)))
    for before, after in zip(history, history[1:], strict=False):
        assert after.value_m2 <= before.value_m2
        assert after.evaluations >= before.evaluations
        assert after.elapsed_s >= before.elapsed_s


# A method sees values and gradients alone, so that one objective suffices.
@pytest.mark.parametrize(('method', 'objective'), [
    *(pytest.param(*one.values, 'crlb', marks=one.marks) for one in SEARCHING),
    *(('lbfgs', objective) for objective in OBJECTIVES if objective != 'crlb')])
def test_every_method_lowers_an_objective_and_every_objective_is_lowered(
        scenario, positions, method, objective, evaluated):
    seen = []
    result = optimize(scenario, positions, method, objective=objective, seed=3,
                      max_steps=FEW_STEPS[method], progress=seen.append)
    assert result.history[-1].value_m2 < 0.9 * result.history[0].value_m2
    result.codebook.check(scenario)
    assert list(result.history) == seen
    assert_consistent(result.history)
    assert len(result.history) <= FEW_STEPS[method] + 1
    # Every evaluation is counted, and the result is the best.
    assert result.history[-1].evaluations == len(evaluated)
    made = Provenance.parse(result.codebook.provenance)
    assert (made.method, made.objective) == (method, objective)
    assert made.evaluations == len(evaluated)
    assert made.value_m2 == result.history[-1].value_m2
    exact = crlb(scenario, result.codebook, positions).mean()
    assert result.codebook.average_crlb_m2 == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize('method', ['direct', 'lbfgs'])
def test_methods_of_scipy_run_its_blas_with_one_thread(scenario, positions, method):
    seen = []

    def record(_):
        libraries = ThreadpoolController().select(user_api='blas').lib_controllers
        seen.append({library.get_num_threads() for library in libraries})

    with threadpool_limits(3, user_api='blas'):
        for library in ThreadpoolController().select(user_api='blas').lib_controllers:
            getattr(library, 'clear_controlling_thread', lambda: None)()
        optimize(scenario, positions, method, seed=3, max_steps=2, progress=record)
    assert seen[-1] == {1}


@pytest.mark.parametrize('budget', [1, 5])
@pytest.mark.parametrize('method', SEARCHING)
def test_a_budget_of_evaluations_ends_every_method(
        scenario, positions, method, budget, evaluated):
    result = optimize(
        scenario, positions, method, seed=3, max_steps=100, max_evaluations=budget)
    assert result.reason == 'max_evaluations reached'
    assert len(evaluated) == budget
    assert result.history[-1].evaluations == budget
    assert_consistent(result.history)
    result.codebook.check(scenario)


@pytest.mark.parametrize('method', SEARCHING)
@pytest.mark.parametrize('at', [2, 12])
def test_an_interrupt_returns_the_best_so_far(scenario, positions, method, at, evaluated):
    evaluated.interrupt_at = at
    result = optimize(scenario, positions, method, seed=3, max_steps=100)
    assert result.reason == 'interrupted'
    assert len(evaluated) == at - 1
    assert Provenance.parse(result.codebook.provenance).reason == 'interrupted'
    assert result.codebook.id == min(evaluated, key=lambda entry: entry[0])[1].id


@pytest.mark.parametrize('objective', ['ambiguity', 'crlb'])
def test_progress_is_reported_while_the_objective_is_set_up(
        scenario, positions, objective, monkeypatch):
    monkeypatch.setattr(_Report, '_TICK_S', 0.0)
    seen = []
    result = optimize(scenario, positions, objective=objective, seed=3, max_steps=2,
                      progress=seen.append)
    (first, *_), steps = seen, len(result.history)
    assert (first.step, first.evaluations, first.value_m2) == (0, 0, np.inf)
    assert seen[-steps:] == list(result.history)
    assert all(entry.value_m2 == np.inf for entry in seen[:-steps])
    elapsed = [entry.elapsed_s for entry in seen[:-steps]]
    assert elapsed == sorted(elapsed)


@pytest.mark.parametrize('kept', [False, True])
def test_an_interrupt_of_the_set_up_returns_the_start(scenario, positions, kept, monkeypatch):
    """Rows that are kept are computed with the first evaluation."""
    monkeypatch.setattr(_Report, '_TICK_S', 0.0)
    if kept:
        monkeypatch.setattr(rows, '_rank_of_some', lambda *_: 1 << 20)
    start, calls = directional_codebook(scenario), []

    def interrupt(entry):
        calls.append(entry)
        if len(calls) == 1:
            raise KeyboardInterrupt

    result = optimize(scenario, positions, seed=3, start=start, progress=interrupt)
    assert result.reason == 'interrupted'
    assert len(result.history) == 1
    np.testing.assert_array_equal(result.codebook.analog, start.analog)
    np.testing.assert_allclose(result.codebook.digital, start.digital, rtol=1e-12)


def test_keep_receives_the_results_so_far(scenario, positions, monkeypatch):
    monkeypatch.setattr(_Report, '_KEEP_S', 0.0)
    kept, seen = [], []
    result = optimize(scenario, positions, seed=3, max_steps=6, progress=seen.append,
                      keep=kept.append)
    assert list(result.history) == seen
    assert [len(partial.history) for partial in kept] == list(range(1, 8))
    for partial in kept:
        assert partial.reason == 'not finished'
        assert partial.history == result.history[:len(partial.history)]
        partial.codebook.check(scenario)
        end = partial.history[-1]
        made = Provenance.parse(partial.codebook.provenance)
        assert (made.steps, made.evaluations, made.value_m2, made.reason) == (
            end.step, end.evaluations, end.value_m2, 'not finished')
    assert kept[-1].codebook.id == result.codebook.id


def test_keep_is_called_at_most_every_ten_seconds():
    def entry(elapsed_s):
        return Progress(0, 0, 1.0, elapsed_s)
    report, kept = _Report(None, entry(0.0)), []
    report(entry(30.0))
    report.keep = lambda: kept.append(elapsed_s)
    for elapsed_s in (9.9, 10.0, 19.9, 21.0, 30.0, 31.0):
        report(entry(elapsed_s))
    assert kept == [10.0, 21.0, 31.0]


def test_returns_the_best_point_of_a_method_that_ends_elsewhere(small, monkeypatch):
    """The codebook of the test vectors is far better than one with nearly all elements off."""
    def drift(search):
        assert len(search.bounds) == len(search.start)
        for scale in (0.5, 1.0, 0.01):
            search.value_and_gradient(
                np.concatenate([scale * search.start[:32], search.start[32:]]))
            search.on_step()
        return f'drifted, of {search.max_steps}'

    monkeypatch.setitem(METHODS, 'drift', Method(drift, 9))
    result = optimize(small.scenario, small.vectors['positions'], 'drift',
                      start=small.codebook, max_steps=7)
    np.testing.assert_array_equal(result.codebook.analog, small.codebook.analog)
    assert result.codebook.average_crlb_m2 == pytest.approx(
        float(small.vectors['average_crlb']), rel=1e-8)
    assert result.reason == 'drifted, of 7'
    assert len(result.history) == 4
    assert 'method=drift' in result.codebook.provenance
    by_default = optimize(small.scenario, small.vectors['positions'], 'drift')
    assert by_default.reason == 'drifted, of 9'


@pytest.mark.parametrize(
    ('method', 'levels'), [('lbfgs', 0), ('lbfgs', 2), ('direct', 0), ('alternating', 0)])
def test_elements_that_are_off_in_all_frames_of_a_given_start_stay_off(
        scenario, positions, method, levels):
    start, masked = random_codebook(scenario, np.random.default_rng(0)), [0, 3, 5]
    on = np.ones(start.analog.shape, bool)
    on[..., masked] = on[0, 0, 7] = False
    start = dataclasses.replace(start, analog=on * start.analog)
    scenario = dataclasses.replace(scenario, amplitude_levels=levels)
    result = optimize(
        scenario, positions, method, start=start, max_steps=FEW_STEPS[method] + 10 * levels)
    assert result.history[-1].value_m2 < result.history[0].value_m2
    analog = result.codebook.analog
    assert not analog[..., masked].any()
    assert analog[..., 7].any()
    again = optimize(scenario, positions, method, resume=result.codebook,
                     max_steps=2 * FEW_STEPS[method] + 10 * levels)
    assert not again.codebook.analog[..., masked].any()


@pytest.mark.parametrize('max_steps', [None, 5])
@pytest.mark.parametrize('method', ['random', 'directional'])
def test_methods_without_a_search_return_the_start_and_set_up_no_objective(
        scenario, positions, method, max_steps, small, monkeypatch):
    first = optimize(scenario, positions, 'lbfgs', seed=2, max_steps=1).history[0]
    monkeypatch.setattr(MeasurementRows, '__init__', None)
    result = optimize(scenario, positions, method, seed=2, max_steps=max_steps)
    assert result.reason == 'nothing to optimise'
    assert len(result.history) == 1
    assert result.history[0].evaluations == 0
    assert result.history[0].value_m2 == result.codebook.average_crlb_m2
    expected = STARTS[method](scenario, np.random.default_rng(0), None)
    np.testing.assert_allclose(result.codebook.digital, expected.digital, rtol=1e-12)
    if method == 'directional':
        np.testing.assert_array_equal(result.codebook.analog, expected.analog)
    else:
        # Every method starts from it by default.
        assert result.history[0].value_m2 == pytest.approx(first.value_m2, rel=2 * ABOUT)
    given = optimize(scenario, positions, method, start=small.codebook)
    np.testing.assert_array_equal(given.codebook.analog, small.codebook.analog)


def test_the_seed_determines_positions_and_start(scenario):
    one, same, other = (optimize(scenario, seed=seed, max_steps=2) for seed in (5, 5, 6))
    assert one.codebook.id == same.codebook.id
    assert one.codebook.id != other.codebook.id
    assert one.history[0].value_m2 == same.history[0].value_m2 != other.history[0].value_m2
    made = Provenance.parse(one.codebook.provenance)
    assert (made.seed, made.positions, made.sampling) == (
        5, DEFAULT_POSITIONS, 'sobol')


def test_sampling_and_number_determine_the_positions(scenario, small):
    bounds = set()
    for sampling in SAMPLINGS:
        for n in (3, 50):
            result = optimize(scenario, method='random', sampling=sampling, n_positions=n,
                              start=small.codebook)
            made = Provenance.parse(result.codebook.provenance)
            assert (made.sampling, made.positions) == (sampling, n)
            bounds.add(result.codebook.average_crlb_m2)
    assert len(bounds) == 4


def steps_of(history):
    return [(entry.step, entry.evaluations) for entry in history]


@pytest.mark.parametrize('method', SEARCHING)
def test_a_result_can_be_resumed(scenario, positions, method):
    half = max(FEW_STEPS[method] // 2, 1)
    first = optimize(scenario, positions, method, seed=3, max_steps=half)
    saved = Codebook.from_parameters(first.codebook.to_parameters())
    second = optimize(
        scenario, positions, method, seed=3, max_steps=5 * half, resume=saved)
    end, begin = first.history[-1], second.history[0]
    assert begin.step == end.step
    # The evaluation of the start is not counted twice.
    assert begin.evaluations == end.evaluations
    assert begin.value_m2 == pytest.approx(end.value_m2, rel=1e-7)
    assert steps_of(second.history) == sorted(steps_of(second.history))
    assert second.history[-1].step <= 5 * half
    assert second.history[-1].value_m2 < begin.value_m2
    assert Provenance.parse(second.codebook.provenance).steps == second.history[-1].step


def test_the_budget_includes_the_evaluations_of_the_resumed_run(scenario, positions, evaluated):
    first = optimize(scenario, positions, seed=3, max_steps=50, max_evaluations=5)
    second = optimize(scenario, positions, seed=3, max_steps=50, max_evaluations=9,
                      resume=first.codebook)
    assert len(evaluated) == 10
    assert second.history[-1].evaluations == 9
    assert second.reason == 'max_evaluations reached'


def test_a_result_of_other_arguments_cannot_be_resumed(scenario, positions, result):
    for arguments, words in [
            ({'seed': 4}, 'seed: 4, expected 3'),
            ({'method': 'direct'}, "method: 'direct', expected 'lbfgs'"),
            ({'objective': 'ambiguity'}, "objective: 'ambiguity', expected 'crlb'"),
            ({'positions': positions[1:]}, 'positions: 29, expected 30'),
            ({'positions': None}, "sampling: 'sobol', expected 'given'"),
            ({'start': result.codebook}, 'start: not allowed with resume'),
            ({'resume': random_codebook(scenario, np.random.default_rng(0))},
             "resume: provenance 'random', expected that of an optimisation")]:
        original = {'positions': positions, 'seed': 3, 'resume': result.codebook,
                    'max_steps': 40}
        with pytest.raises(ValueError) as caught:
            optimize(scenario, **(original | arguments))
        assert str(caught.value).startswith(words)


@pytest.mark.parametrize(('arguments', 'error'), [
    *(({name: 'magic'}, f"{name}: 'magic', expected one of {re.escape(str(sorted(known)))}")
      for name, known in (('method', METHODS), ('objective', OBJECTIVES),
                          ('sampling', SAMPLINGS))),
    *(({name: low - 1}, f'{name}: {low - 1}, expected at least {low}') for name, low in (
        ('n_positions', 1), ('max_steps', 1), ('max_evaluations', 1), ('seed', 0))),
    ({'positions': np.zeros((0, 3))}, 'positions: none, expected at least one'),
    *(({'positions': np.ones((1, 3)), **given}, 'sampling and n_positions: not allowed with .*')
      for given in ({'n_positions': 9}, {'sampling': 'monte_carlo'}))])
def test_an_invalid_argument_is_an_error(scenario, arguments, error):
    with pytest.raises(ValueError, match=f'^{error}$'):
        optimize(scenario, **arguments)


def test_a_start_that_does_not_fit_is_an_error(scenario, table1, small):
    with pytest.raises(CodebookError, match=r'^analog: shape .*, expected \[N_B, F, N_E\] = '):
        optimize(scenario, start=table1.codebook, max_steps=1)
    weak = Codebook(small.codebook.analog, small.codebook.digital / 2)
    with pytest.raises(CodebookError, match='^digital: a frame has power .*, expected max_power'):
        optimize(scenario, start=weak, max_steps=1)


@pytest.mark.parametrize('objective', OBJECTIVES)
def test_one_position_in_a_flat_region_and_a_rectangular_surface_suffice(scenario, objective):
    flat = dataclasses.replace(scenario, roi_size_m=(*scenario.roi_size_m[:2], 0.0),
                               elements_per_side=(6, 3))
    result = optimize(flat, n_positions=1, objective=objective, max_steps=5)
    result.codebook.check(flat)
    assert result.history[-1].value_m2 < result.history[0].value_m2


def test_a_position_that_the_signals_do_not_determine_is_an_error():
    """One complex signal cannot determine three coordinates, so every bound is infinite."""
    scenario = Scenario(center_frequencies_hz=(2.5e9,), n_subbands=1, n_frames=1,
                        elements_per_side=3)
    with pytest.raises(ValueError, match='bound|position|infinite'):
        optimize(scenario, max_steps=1)


def test_importing_needs_no_pymoo_and_no_slow_part_of_scipy():
    """Most users of a codebook do not optimise one, and most nodes locate nobody."""
    import subprocess
    code = ("import sys, rhs_isac_ros.experiments.sweep, rhs_isac_ros.positioning\n"
            "print([n for n in ('pymoo', 'scipy.optimize', 'scipy.special', 'scipy.stats')\n"
            "       if n in sys.modules])")
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=240, check=True)
    assert done.stdout.strip() == '[]'
