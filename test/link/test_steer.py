"""Steering: constraints, and how good the beam is."""

import numpy as np
import pytest

from rhs_isac_ros.link import Beam, capacity, steer
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.surface import matched_configuration, onboard_matrix


@pytest.fixture(scope='module')
def places(table1):
    """Some positions of Table I's region, corners among them."""
    scenario = table1.scenario
    return [*scenario.sample_positions(4, np.random.default_rng(0)), *scenario.roi_bounds_m]


def rate(scenario, beam, position):
    return capacity(scenario, beam, np.asarray(position)[None])[0]


def assert_valid(scenario, beam, band=0):
    assert beam.band == band
    assert beam.analog.shape == (scenario.n_elements,)
    assert beam.digital.shape == (scenario.n_subbands, scenario.n_feeds)
    assert beam.analog.min() >= 0
    assert beam.analog.max() <= 1
    assert np.sum(np.abs(beam.digital)**2) == pytest.approx(scenario.max_power_w, rel=1e-9)


@pytest.mark.parametrize('band', [0, 1])
def test_a_beam_keeps_power_and_range(table1, places, band):
    for place in places:
        assert_valid(table1.scenario, steer(table1.scenario, place, band), band)


def test_the_same_position_gives_the_same_beam(table1, places):
    a, b = (steer(table1.scenario, places[0]) for _ in range(2))
    np.testing.assert_array_equal(a.analog, b.analog)
    np.testing.assert_array_equal(a.digital, b.digital)


@pytest.mark.parametrize('band', [0, 1])
def test_a_beam_is_never_worse_than_the_matched_filter(table1, places, link_of, band):
    scenario, link = table1.scenario, link_of(table1, band)
    gained = []
    for place in places:
        los = los_gain(scenario, np.array([place]), band)[0]
        matched = matched_configuration(los, onboard_matrix(scenario)[band])
        start = rate(scenario, link.best_digital(matched, place), place)
        gained.append(rate(scenario, steer(scenario, place, band), place) / start - 1)
    assert min(gained) >= -1e-12
    assert max(gained) > 0.001


def test_a_beam_of_a_small_surface_is_close_to_the_best_of_all(small, link_of):
    """All corners of the box, of which one is the best; water-filling shares evenly here."""
    scenario, link = small.scenario, link_of(small)
    corners = (np.arange(1, 2**16)[:, None] >> np.arange(16) & 1).astype(float)
    for place in scenario.sample_positions(3, np.random.default_rng(4)):
        rates = 0
        for onboard, los in zip(link.onboard, link.los(place), strict=True):
            configured = onboard * corners[:, None]
            toward = configured @ los
            channels = toward[:, :, None] * toward[:, None].conj()
            channels += configured @ link.spatial @ np.swapaxes(configured.conj(), 1, 2)
            shares = scenario.max_power_w / scenario.n_subbands / link.noise
            rates = rates + np.log2(1 + np.linalg.eigvalsh(channels)[:, -1] * shares)
        best = rate(scenario, link.best_digital(corners[rates.argmax()], place), place)
        found = rate(scenario, steer(scenario, place), place)
        assert 0.999 * best < found <= best * (1 + 1e-9)


def test_a_beam_beats_a_random_search(table1, link_of):
    scenario, link, rng = table1.scenario, link_of(table1), np.random.default_rng(2)
    place = np.array([9.0, -2.0, 0.3])
    found = rate(scenario, steer(scenario, place), place)
    for n in range(60):
        analog = rng.uniform(size=100)
        analog = np.round(analog) if n % 2 else analog
        assert rate(scenario, link.best_digital(analog, place), place) < found


def test_no_other_digital_part_is_better(small, link_of):
    scenario, rng = small.scenario, np.random.default_rng(3)
    place = np.array([7.0, 3.0, -0.5])
    beam = steer(scenario, place)
    found = rate(scenario, beam, place)
    best = link_of(small).best_digital(beam.analog, place)
    assert found == pytest.approx(rate(scenario, best, place), rel=1e-12)
    for _ in range(300):
        digital = beam.digital + 10**rng.uniform(-4, -1) * (rng.normal(size=(3, 2, 2)) @ [1, 1j])
        digital *= np.sqrt(scenario.max_power_w / np.sum(np.abs(digital)**2))
        assert rate(scenario, Beam(beam.analog, digital), place) <= found * (1 + 1e-12)


def test_little_power_goes_where_it_carries_most():
    """Sub-bands so far apart that they differ, and noise so high that not all are worth it."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9,), n_subbands=4, subband_width_hz=4e8, n_feeds=2,
        elements_per_side=4, max_power_w=5e-9)
    place = np.array([7.0, 3.0, -0.5])
    beam = steer(scenario, place)
    shares = np.sum(np.abs(beam.digital)**2, axis=1)
    assert shares.sum() == pytest.approx(scenario.max_power_w)
    assert shares.max() > 2 * shares.min()
    even = beam.digital * np.sqrt(scenario.max_power_w / 4 / np.maximum(shares, 1e-30))[:, None]
    assert rate(scenario, beam, place) > 1.01 * rate(scenario, Beam(beam.analog, even), place)


def test_no_small_change_of_the_configuration_is_better(small):
    """A local maximum: the slope points out of the box everywhere."""
    scenario, place = small.scenario, np.array([7.0, 3.0, -0.5])
    beam = steer(scenario, place)
    found = rate(scenario, beam, place)
    for m in range(16):
        analog = beam.analog.copy()
        analog[m] += 1e-3 if analog[m] < 0.5 else -1e-3
        assert rate(scenario, Beam(analog, beam.digital), place) <= found


def test_the_true_position_beats_one_five_metres_away(table1, places):
    scenario = table1.scenario
    for place in places:
        away = place + (np.array([0, 5.0, 0]) if place[1] < 0 else np.array([0, -5.0, 0]))
        right, wrong = steer(scenario, place), steer(scenario, away)
        assert rate(scenario, right, place) > rate(scenario, wrong, place)
        assert rate(scenario, wrong, away) > rate(scenario, right, away)


def test_no_beam_for_a_place_nearby_is_better(table1):
    """Steering does not stop so low that the beam for an estimate carries more than its own."""
    scenario, rng = table1.scenario, np.random.default_rng(4)
    for place in scenario.sample_positions(20, rng):
        found = rate(scenario, steer(scenario, place), place)
        for spread_m in (0.02, 0.2, 1.0):
            near = place + rng.normal(scale=spread_m, size=3)
            assert rate(scenario, steer(scenario, near), place) < found * (1 + 5e-4)


@pytest.mark.parametrize('position', [
    (1.0, 2.0), 5.0, [[9.0, 0.0, 0.0]], (9.0, np.nan, 0.0), (9.0, 0.0, -np.inf)])
def test_a_position_that_is_none_is_an_error(small, position):
    with pytest.raises(ValueError, match='positions'):
        steer(small.scenario, position)


@pytest.mark.parametrize('band', [-1, 1, 7])
def test_a_band_that_is_none_is_an_error(small, band):
    with pytest.raises(ValueError, match=f'band: {band}, expected 0 to 0'):
        steer(small.scenario, (9.0, 0.0, 0.0), band)


def test_one_feed_and_one_sub_band_take_all_the_power():
    scenario = Scenario(
        center_frequencies_hz=(2.5e9,), n_subbands=1, n_feeds=1, elements_per_side=3)
    beam = steer(scenario, (9.0, 0.0, 0.0))
    assert_valid(scenario, beam)
    assert np.abs(beam.digital[0, 0]) == pytest.approx(np.sqrt(scenario.max_power_w))
