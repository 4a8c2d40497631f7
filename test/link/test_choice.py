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
    """A high band with a narrow beam is better where the user is known, a low one where not."""
    # A surface of many wavelengths at the high band; the low one has less power for its width.
    scenario = Scenario(
        center_frequencies_hz=(1.0e9, 3.0e9), n_subbands=1, n_feeds=2, elements_per_side=12,
        max_power_w=1e-3, roi_center_m=(10.0, 0.0, 0.0))
    place = np.array([8.0, 3.0, 0.0])
    at_mean = [choose_beam(scenario, place, None, [band]).expected_bps for band in (0, 1)]
    wide = np.diag([0.0, 3.0, 3.0])
    averaged = [choose_beam(scenario, place, wide, [band]).expected_bps for band in (0, 1)]
    # What the narrow beam loses is more than what the wide one does.
    assert at_mean[1] - averaged[1] > 1.5 * (at_mean[0] - averaged[0])
    # With the element gain that makes both equal at the mean, the average decides.
    assert choose_beam(scenario, place, wide).beam.band == int(np.argmax(averaged))


def test_of_equal_bands_the_first_is_taken(table1):
    twice = dataclasses.replace(
        table1.scenario, center_frequencies_hz=(2.5e9, 2.5e9))
    assert choose_beam(twice, PLACE, np.eye(3)).beam.band == 0


@pytest.mark.parametrize('bands', [[2], [-1], [0, 5]])
def test_a_band_that_is_none_is_an_error(table1, bands):
    with pytest.raises(ValueError, match='band: .* expected 0 to 1'):
        choose_beam(table1.scenario, PLACE, np.eye(3), bands)
