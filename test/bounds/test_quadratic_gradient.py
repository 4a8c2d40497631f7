"""Gradients for an estimated surface agree with finite differences."""

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.imperfections import AppliedBeams
from rhs_isac_ros.model.surface_estimate import SurfaceEstimate

SCENARIO = Scenario(elements_per_side=4, n_feeds=2, element_error_rms=0.1)
N_ELEMENTS = SCENARIO.n_elements


@pytest.fixture
def average():
    """The average bound for a surface with complex coefficients, failures and band gains."""
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(2, N_ELEMENTS, 2)) @ [1, 1j]
    failed = np.arange(N_ELEMENTS) % 7 == 0
    average = AverageCrlb(SCENARIO, SCENARIO.sample_positions(10, rng))
    average.surface = SurfaceEstimate(
        np.where(failed, 0, 1 + 0.3 * numbers[0]), np.where(failed, 0.5 + 0.1 * numbers[1], 0),
        np.array([1.2 + 0.3j, 0.8 - 0.1j]),
        0.1 * np.ones((2 * N_ELEMENTS + 2, 1), complex), failed.astype(float))
    return average


@pytest.mark.parametrize('name', ['analog', 'digital'])
def test_gradients_are_slopes(average, random_beams, name):
    beams, rng = random_beams(SCENARIO, np.random.default_rng(1)), np.random.default_rng(2)
    result = average(beams)
    assert result.value == pytest.approx(average.value(beams), rel=1e-12)
    start = getattr(beams, name)
    direction = rng.normal(size=start.shape) * np.abs(start).mean()
    if name == 'digital':
        direction = direction * np.exp(1j * rng.uniform(size=start.shape))
    gradient = result.by_analog if name == 'analog' else result.by_digital
    parts = AppliedBeams(beams.analog, beams.digital)
    ends = [average.value(parts._replace(**{name: start + step * direction}))
            for step in (-1e-5, 1e-5)]
    slope = np.sum(np.conj(direction) * gradient).real
    assert (ends[1] - ends[0]) / 2e-5 == pytest.approx(slope, rel=1e-4)
