"""The choice of the band."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.link import capacity, choose_beam, expected_capacity, steer
from rhs_isac_ros.model import Scenario

PLACE = np.array([9.0, 1.5, -0.4])


def test_the_beam_is_steered_to_the_mean_and_the_best_of_all_bands(table1):
    scenario, covariance = table1.scenario, np.diag([0.8, 0.1, 0.02])
    choice = choose_beam(scenario, PLACE, covariance)
    expected = []
    for band in range(scenario.n_bands):
        beam = steer(scenario, PLACE, band)
        expected.append(expected_capacity(scenario, beam, PLACE, covariance))
    assert choice.expected_bps == max(expected)
    assert choice.beam.band == np.argmax(expected)
    best = steer(scenario, PLACE, choice.beam.band)
    np.testing.assert_array_equal(choice.beam.analog, best.analog)
    np.testing.assert_array_equal(choice.beam.digital, best.digital)


def test_a_position_that_is_known_has_its_capacity(table1):
    choice = choose_beam(table1.scenario, PLACE)
    assert choice.expected_bps == capacity(table1.scenario, choice.beam, PLACE[None])[0]


@pytest.mark.parametrize('band', [0, 1])
def test_only_the_bands_asked_for_are_chosen(table1, band):
    assert choose_beam(table1.scenario, PLACE, np.eye(3), [band]).beam.band == band


def test_an_uncertain_position_takes_another_band_than_a_certain_one():
    """Two bands that are nearly equal: the beam that is best at the mean loses more around it."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.6e9), n_subbands=1, n_feeds=2, elements_per_side=6)
    mean, covariance = np.array([6.9, 3.6, 0.1]), np.diag([0.25, 4.0, 0.25])
    at_mean = [capacity(scenario, steer(scenario, mean, band), mean[None])[0] for band in (0, 1)]
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, 20000)
    draws[:, 0] = np.maximum(draws[:, 0], scenario.roi_bounds_m[0][0])
    averaged = [capacity(scenario, steer(scenario, mean, band), draws).mean() for band in (0, 1)]
    assert np.argmax(at_mean) != np.argmax(averaged)
    assert choose_beam(scenario, mean).beam.band == np.argmax(at_mean)
    assert choose_beam(scenario, mean, covariance).beam.band == np.argmax(averaged)


def test_of_equal_bands_the_first_is_taken(table1):
    twice = dataclasses.replace(
        table1.scenario, center_frequencies_hz=(2.5e9, 2.5e9))
    assert choose_beam(twice, PLACE, np.eye(3)).beam.band == 0


@pytest.mark.parametrize('bands', [[2], [-1], [0, 5]])
def test_a_band_that_is_none_is_an_error(table1, bands):
    with pytest.raises(ValueError, match='band: .* expected 0 to 1'):
        choose_beam(table1.scenario, PLACE, np.eye(3), bands)
