"""The links to one position, compared with the reference implementation, and water-filling."""

import numpy as np
import pytest

from rhs_isac_ros.link.band_link import BandLink, representative_subbands, water_filling
from rhs_isac_ros.model import Scenario

POSITION = np.array([8.0, -2.0, 0.5])


@pytest.mark.parametrize('band', [0, 1])
def test_the_best_digital_part_matches_the_reference(table1, reference_link, band):
    link, reference = BandLink.to(table1.scenario, POSITION, [band]), reference_link(table1, band)
    rng = np.random.default_rng(0)
    for analog in (rng.uniform(size=100), np.round(rng.uniform(size=100))):
        expected = reference.best_beam(analog, POSITION)
        digital = link.best_digital(analog)[0, 0]
        # The common phase of each sub-band is arbitrary.
        rotation = np.sum(digital * expected.digital.conj(), axis=1, keepdims=True)
        np.testing.assert_allclose(
            digital, expected.digital * rotation / np.abs(rotation), rtol=1e-6,
            atol=1e-9 * np.abs(digital).max())


def test_the_best_rate_is_the_capacity_of_the_best_digital_part(small, reference_link):
    link, reference = BandLink.to(small.scenario, POSITION, [0]), reference_link(small)
    analog = np.random.default_rng(0).uniform(size=16)
    expected = reference.capacity(reference.best_beam(analog, POSITION), POSITION)
    assert link.best_rate(analog) * small.scenario.subband_width_hz / np.log(2) == pytest.approx(
        expected, rel=1e-9)


def test_links_in_several_bands_are_those_of_each_band(table1):
    bands = [1, 0]
    links = BandLink.to(table1.scenario, POSITION, bands)
    analog = np.random.default_rng(0).uniform(size=(2, 3, 100))
    for found, band, configurations in zip(range(2), bands, analog, strict=True):
        single = BandLink.to(table1.scenario, POSITION, [band])
        np.testing.assert_allclose(
            links.best_rate(analog)[found], single.best_rate(configurations)[0], rtol=1e-12)
        np.testing.assert_allclose(
            links.best_digital(analog)[found], single.best_digital(configurations)[0], rtol=1e-8)


def test_a_sub_band_has_its_share_of_the_power(table1):
    """Sub-bands hardly differ here, so that each one has an eighth of the rate."""
    link, analog = BandLink.to(table1.scenario, POSITION, [0]), np.ones(100)
    part = link.at_subbands(np.array([4]))
    assert part.los.shape == (1, 1, 100)
    assert 8 * part.best_rate(analog) == pytest.approx(link.best_rate(analog), rel=1e-4)


@pytest.mark.parametrize(('width_hz', 'expected'), [(1e5, [1]), (4e8, [0, 1, 2])])
def test_sub_bands_that_differ_are_represented_separately(width_hz, expected):
    scenario = Scenario(center_frequencies_hz=(3e9, 5e9), n_subbands=3,
                        subband_width_hz=width_hz)
    np.testing.assert_array_equal(representative_subbands(scenario, 0.5, 8), expected)
    assert len(representative_subbands(scenario, 0.5, 1)) == 1


def test_phases_drift_little_between_representative_sub_bands():
    scenario = Scenario(n_subbands=64, subband_width_hz=2e6)
    chosen = representative_subbands(scenario, 1.0, 64)
    assert 1 < len(chosen) < 16
    for position in scenario.sample_positions(10, np.random.default_rng(0)):
        link = BandLink.to(scenario, position, [0])
        paths = (link.onboard * link.los[:, :, None])[0]
        rotation = paths[chosen[1:]] * np.conj(paths[chosen[:-1]])
        common = rotation.sum(axis=(1, 2), keepdims=True)
        assert np.abs(np.angle(rotation * np.conj(common))).max() <= 1.0


RNG = np.random.default_rng(0)
CASES = {
    'equal': (np.ones(5), 2.0),
    'one channel': (np.array([3.0]), 0.5),
    'all filled': (np.array([2.0, 3.0, 4.0]), 10.0),
    'only the best': (np.array([1.0, 10.0, 2.0]), 0.1),
    'two equal best': (np.array([5.0, 1.0, 5.0]), 0.1),
    'just below the second': (np.array([2.0, 1.0]), 0.5 - 1e-9),
    'just above the second': (np.array([2.0, 1.0]), 0.5 + 1e-9),
    'one without gain': (np.array([0.0, 2.0, 3.0]), 1.0),
    'realistic link': (np.array([1e9, 1.1e9, 0.9e9, 3e8]), 1e-3),
    **{f'random {n}': (10**RNG.uniform(-4, 4, n), 10**RNG.uniform(-3, 3))
       for n in (2, 3, 8, 64, 500)},
}


@pytest.fixture(params=CASES)
def channels(request):
    return CASES[request.param]


def test_shares_match_bisection(channels, bisection):
    gains, power = channels
    np.testing.assert_allclose(
        water_filling(gains, power), bisection(gains, power), rtol=1e-9, atol=1e-9 * power)


def test_channels_without_gain_get_no_power():
    shares = water_filling(np.array([0.0, 2.0, -1e-20, 3.0]), 1.0)
    assert shares[0] == shares[2] == 0
    assert shares.sum() == pytest.approx(1.0)


@pytest.mark.parametrize('gains', [[0.0], [0.0] * 8, [-1e-20, 0.0]])
def test_without_any_gain_the_shares_are_equal(gains):
    np.testing.assert_allclose(water_filling(np.array(gains), 3.0), 3.0 / len(gains))


@pytest.mark.parametrize('gains', [[1e-15], [1e-15, 3e-15], [1e-200, 0.0, 1e-15]])
def test_gains_near_rounding_errors_still_get_the_power(gains):
    """A configuration that passes no signal has such gains."""
    shares = water_filling(np.array(gains), 1e-3)
    assert shares.sum() == 1e-3
    assert shares[np.argmax(gains)] == 1e-3
