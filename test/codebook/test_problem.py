"""Problem P1: variables, constraints and gradient, with the exact bound."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb
from rhs_isac_ros.codebook.problem import Problem
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import multipath_covariance


@pytest.fixture(scope='module')
def problem(small):
    return Problem(small.scenario, AverageCrlb(small.scenario, small.vectors['positions']))


def test_the_value_matches_the_test_vectors(case):
    problem = Problem(case.scenario, AverageCrlb(case.scenario, case.vectors['positions']))
    variables = problem.pack(case.codebook)
    expected = pytest.approx(float(case.vectors['average_crlb']), rel=1e-8)
    assert problem.value(variables) == expected
    assert problem.value_and_gradient(variables)[0] == expected


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


def test_the_gradient_agrees_with_finite_differences_of_plain_bounds(plain, random_beams):
    """The reference scales the combining vectors independently."""
    rng = np.random.default_rng(1)
    scenario = Scenario(
        center_frequencies_hz=(1.8e9, 2.9e9), n_subbands=2, n_frames=2, n_feeds=2,
        elements_per_side=3, max_power_w=0.02, roi_center_m=(3, 0, 0), roi_size_m=(2, 2, 2))
    positions = scenario.sample_positions(2, rng)
    spatial = multipath_covariance(scenario)
    problem = Problem(scenario, AverageCrlb(scenario, positions))
    start = random_beams(scenario, rng)
    # Move off the bounds, and change the scale of the combining vectors.
    start = dataclasses.replace(start, analog=0.1 + 0.8 * start.analog)
    variables = problem.pack(start)
    variables[problem.n_analog:] *= 1.9

    def bound(point):
        analog = point[:problem.n_analog].reshape(2, 2, 9)
        real, imag = point[problem.n_analog:].reshape(2, 2, 2, 2, 2)
        digital = real + 1j * imag
        for i in range(2):
            for q in range(2):
                digital[i, :, q] *= np.sqrt(0.02 / np.sum(np.abs(digital[i, :, q])**2))
        return plain(scenario, analog, digital).crlb(positions, spatial).mean()

    value, gradient = problem.value_and_gradient(variables)
    assert value == pytest.approx(bound(variables), rel=1e-7)
    for _ in range(4):
        direction = rng.normal(size=variables.shape)
        difference = (bound(variables + 1e-5 * direction)
                      - bound(variables - 1e-5 * direction)) / 2e-5
        assert gradient @ direction == pytest.approx(
            difference, abs=1e-5 * np.linalg.norm(gradient) * np.linalg.norm(direction))
