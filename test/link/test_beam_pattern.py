"""Beam patterns, compared with plain loops and with the direction of steering."""

import numpy as np
import pytest

from rhs_isac_ros.link import Beam, beam_pattern, steer
from rhs_isac_ros.model import Scenario


def random_beam(scenario, rng):
    digital = rng.normal(size=(scenario.n_subbands, scenario.n_feeds, 2)) @ [1, 1j]
    return Beam(rng.uniform(size=scenario.n_elements), digital)


def test_the_pattern_matches_plain_loops(small, reference_link):
    link, beam = reference_link(small), random_beam(small.scenario, np.random.default_rng(3))
    found = beam_pattern(small.scenario, beam, 4.0, step_deg=45.0)
    angles = np.radians([-90, -45, 0, 45, 90])
    power = np.zeros((5, 5))
    for e, elevation in enumerate(angles):
        for a, azimuth in enumerate(angles):
            position = 4.0 * np.array([np.cos(elevation) * np.cos(azimuth),
                                       np.cos(elevation) * np.sin(azimuth),
                                       np.sin(elevation)])
            assert 4.0 * found.directions[e, a] == pytest.approx(position)
            weights = np.einsum('jk,jkm->jm', beam.digital, link.onboard) * beam.analog
            power[e, a] = np.sum(np.abs(np.sum(weights * link.los(position), axis=1))**2)
    assert found.relative == pytest.approx(power / power.max(), rel=1e-8)
    assert found.distance_m == 4.0


def test_both_cuts_contain_the_strongest_direction(small):
    found = beam_pattern(
        small.scenario, random_beam(small.scenario, np.random.default_rng(4)), 7.0)
    azimuth, azimuth_cut = found.azimuth_cut()
    elevation, elevation_cut = found.elevation_cut()
    assert np.degrees(azimuth) == pytest.approx(np.arange(-90, 91, 5))
    assert np.degrees(elevation) == pytest.approx(np.arange(-90, 91, 5))
    assert azimuth_cut.max() == elevation_cut.max() == 1.0
    (row,), (column,) = np.nonzero(found.relative == 1.0)
    assert found.peak == (row, column)
    assert (azimuth_cut == found.relative[row]).all()
    assert (elevation_cut == found.relative[:, column]).all()


@pytest.mark.slow
@pytest.mark.parametrize('azimuth_deg', [-30.0, 0.0, 25.0])
def test_the_strongest_direction_is_the_direction_of_steering(azimuth_deg):
    scenario, azimuth = Scenario(), np.radians(azimuth_deg)
    position = 10.0 * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    found = beam_pattern(scenario, steer(scenario, position), 10.0, step_deg=1.0)
    angles, power = found.azimuth_cut()
    assert np.degrees(angles[np.argmax(power)]) == pytest.approx(azimuth_deg, abs=5.0)


def test_the_pattern_of_a_beam_that_is_off_is_zero(small):
    beam = random_beam(small.scenario, np.random.default_rng(5))
    found = beam_pattern(small.scenario, Beam(np.zeros(16), beam.digital), 5.0)
    assert (found.relative == 0).all()


def test_errors_name_field_value_and_expectation(small):
    beam = random_beam(small.scenario, np.random.default_rng(6))
    with pytest.raises(ValueError, match='distance_m: 0, expected a positive number'):
        beam_pattern(small.scenario, beam, 0)
    with pytest.raises(ValueError, match='step_deg: -1, expected a positive number'):
        beam_pattern(small.scenario, beam, 1, step_deg=-1)
    with pytest.raises(ValueError, match='band: 7'):
        beam_pattern(small.scenario, Beam(beam.analog, beam.digital, 7), 1)
