"""Nuisance parameters: factors of the signals, their derivatives and draws."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import MeasurementModel, Scenario, streams
from rhs_isac_ros.model.nuisance import (
    draw_nuisance,
    draw_user_cycle,
    nuisance_directions,
    nuisance_factors,
    nuisance_parameters,
    nuisance_patterns,
)

DECLARED = {
    'user_gain_std_db': 2.0, 'carrier_offset_std_hz': 700.0, 'phase_std_rad': 0.4,
    'timing_std_s': 30e-9, 'band_phase_std_rad': 0.7}


@pytest.fixture(scope='module')
def uncertain(table1) -> Scenario:
    return dataclasses.replace(table1.scenario, **DECLARED)


def test_table_1_declares_none(table1):
    assert nuisance_parameters(table1.scenario) == ()
    assert nuisance_patterns(table1.scenario).shape == (0, 2, 32)
    mean = np.ones((3, 2, 32), complex)
    assert nuisance_directions(table1.scenario, mean).shape == (3, 0, 2, 32)
    assert draw_nuisance(table1.scenario, 5, np.random.default_rng(0)).shape == (5, 0)
    assert np.array_equal(nuisance_factors(table1.scenario, np.zeros((3, 0))), mean)


def test_parameters_name_unit_std_and_scope(uncertain):
    found = [(p.name, p.unit, p.band, p.per_user) for p in nuisance_parameters(uncertain)]
    assert found == [
        ('gain', '1', None, True), ('carrier_offset', 'Hz', None, True),
        ('phase', 'rad', None, False), ('timing', 's', None, False),
        ('band_phase', 'rad', 0, False), ('band_phase', 'rad', 1, False)]
    stds = [p.std for p in nuisance_parameters(uncertain)]
    assert stds == pytest.approx([2 * np.log(10) / 20, 700.0, 0.4, 30e-9, 0.7, 0.7])


def test_factors_written_out_for_one_measurement(uncertain):
    values = np.array([[0.1, 500.0, 0.3, 2e-8, -0.2, 0.6]])
    factor = nuisance_factors(uncertain, values).reshape(2, 8, 4)
    offset_hz = (6 - 3.5) * uncertain.subband_width_hz
    expected = np.exp(0.1 + 1j * (
        2 * np.pi * 500.0 * 3 * uncertain.frame_duration_s + 0.3
        - 2 * np.pi * offset_hz * 2e-8 + 0.6))
    assert factor[1, 6, 3] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize('shape', [(6,), (2, 5), (2, 7)])
def test_values_of_another_shape_are_an_error(uncertain, shape):
    with pytest.raises(ValueError, match=r'^values: shape \(.*\), expected \[N, Q\] with Q = 6$'):
        nuisance_factors(uncertain, np.zeros(shape))


def test_directions_match_finite_differences(uncertain, shipped):
    model = MeasurementModel(uncertain, shipped)
    mean = model.mean(uncertain.sample_positions(3, np.random.default_rng(1)))
    directions = nuisance_directions(uncertain, mean)
    for index, parameter in enumerate(nuisance_parameters(uncertain)):
        step = np.zeros((1, directions.shape[1]))
        step[0, index] = 1e-4 * parameter.std
        numeric = (nuisance_factors(uncertain, step) - nuisance_factors(uncertain, -step)) * mean
        numeric /= 2 * step[0, index]
        np.testing.assert_allclose(
            directions[:, index], numeric, atol=1e-6 * np.abs(numeric).max())


def test_draws_have_the_declared_deviations(uncertain):
    values = draw_nuisance(uncertain, 20_000, np.random.default_rng(2))
    stds = [p.std for p in nuisance_parameters(uncertain)]
    np.testing.assert_allclose(values.std(axis=0), stds, rtol=0.03)
    scaled = values / stds
    np.testing.assert_allclose(scaled.T @ scaled / 20_000, np.eye(6), atol=0.04)
    other = draw_nuisance(uncertain, 20_000, np.random.default_rng(3))
    assert not (other == values).any()


def test_a_phase_with_the_deviation_of_a_turn_is_uniform():
    scenario = Scenario(phase_std_rad=2 * np.pi)
    values = draw_nuisance(scenario, 20_000, np.random.default_rng(3))
    factors = nuisance_factors(scenario, values)[:, 0, 0]
    assert abs(factors.mean()) < 4 / np.sqrt(20_000)
    assert abs((factors**2).mean()) < 4 / np.sqrt(20_000)


def test_a_value_does_not_depend_on_the_other_declarations(uncertain):
    alone = dataclasses.replace(Scenario(), timing_std_s=30e-9)
    both = draw_nuisance(uncertain, 4, np.random.default_rng(4))
    assert np.array_equal(
        draw_nuisance(alone, 4, np.random.default_rng(4))[:, 0], both[:, 3])


def test_gain_and_carrier_offset_stay_with_the_user(uncertain):
    def draw(cycle):
        return draw_user_cycle(
            uncertain, streams.generator(0, 1, 7), streams.generator(0, 2, 7, cycle))[0]
    first, second = draw(1), draw(2)
    assert np.array_equal(first[:2], second[:2])
    assert not np.any(first[2:] == second[2:])
