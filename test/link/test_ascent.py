"""Ascent from a configuration to a maximum nearby."""

import numpy as np
import pytest

from rhs_isac_ros.link import Beam, capacity
from rhs_isac_ros.link.ascent import ascend
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.model import Scenario

POSITION = np.array([7.0, 3.0, -0.5])
# The sub-bands differ, and the power is too low for all of them to receive some.
WIDE = Scenario(
    center_frequencies_hz=(2.5e9,), n_subbands=4, subband_width_hz=4e8, n_feeds=2,
    elements_per_side=4, max_power_w=5e-9)


def rate(scenario, analog, digital):
    return capacity(scenario, Beam(analog, digital), POSITION[None])[0]


@pytest.fixture(params=['small', 'table1', 'wide'])
def scenario(request):
    return WIDE if request.param == 'wide' else request.getfixturevalue(request.param).scenario


@pytest.fixture
def link(scenario):
    return BandLink.to(scenario, POSITION, 0)


def starts(scenario, n=10):
    rng = np.random.default_rng(1)
    inside = rng.uniform(size=(n, scenario.n_elements))
    return [*inside, *np.round(inside), np.ones(scenario.n_elements),
            np.zeros(scenario.n_elements)]


def test_the_capacity_never_decreases(scenario, link):
    for start in starts(scenario):
        analog, digital = ascend(link, start)
        assert analog.min() >= 0
        assert analog.max() <= 1
        assert rate(scenario, analog, digital) >= rate(
            scenario, start, link.best_digital(start)) * (1 - 1e-12)


def test_the_start_is_not_modified(scenario, link):
    for start in starts(scenario, 2):
        before = start.copy()
        ascend(link, start)
        np.testing.assert_array_equal(start, before)


def test_the_digital_part_is_optimal_for_the_configuration(scenario, link):
    for start in starts(scenario, 3):
        analog, digital = ascend(link, start)
        np.testing.assert_array_equal(digital, link.best_digital(analog))


def test_no_single_element_at_an_end_of_its_range_increases_the_capacity(scenario, link):
    for start in starts(scenario, 3):
        if not start.any():
            continue
        analog, digital = ascend(link, start)
        found = rate(scenario, analog, digital)
        for element in range(scenario.n_elements):
            for end in (0.0, 1.0):
                other = analog.copy()
                other[element] = end
                assert rate(scenario, other, digital) <= found * (1 + 1e-8)


def test_the_ascent_increases_the_capacity_of_random_configurations(scenario, link):
    gained = [rate(scenario, *ascend(link, start)) / rate(
        scenario, start, link.best_digital(start)) for start in starts(scenario)[:10]]
    assert min(gained) > 1.0001


def test_a_surface_that_is_off_still_uses_the_full_power(scenario, link):
    _, digital = ascend(link, np.zeros(scenario.n_elements))
    assert np.sum(np.abs(digital)**2) == pytest.approx(scenario.max_power_w)
