"""The chain rule from radiation matrices to a codebook, also for an estimated surface."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb, crlb
from rhs_isac_ros.model import MeasurementModel, MultipathEstimate, Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.hall import CONDITIONS, FIELDS
from rhs_isac_ros.model.surface import AppliedBeams


@pytest.fixture(scope='module')
def odd(random_beams):
    scenario = Scenario(
        center_frequencies_hz=(1.9e9, 3.3e9), n_subbands=3, n_frames=2, n_feeds=4,
        elements_per_side=3, subband_width_hz=2e7)
    return scenario, random_beams(scenario, np.random.default_rng(0))


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
def test_gradients_for_an_estimated_surface_are_slopes(average, random_beams, name):
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


def test_gradients_under_a_measured_covariance_are_difference_quotients(odd, random_beams):
    scenario, codebook = odd
    places = scenario.sample_positions(4, np.random.default_rng(4))
    hall = dataclasses.replace(scenario, angular_spread_deg=40.0, delay_spread_s=2e-8)
    other = random_beams(scenario, np.random.default_rng(5))
    declared, fields = MeasurementModel(scenario, other), scenario.fields()
    inverse = np.linalg.inv(declared.covariance())
    difference = MeasurementModel(hall, other).covariance() - declared.covariance()
    measured = dataclasses.replace(scenario, multipath=MultipathEstimate(
        *(fields[name] for name in FIELDS), np.array(declared.radiation),
        inverse @ difference @ inverse, {name: fields[name] for name in CONDITIONS}))
    cost = AverageCrlb(measured, places)
    gradient = cost(codebook)
    assert gradient.value == pytest.approx(np.mean(crlb(measured, codebook, places)))
    assert abs(gradient.value / AverageCrlb(scenario, places).value(codebook) - 1) > 0.01
    for name, index, unit in (('analog', (1, 0, 3), 1.0), ('digital', (0, 2, 1, 3), 1.0),
                              ('digital', (1, 0, 0, 2), 1j)):
        values, derivative = getattr(codebook, name), getattr(gradient, f'by_{name}')[index]
        step = np.zeros_like(values)
        step[index] = 1e-5 * np.abs(values).max() * unit
        ends = [cost.value(AppliedBeams(**{
            'analog': codebook.analog, 'digital': codebook.digital, name: values + sign * step}))
            for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * np.abs(step[index]))
        assert (derivative * np.conj(unit)).real == pytest.approx(expected, rel=1e-4)
