"""Ascent from configurations to maxima nearby."""

import numpy as np
import pytest

from rhs_isac_ros.link import Beamformer, capacity
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.link.steering import ascend
from rhs_isac_ros.model import Scenario

POSITION = np.array([7.0, 3.0, -0.5])
# The sub-bands differ, and the power is too low for all of them to receive some.
WIDE = Scenario(
    center_frequencies_hz=(2.5e9,), n_subbands=4, subband_width_hz=4e8, n_feeds=2,
    elements_per_side=4, max_power_w=5e-9)


def rate(scenario, analog, digital, band):
    return capacity(scenario, Beamformer(analog, digital, band), POSITION[None])[0]


@pytest.fixture(params=['small', 'table1', 'wide'])
def scenario(request):
    return WIDE if request.param == 'wide' else request.getfixturevalue(request.param).scenario


@pytest.fixture
def link(scenario):
    """The links in all bands."""
    return BandLink.to(scenario, POSITION, range(scenario.n_bands))


def starts(scenario, n=10):
    """Starts in all bands, [N_B, 2 n + 2, N_E]."""
    rng = np.random.default_rng(1)
    inside = rng.uniform(size=(scenario.n_bands, n, scenario.n_elements))
    ends = np.ones((scenario.n_bands, 1, scenario.n_elements))
    return np.concatenate([inside, np.round(inside), ends, 0 * ends], axis=1)


def ascended(scenario, link, n=10):
    """Return band, start, found configuration and the best digital parts of both."""
    before = starts(scenario, n)
    found, rates = ascend(link, before)
    np.testing.assert_allclose(link.best_rate(found), rates, rtol=1e-9)
    parts = link.best_digital(before), found, link.best_digital(found)
    for band, by_start in enumerate(zip(before, *(part for part in parts), strict=True)):
        for each in zip(*by_start, strict=True):
            yield (band, *each)


def test_the_capacity_never_decreases(scenario, link):
    for band, start, digital, found, better in ascended(scenario, link):
        assert found.min() >= 0
        assert found.max() <= 1
        assert rate(scenario, found, better, band) >= rate(
            scenario, start, digital, band) * (1 - 1e-12)


def test_an_ascent_does_not_depend_on_the_others(scenario, link):
    before = starts(scenario, 3)
    found, _ = ascend(link, before)
    for n in range(before.shape[1]):
        np.testing.assert_array_equal(ascend(link, before[:, n:n + 1])[0], found[:, n:n + 1])


def test_no_single_element_at_an_end_of_its_range_increases_the_capacity(scenario, link):
    for band, start, _, found, digital in ascended(scenario, link, 1):
        if not start.any():
            continue
        best = rate(scenario, found, digital, band)
        for element in range(scenario.n_elements):
            for end in (0.0, 1.0):
                other = found.copy()
                other[element] = end
                assert rate(scenario, other, digital, band) <= best * (1 + 1e-8)


def test_a_surface_that_is_off_still_uses_the_full_power(scenario, link):
    found, _ = ascend(link, starts(scenario, 0)[:, 1:])
    digital = link.best_digital(found)
    np.testing.assert_allclose(
        np.sum(np.abs(digital)**2, axis=(1, 2, 3)), scenario.max_power_w)
