"""Eq. (10) against independent values and against plain loops."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.link import Beam, capacity
from rhs_isac_ros.model import Scenario


def random_beam(scenario, rng, band=0):
    digital = rng.normal(size=(scenario.n_subbands, scenario.n_feeds, 2)) @ [1, 1j]
    digital *= np.sqrt(scenario.max_power_w / np.sum(np.abs(digital)**2))
    return Beam(rng.uniform(size=scenario.n_elements), digital, band)


def test_capacity_is_the_vectors(case):
    beam = Beam(case.vectors['tx_analog'], case.vectors['tx_digital'], 0)
    values = capacity(case.scenario, beam, case.vectors['positions'])
    assert values.shape == case.vectors['capacity_band1'].shape
    np.testing.assert_allclose(values, case.vectors['capacity_band1'], rtol=1e-8)


def test_capacity_is_that_of_plain_loops(small, link_of):
    link, rng = link_of(small), np.random.default_rng(0)
    for _ in range(3):
        beam = random_beam(small.scenario, rng)
        positions = small.scenario.sample_positions(2, rng)
        expected = [link.capacity(beam, position) for position in positions]
        np.testing.assert_allclose(
            capacity(small.scenario, beam, positions), expected, rtol=1e-8)


@pytest.mark.parametrize('band', [0, 1])
def test_each_band_has_its_own_capacity(table1, link_of, band):
    rng = np.random.default_rng(band)
    beam, position = random_beam(table1.scenario, rng, band), np.array([7.0, 2.0, -0.4])
    value = capacity(table1.scenario, beam, position[None])[0]
    assert value == pytest.approx(link_of(table1, band).capacity(beam, position), rel=1e-8)
    other = dataclasses.replace(beam, band=1 - band)
    assert capacity(table1.scenario, other, position[None])[0] != pytest.approx(value, rel=1e-4)


def test_positions_do_not_influence_each_other(small):
    rng = np.random.default_rng(1)
    beam, positions = random_beam(small.scenario, rng), small.scenario.sample_positions(5, rng)
    together = capacity(small.scenario, beam, positions)
    alone = [capacity(small.scenario, beam, p[None])[0] for p in positions]
    np.testing.assert_allclose(together, alone, rtol=1e-12)
    assert capacity(small.scenario, beam, np.zeros((0, 3))).shape == (0,)


def test_a_beam_that_is_off_carries_nothing(small):
    scenario = small.scenario
    positions = scenario.sample_positions(3, np.random.default_rng(2))
    beam = random_beam(scenario, np.random.default_rng(2))
    for dark in (Beam(np.zeros(16), beam.digital), Beam(beam.analog, np.zeros((3, 2), complex))):
        assert (capacity(scenario, dark, positions) == 0).all()


def test_sub_bands_add_up(small):
    scenario = small.scenario
    beam = random_beam(scenario, np.random.default_rng(3))
    position = np.array([[9.0, 1.0, 0.5]])
    alone = [Beam(beam.analog, beam.digital * (np.arange(3) == j)[:, None]) for j in range(3)]
    parts = [capacity(scenario, part, position)[0] for part in alone]
    assert min(parts) > 0
    assert sum(parts) == pytest.approx(capacity(scenario, beam, position)[0])


def test_ten_times_the_power_adds_log2_of_ten(small):
    """At a high ratio of signal to noise."""
    scenario = small.scenario
    beam = random_beam(scenario, np.random.default_rng(4))
    position = np.array([[9.0, 1.0, 0.5]])
    values = [capacity(scenario, Beam(beam.analog, amplitude * beam.digital), position)[0]
              for amplitude in (1e3, 1e3 * np.sqrt(10), 1e3 * np.exp(0.7j))]
    gain = 3 * scenario.subband_width_hz * np.log2(10)
    assert values[1] - values[0] == pytest.approx(gain, rel=1e-6)
    assert values[2] == pytest.approx(values[0])


def test_closer_users_get_more(small):
    beam = Beam(small.vectors['tx_analog'], small.vectors['tx_digital'])
    scenario = dataclasses.replace(small.scenario, roi_center_m=(10.0, 0.0, 0.0))
    direction = np.array([1.0, 0.1, 0.05])
    distances = np.array([6.0, 8.0, 10.0, 14.0])
    values = capacity(scenario, beam, distances[:, None] * direction)
    assert (np.diff(values) < 0).all()


@pytest.mark.parametrize(('changes', 'words'), [
    ({'analog': np.ones(15)}, ['analog: shape (15,)', '[N_E] = (16,)']),
    ({'analog': np.ones((1, 16))}, ['analog: shape (1, 16)']),
    ({'digital': np.ones((2, 2))}, ['digital: shape (2, 2)', '[N_SB, K] = (3, 2)']),
    ({'digital': np.ones(3)}, ['digital: shape (3,)']),
    ({'band': 1}, ['band: 1', 'expected 0 to 0']),
    ({'band': -1}, ['band: -1', 'expected 0 to 0']),
])
def test_a_beam_that_does_not_fit_is_an_error(small, changes, words):
    beam = dataclasses.replace(
        Beam(small.vectors['tx_analog'], small.vectors['tx_digital']), **changes)
    with pytest.raises(ValueError, match='expected') as caught:
        capacity(small.scenario, beam, np.array([[9.0, 0.0, 0.0]]))
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize('positions', [
    np.zeros(3), np.zeros((2, 2)), [[9.0, np.nan, 0.0]], [[9.0, 0.0, np.inf]]])
def test_positions_that_are_none_are_an_error(small, positions):
    beam = Beam(small.vectors['tx_analog'], small.vectors['tx_digital'])
    with pytest.raises(ValueError, match='positions'):
        capacity(small.scenario, beam, positions)


def test_a_beam_cannot_be_changed(small):
    beam = Beam(small.vectors['tx_analog'], small.vectors['tx_digital'])
    assert beam.band == 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        beam.band = 1


def test_table_1_carries_what_the_paper_says_in_order_of_magnitude():
    """A few ten Mbit/s over 1 MHz at 1 mW: some 20 to 30 bit/s/Hz."""
    scenario = Scenario()
    beam = random_beam(scenario, np.random.default_rng(5))
    value = capacity(scenario, beam, np.array([[10.0, 0.0, 0.0]]))[0]
    assert 10 < value / (scenario.n_subbands * scenario.subband_width_hz) < 40
