"""The search for configurations from many starts."""

import numpy as np
import pytest

from rhs_isac_ros.link.ascent import ascend
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.link.search import promising
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import matched_configuration

PLACE = np.array([8.0, -2.0, 0.5])
ONE_BAND = {'center_frequencies_hz': (2.5e9,), 'elements_per_side': 4, 'n_feeds': 2}


def test_configurations_are_corners_and_differ(table1):
    found = promising(BandLink.to(table1.scenario, PLACE, 0), 5)
    assert found.shape == (5, 100)
    assert set(np.unique(found)) == {0.0, 1.0}
    assert len(np.unique(found, axis=0)) == 5


def test_the_first_are_better_than_the_matched_filter(table1):
    for place in table1.scenario.sample_positions(5, np.random.default_rng(0)):
        link = BandLink.to(table1.scenario, place, 0)
        matched = link.best_rate(matched_configuration(link.los, link.onboard))
        rates = [link.best_rate(analog) for analog in promising(link, 3)]
        assert min(rates) > matched
        # They are ranked by most of the multipath's modes, not all.
        assert rates[0] > max(rates) * (1 - 1e-3)


def test_the_first_leave_the_ascent_little_to_gain(table1):
    link = BandLink.to(table1.scenario, PLACE, 1)
    (first,) = promising(link, 1)
    better, _ = ascend(link, first)
    assert link.best_rate(first) <= link.best_rate(better) < link.best_rate(first) * 1.001


@pytest.mark.parametrize('width_hz', [1e5, 1e8, 4e8])
def test_sub_bands_that_differ_are_searched_together(width_hz):
    """The best corner of all, tried one by one, is nearly met."""
    scenario = Scenario(n_subbands=3, subband_width_hz=width_hz, **ONE_BAND)
    link = BandLink.to(scenario, PLACE, 0)
    corners = (np.arange(1, 2**16, 7)[:, None] >> np.arange(16) & 1).astype(float)
    best = max(link.best_rate(corner) for corner in corners)
    assert max(link.best_rate(analog) for analog in promising(link, 3)) > best * (1 - 1e-3)


@pytest.mark.parametrize(('n_subbands', 'n_feeds', 'side'), [(1, 1, 1), (1, 3, 2), (5, 1, 3)])
def test_small_sizes_are_searched(n_subbands, n_feeds, side):
    scenario = Scenario(center_frequencies_hz=(2.5e9,), n_subbands=n_subbands, n_feeds=n_feeds,
                        elements_per_side=side)
    found = promising(BandLink.to(scenario, PLACE, 0), 3)
    assert 1 <= len(found) <= 3
    assert found.shape[1] == side**2
    assert found[0].any()
