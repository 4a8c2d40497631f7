"""Codebooks for elements that can take only a few amplitudes."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.codebook import (
    Codebook,
    CodebookError,
    directional_codebook,
    optimize,
    random_codebook,
)
from rhs_isac_ros.codebook.methods import run_lbfgs
from rhs_isac_ros.codebook.objective import OBJECTIVES
from rhs_isac_ros.codebook.problem import Problem
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import on_levels

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

    best = run_lbfgs(objective, digital, problem.bounds[problem.n_analog:], 200, lambda: None)
    assert found < 0.95 * objective(best.x)[0] < 0.95 * problem.value(rounded)
    assert continuous.history[-1].value_m2 < found
    assert result.codebook.average_crlb_m2 == pytest.approx(found, rel=2e-3)


def test_the_penalty_moves_the_amplitudes_to_the_levels(monkeypatch):
    rounds = []

    def recording(objective, *arguments):
        result = run_lbfgs(objective, *arguments)
        rounds.append((objective, result.x))
        return result

    monkeypatch.setattr('rhs_isac_ros.codebook.methods.run_lbfgs', recording)
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
                     directional_codebook(scenario, np.random.default_rng(0))):
        codebook.check(scenario)
        assert set(np.unique(codebook.analog)) == {0.0, 1.0}


def test_other_amplitudes_do_not_fit():
    codebook = random_codebook(SCENARIO, np.random.default_rng(0))
    codebook.check(SCENARIO)
    with pytest.raises(CodebookError, match=r'^analog: 0\.\d+, expected one of amplitude_levels = '
                                            '3 levels from 0 to 1'):
        codebook.check(with_levels(3))
    rounded = Codebook(on_levels(with_levels(3), codebook.analog), codebook.digital)
    rounded.check(with_levels(3))


@pytest.mark.parametrize('method', ['alternating', 'direct'])
def test_methods_for_continuous_amplitudes_are_refused(method):
    with pytest.raises(ValueError, match=f"^method: '{method}' with amplitude_levels = 2, "
                                         "expected 'lbfgs' or 'genetic'"):
        optimize(with_levels(2), POSITIONS[:4], method=method, max_steps=1)
