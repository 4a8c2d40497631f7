"""Objectives: values from the plain equations, and gradients."""

import dataclasses
import math

import numpy as np
import pytest

from rhs_isac_ros.bounds import PairwiseErrorCost, crlb
from rhs_isac_ros.codebook import OBJECTIVES, objective, optimize, random_codebook
from rhs_isac_ros.codebook.objective import (
    WIDE,
    ambiguity,
    average_bound,
    confusable_volumes,
    draw_confusable,
)
from rhs_isac_ros.codebook.problem import Problem
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import multipath_covariance


def test_average_bound_matches_the_test_vectors(case):
    """To the accuracy of its rows, whose errors do not average out over six positions."""
    bound = average_bound(
        case.scenario, case.vectors['positions'], np.random.default_rng(0))
    value, by_analog, by_digital = bound(case.codebook)
    assert value == bound.value(case.codebook)
    assert value == pytest.approx(float(case.vectors['average_crlb']), rel=3e-3)
    for gradient, name in ((by_analog, 'grad_analog'), (by_digital, 'grad_digital')):
        wanted = case.vectors[name]
        assert np.linalg.norm(gradient - wanted) < 0.03 * np.linalg.norm(wanted)


def test_the_relative_error_of_the_average_bound_is_below_a_thousandth(table1, shipped):
    scenario = table1.scenario
    positions = scenario.sample_positions(200, np.random.default_rng(0))
    bound = average_bound(scenario, positions, np.random.default_rng(0))
    for codebook in (shipped, random_codebook(scenario, np.random.default_rng(1))):
        exact = crlb(scenario, codebook, positions).mean()
        assert bound.value(codebook) == pytest.approx(exact, rel=1e-3)


@pytest.mark.parametrize('seed', range(3))
def test_ambiguity_is_the_pairwise_error_cost_of_the_plain_equations(
        scenario, plain, random_beams, seed, monkeypatch):
    """|p - p'|^2 Q(sqrt(q / 2)), with five pairs for each position."""
    monkeypatch.setattr(objective, '_PAIRS_PER_POSITION', 5)
    rng = np.random.default_rng(seed)
    codebook, positions = random_beams(scenario, rng), scenario.sample_positions(4, rng)
    value = ambiguity(scenario, positions, np.random.default_rng(seed)).value(codebook)
    firsts = np.array([position for position in positions for _ in range(5)])
    seconds = draw_confusable(scenario, firsts, np.random.default_rng(seed))
    p = plain(scenario, codebook.analog, codebook.digital)
    inverse = np.linalg.inv(p.covariance(0, multipath_covariance(scenario)[0]))
    total = 0.0
    for a, b in zip(firsts, seconds, strict=True):
        difference = p.mean(a, 0) - p.mean(b, 0)
        q = (difference.conj() @ inverse @ difference).real
        total += np.sum((a - b)**2) * math.erfc(math.sqrt(q / 2) / math.sqrt(2)) / 2
    assert value == pytest.approx(total / 20, rel=1e-3)


PHASES = {'phase_std_rad': 0.4, 'band_phase_std_rad': 0.8}


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize(('name', 'phases'), [
    *((name, {}) for name in OBJECTIVES), ('ambiguity', PHASES), ('error', PHASES)])
def test_gradients_agree_with_finite_differences(name, phases, random_beams, seed):
    rng = np.random.default_rng(seed)
    scenario = Scenario(
        **phases, center_frequencies_hz=(1.8e9, 2.9e9), n_subbands=2, n_frames=2, n_feeds=2,
        elements_per_side=3, max_power_w=0.02, roi_center_m=(3, 0, 0), roi_size_m=(2, 2, 2))
    problem = Problem(scenario, OBJECTIVES[name](
        scenario, scenario.sample_positions(12, rng), rng))
    variables = problem.pack(random_beams(scenario, rng))
    # Move off the bounds, and change the scale of the combining vectors.
    variables[:problem.n_analog] = 0.1 + 0.8 * variables[:problem.n_analog]
    variables[problem.n_analog:] *= 1.9
    value, gradient = problem.value_and_gradient(variables)
    assert value == pytest.approx(problem.value(variables), rel=1e-12)
    # The phases are found by iteration.
    tolerance = 3e-5 if phases else 1e-5
    for _ in range(4):
        direction = rng.normal(size=variables.shape)
        difference = (problem.value(variables + 1e-5 * direction)
                      - problem.value(variables - 1e-5 * direction)) / 2e-5
        assert gradient @ direction == pytest.approx(
            difference, abs=tolerance * np.linalg.norm(gradient) * np.linalg.norm(direction))


def test_error_weights_pairs_by_a_power_of_their_volumes(scenario, random_beams, monkeypatch):
    monkeypatch.setattr(objective, '_PAIRS_PER_POSITION', 5)
    rng = np.random.default_rng(0)
    codebook, positions = random_beams(scenario, rng), scenario.sample_positions(4, rng)
    value = OBJECTIVES['error'](scenario, positions, np.random.default_rng(1)).value(codebook)
    firsts = np.repeat(positions, 5, axis=0)
    seconds = draw_confusable(scenario, firsts, np.random.default_rng(1), WIDE)
    volumes = confusable_volumes(scenario, firsts, seconds, WIDE)
    costs = np.array([PairwiseErrorCost(scenario, a[None], b[None]).value(codebook)
                      for a, b in zip(firsts, seconds, strict=True)])
    expected = np.sum(volumes**0.6 * costs) / np.sum(volumes**0.6)
    assert value == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize('name', ['ambiguity', 'error'])
@pytest.mark.parametrize(('change', 'greater'), [
    ({'band_phase_std_rad': 2 * np.pi}, 1.05), ({'phase_std_rad': 2 * np.pi}, 1.0)])
def test_unknown_phases_raise_the_cost_of_confusions(
        scenario, random_beams, name, change, greater):
    codebook = random_beams(scenario, np.random.default_rng(0))
    positions = scenario.sample_positions(20, np.random.default_rng(1))
    known, unknown = (OBJECTIVES[name](world, positions, np.random.default_rng(2)).value(codebook)
                      for world in (scenario, dataclasses.replace(scenario, **change)))
    assert unknown > greater * known


def test_optimising_the_ambiguity_lowers_it_on_held_out_pairs(scenario):
    result = optimize(scenario, method='lbfgs', objective='ambiguity', n_positions=128, seed=1,
                      max_steps=30)
    rng = np.random.default_rng(99)
    firsts = scenario.sample_positions(1500, rng)
    held_out = PairwiseErrorCost(scenario, firsts, draw_confusable(scenario, firsts, rng))
    start = random_codebook(scenario, np.random.default_rng(1))
    bound = optimize(scenario, n_positions=128, seed=1, max_steps=30)
    found = held_out.value(result.codebook)
    assert found < 0.8 * held_out.value(start)
    # Optimising the bound is a different goal.
    assert found < held_out.value(bound.codebook)
    assert bound.codebook.average_crlb_m2 < result.codebook.average_crlb_m2


@pytest.mark.parametrize('name', OBJECTIVES)
def test_the_generator_determines_the_random_pairs(scenario, small, name):
    positions = scenario.sample_positions(5, np.random.default_rng(0))
    one, same, other = (
        OBJECTIVES[name](scenario, positions, np.random.default_rng(seed)).value(small.codebook)
        for seed in (1, 1, 2))
    assert one == same
    assert (one == other) == (name not in ('ambiguity', 'error'))


@pytest.mark.parametrize('name', OBJECTIVES)
def test_an_empty_sample_is_an_error(small, name):
    with pytest.raises(ValueError, match='expected .*at least one'):
        OBJECTIVES[name](small.scenario, np.zeros((0, 3)), np.random.default_rng(0))


def test_nuisance_is_the_bound_with_unknown_phases_and_the_region_as_prior(table1):
    positions = table1.vectors['positions']
    value = OBJECTIVES['nuisance'](
        table1.scenario, positions, np.random.default_rng(0)).value(table1.codebook)
    unknown = dataclasses.replace(table1.scenario, band_phase_std_rad=2 * np.pi)
    expected = crlb(unknown, table1.codebook, positions, region_prior=True).mean()
    assert value == pytest.approx(expected, rel=1e-3)
    assert value > crlb(
        table1.scenario, table1.codebook, positions, region_prior=True).mean()
