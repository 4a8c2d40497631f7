"""What a beam carries beside what a perfect position would."""

import math

import numpy as np
import pytest

from rhs_isac_ros.link import Beam, Outcome, choose_beam, outcome, steer

PLACE = np.array([9.0, 1.5, -0.4])


@pytest.mark.parametrize('band', [0, 1])
def test_capacities_are_those_of_the_loops(table1, link_of, band):
    scenario, link = table1.scenario, link_of(table1, band)
    used = steer(scenario, PLACE + [0.5, 0.6, 0.0], band)
    found = outcome(scenario, used, PLACE, [band])
    assert found.actual_bps == pytest.approx(link.capacity(used, PLACE), rel=1e-6)
    assert found.perfect_bps == pytest.approx(
        link.capacity(steer(scenario, PLACE, band), PLACE), rel=1e-6)
    assert found.loss_bps == found.perfect_bps - found.actual_bps > 0
    assert found.loss_percent == pytest.approx(100 * (1 - found.actual_bps / found.perfect_bps))


def test_the_perfect_beam_may_be_of_another_band(table1):
    """A beam in a band that is not the best loses even with a perfect position."""
    scenario = table1.scenario
    best = choose_beam(scenario, PLACE).beam.band
    other = steer(scenario, PLACE, 1 - best)
    assert outcome(scenario, other, PLACE).loss_percent > 0.1
    assert outcome(scenario, other, PLACE, [1 - best]).loss_bps == 0


def test_a_surface_that_is_off_loses_all(table1):
    scenario = table1.scenario
    beam = steer(scenario, PLACE)
    off = Beam(np.zeros_like(beam.analog), beam.digital, beam.band)
    assert outcome(scenario, off, PLACE).loss_percent == 100


def test_of_nothing_there_is_no_share():
    assert math.isnan(Outcome(0.0, 0.0).loss_percent)
    assert math.isnan(Outcome(math.nan, math.nan).loss_percent)


@pytest.mark.parametrize('position', [(1.0, 2.0), (9.0, np.nan, 0.0)])
def test_a_position_that_is_none_is_an_error(table1, position):
    beam = steer(table1.scenario, PLACE)
    with pytest.raises(ValueError, match='expected'):
        outcome(table1.scenario, beam, np.array(position))
