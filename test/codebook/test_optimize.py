"""Optimisation of codebooks, on a small scenario."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import METHODS, Codebook, CodebookError, optimize, random_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import multipath_covariance

STEPS = 30


@pytest.fixture(scope='module')
def scenario(small) -> Scenario:
    return dataclasses.replace(small.scenario, roi_center_m=(4, 0, 0), roi_size_m=(2, 4, 2))


@pytest.fixture(scope='module')
def run(scenario):
    """One optimisation, and what its progress callback was given."""
    seen = []
    positions = scenario.sample_positions(60, np.random.default_rng(0))
    result = optimize(scenario, positions, seed=3, max_steps=STEPS, progress=seen.append)
    return result, seen, positions


def test_bound_falls_strongly_also_on_other_positions(scenario, run):
    result, _, _ = run
    assert result.history[-1].value_m2 < 0.3 * result.history[0].value_m2
    held_out = scenario.sample_positions(400, np.random.default_rng(1))
    start = random_codebook(scenario, np.random.default_rng(3))
    optimised = crlb(scenario, result.codebook, held_out).mean()
    assert optimised < 0.3 * crlb(scenario, start, held_out).mean()


def test_best_codebook_is_feasible_and_has_the_value_it_claims(scenario, run, plain):
    result, _, positions = run
    result.codebook.check(scenario)
    p = plain(scenario, result.codebook.analog, result.codebook.digital)
    expected = p.crlb(positions, multipath_covariance(scenario)).mean()
    assert result.codebook.average_crlb_m2 == pytest.approx(expected, rel=1e-7)
    assert result.history[-1].value_m2 == result.codebook.average_crlb_m2
    assert 'seed 3' in result.codebook.provenance


def test_history_never_rises_and_is_what_progress_saw(run):
    result, seen, _ = run
    history = result.history
    assert list(history) == seen
    assert [entry.step for entry in history] == list(range(len(history)))
    for before, after in zip(history, history[1:], strict=False):
        assert after.value_m2 <= before.value_m2
        assert after.evaluations > before.evaluations
        assert after.elapsed_s >= before.elapsed_s


def test_stops_at_the_limit_of_steps(run, scenario):
    result, _, positions = run
    assert len(result.history) == STEPS + 1
    assert result.reason
    short = optimize(scenario, positions, seed=3, max_steps=2)
    assert len(short.history) == 3
    assert short.history[-1].value_m2 == result.history[2].value_m2


def test_keeps_the_best_point_of_a_method_that_wanders(small, monkeypatch):
    """The vectors' codebook is far better than one with nearly all elements switched off."""
    def wander(function, start, bounds, max_steps, on_step):
        assert len(bounds) == len(start)
        for scale in (0.5, 1.0, 0.01):
            function(np.concatenate([scale * start[:32], start[32:]]))
            on_step()
        return f'wandered, of {max_steps}'

    monkeypatch.setitem(METHODS, 'wander', wander)
    result = optimize(small.scenario, small.vectors['positions'], 'wander',
                      start=small.codebook, max_steps=7)
    np.testing.assert_array_equal(result.codebook.analog, small.codebook.analog)
    assert result.codebook.average_crlb_m2 == pytest.approx(
        float(small.vectors['average_crlb']), rel=1e-8)
    assert result.reason == 'wandered, of 7'
    assert len(result.history) == 4
    assert 'method wander' in result.codebook.provenance


def test_starts_from_the_given_codebook(small):
    result = optimize(
        small.scenario, small.vectors['positions'], start=small.codebook, max_steps=1)
    assert result.history[0].value_m2 == pytest.approx(
        float(small.vectors['average_crlb']), rel=1e-8)
    assert result.codebook.average_crlb_m2 < small.vectors['average_crlb']


def test_seed_decides_positions_and_start(scenario):
    one, same, other = (optimize(scenario, seed=seed, max_steps=2) for seed in (5, 5, 6))
    assert one.codebook.id == same.codebook.id
    assert one.codebook.id != other.codebook.id
    assert one.history[0].value_m2 == same.history[0].value_m2 != other.history[0].value_m2
    # The paper's number of samples.
    assert '1200 positions' in one.codebook.provenance


def test_all_methods_are_named_in_the_error_for_an_unknown_one(scenario):
    with pytest.raises(ValueError, match="method: 'magic', expected one of") as caught:
        optimize(scenario, method='magic')
    for method in METHODS:
        assert repr(method) in str(caught.value)


def test_a_start_that_does_not_fit_is_an_error(scenario, table1, small):
    with pytest.raises(CodebookError, match='analog: shape'):
        optimize(scenario, start=table1.codebook, max_steps=1)
    weak = Codebook(small.codebook.analog, small.codebook.digital / 2)
    with pytest.raises(CodebookError, match='digital: a frame has power'):
        optimize(scenario, start=weak, max_steps=1)


@pytest.mark.parametrize('positions', [np.zeros((0, 3)), [[1.0, 2.0]], [[np.nan, 0.0, 0.0]]])
def test_malformed_positions_are_errors(scenario, positions):
    with pytest.raises(ValueError, match='^positions: .*, expected '):
        optimize(scenario, np.array(positions), max_steps=1)


def test_an_undetermined_position_is_an_error_that_says_so():
    """One complex signal cannot give three coordinates: every codebook has an infinite bound."""
    scenario = Scenario(center_frequencies_hz=(2.5e9,), n_subbands=1, n_frames=1,
                        elements_per_side=3)
    with pytest.raises(ValueError, match='bound|position|infinite'):
        optimize(scenario, max_steps=1)
