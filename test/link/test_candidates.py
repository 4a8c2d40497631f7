"""Search for configurations from many starts."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.link import Beamformer, candidates, capacity
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.link.candidates import candidate_configurations, tables
from rhs_isac_ros.link.steering import ascend
from rhs_isac_ros.model import Scenario, multipath
from rhs_isac_ros.model.elementwise import matched_configuration
from rhs_isac_ros.model.multipath import multipath_covariance

POSITION = np.array([8.0, -2.0, 0.5])
ONE_BAND = {'center_frequencies_hz': (2.5e9,), 'elements_per_side': 4, 'n_feeds': 2}


def search(scenario, position, n, surface=None):
    """Return the links in all bands and the candidates."""
    bands = range(scenario.n_bands)
    link = BandLink.to(scenario, position, bands, surface)
    return link, candidate_configurations(tables(scenario, surface), link, bands, n)


def test_configurations_are_distinct_corners(table1):
    _, found = search(table1.scenario, POSITION, 2)
    assert found.shape == (2, 2, 100)
    assert set(np.unique(found)) == {0.0, 1.0}
    for by_band in found:
        assert len(np.unique(by_band, axis=0)) == 2


def test_configurations_are_better_than_the_matched_filter(table1):
    for position in table1.scenario.sample_positions(5, np.random.default_rng(0)):
        link, found = search(table1.scenario, position, 2)
        for los, onboard, by_band, rates in zip(
                link.los, link.onboard, range(2), link.best_rate(found), strict=True):
            matched = np.broadcast_to(matched_configuration(los, onboard), (2, 1, 100))
            assert rates.min() > link.best_rate(matched)[by_band, 0]


def test_an_ascent_from_the_best_configuration_increases_the_capacity_little(table1):
    link, found = search(table1.scenario, POSITION, 2)
    before = link.best_rate(found).max(axis=1)
    after = ascend(link, found)[1].max(axis=1)
    assert (before <= after).all()
    assert (after < before * 1.001).all()


@pytest.mark.parametrize('width_hz', [1e5, 1e8, 4e8])
@pytest.mark.parametrize('multipath_db', [-20.0, 0.0, 20.0])
def test_the_best_capacity_is_close_to_that_of_all_corners(width_hz, multipath_db):
    scenario = Scenario(n_subbands=3, subband_width_hz=width_hz, multipath_to_los_db=multipath_db,
                        **ONE_BAND)
    link, found = search(scenario, POSITION, 3)
    corners = (np.arange(1, 2**16, 7)[:, None] >> np.arange(16) & 1).astype(float)
    assert link.best_rate(found).max() > link.best_rate(corners[None]).max() * (1 - 1e-3)


@pytest.mark.parametrize(('n_subbands', 'n_feeds', 'side'), [(1, 1, 1), (1, 3, 2), (5, 1, 3)])
def test_small_arrays_have_candidates(n_subbands, n_feeds, side):
    scenario = Scenario(center_frequencies_hz=(2.5e9,), n_subbands=n_subbands, n_feeds=n_feeds,
                        elements_per_side=side)
    link, found = search(scenario, POSITION, 3)
    assert found.shape[2] == side**2
    assert link.best_rate(found).max() > 0


@pytest.mark.parametrize('changes', [
    {'max_power_w': 1e6, 'noise_psd_dbm_hz': -400.0}, {'multipath_to_los_db': 100.0},
    {'max_power_w': 1e-15, 'noise_psd_dbm_hz': 100.0}, {'multipath_to_los_db': -200.0},
    {'element_gain': 1e6}, {'element_gain': 1e-6}])
def test_single_precision_suffices_at_all_powers(changes):
    """Only the relation of the line of sight to the multipath affects the configuration."""
    link, found = search(dataclasses.replace(Scenario(n_subbands=2, **ONE_BAND), **changes),
                         POSITION, 2)
    matched = matched_configuration(link.los[0], link.onboard[0])
    assert link.best_rate(found).max() > link.best_rate(matched[None, None])[0, 0]


def test_the_modes_contain_nearly_all_of_the_multipath_power(table1):
    found = tables(table1.scenario, None)
    for band, spatial in enumerate(multipath_covariance(table1.scenario).real):
        # The gain on the board has the amplitude 1.
        modes = found.paths[band, :, 0, 0, 1:] / found.onboard[band, :, 0, 0, None]
        assert modes.shape[1] < 20
        rest = spatial - (modes @ np.conj(modes.T)).real
        assert 0 < np.trace(rest) <= 0.02 * np.trace(spatial)


@pytest.mark.parametrize('direction', [(0.0, 0.0), (40.0, -20.0)])
def test_modes_of_many_elements_are_found_by_products_alone(monkeypatch, direction):
    scenario = Scenario(elements_per_side=(9, 6), multipath_direction_deg=direction)
    expected = candidates._modes(scenario)
    multipath.spatial_covariance.cache_clear()
    monkeypatch.setattr(multipath, '_MAX_MATRIX', 1)
    found = candidates._modes(scenario, 30)
    multipath.spatial_covariance.cache_clear()
    assert np.isrealobj(found) == (direction == (0, 0))
    assert found.shape == expected.shape
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one @ np.conj(one.T), other @ np.conj(other.T),
                                   atol=0.01 * np.abs(other @ np.conj(other.T)).max())


def test_multipath_from_a_side_is_used(small):
    """With a weak line of sight, a good beam points to where the multipath comes from."""
    scenario = dataclasses.replace(
        small.scenario, multipath_to_los_db=20.0, multipath_direction_deg=(50.0, 0.0))
    link, found = search(scenario, POSITION, 2)
    corners = np.random.default_rng(0).integers(0, 2, (1, 3000, 16)).astype(float)
    ends, rates = ascend(link, found)
    assert rates.max() >= link.best_rate(corners).max()
    beam = Beamformer(ends[0, rates[0].argmax()], link.best_digital(ends)[0, rates[0].argmax()])
    rate = capacity(scenario, beam, POSITION[None])[0]
    assert rate == pytest.approx(rates.max() * scenario.subband_width_hz / np.log(2), rel=1e-9)
