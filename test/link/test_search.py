"""Search for configurations from many starts."""

import numpy as np
import pytest

from rhs_isac_ros.link.ascent import ascend
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.link.search import candidate_configurations
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import matched_configuration

POSITION = np.array([8.0, -2.0, 0.5])
ONE_BAND = {'center_frequencies_hz': (2.5e9,), 'elements_per_side': 4, 'n_feeds': 2}


def test_configurations_are_distinct_corners(table1):
    found = candidate_configurations(BandLink.to(table1.scenario, POSITION, 0), 5)
    assert found.shape == (5, 100)
    assert set(np.unique(found)) == {0.0, 1.0}
    assert len(np.unique(found, axis=0)) == 5


def test_configurations_are_better_than_the_matched_filter(table1):
    for position in table1.scenario.sample_positions(5, np.random.default_rng(0)):
        link = BandLink.to(table1.scenario, position, 0)
        matched = link.best_rate(matched_configuration(link.los, link.onboard))
        rates = [link.best_rate(analog) for analog in candidate_configurations(link, 3)]
        assert min(rates) > matched
        # The ranking uses most modes of the multipath, but not all.
        assert rates[0] > max(rates) * (1 - 1e-3)


def test_an_ascent_from_the_first_configuration_increases_the_capacity_little(table1):
    link = BandLink.to(table1.scenario, POSITION, 1)
    (first,) = candidate_configurations(link, 1)
    better, _ = ascend(link, first)
    assert link.best_rate(first) <= link.best_rate(better) < link.best_rate(first) * 1.001


@pytest.mark.parametrize('width_hz', [1e5, 1e8, 4e8])
def test_the_best_capacity_is_close_to_that_of_all_corners(width_hz):
    scenario = Scenario(n_subbands=3, subband_width_hz=width_hz, **ONE_BAND)
    link = BandLink.to(scenario, POSITION, 0)
    corners = (np.arange(1, 2**16, 7)[:, None] >> np.arange(16) & 1).astype(float)
    best = max(link.best_rate(corner) for corner in corners)
    found = max(link.best_rate(analog) for analog in candidate_configurations(link, 3))
    assert found > best * (1 - 1e-3)


@pytest.mark.parametrize(('n_subbands', 'n_feeds', 'side'), [(1, 1, 1), (1, 3, 2), (5, 1, 3)])
def test_small_arrays_have_candidates(n_subbands, n_feeds, side):
    scenario = Scenario(center_frequencies_hz=(2.5e9,), n_subbands=n_subbands, n_feeds=n_feeds,
                        elements_per_side=side)
    found = candidate_configurations(BandLink.to(scenario, POSITION, 0), 3)
    assert 1 <= len(found) <= 3
    assert found.shape[1] == side**2
    assert found[0].any()
