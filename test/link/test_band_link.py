"""The link of one band against the one that is written out by loops."""

import numpy as np
import pytest

from rhs_isac_ros.link.band_link import BandLink

PLACE = np.array([8.0, -2.0, 0.5])


@pytest.mark.parametrize('band', [0, 1])
def test_the_best_digital_part_is_that_of_the_loops(table1, link_of, band):
    link, plain = BandLink.to(table1.scenario, PLACE, band), link_of(table1, band)
    rng = np.random.default_rng(0)
    for analog in (rng.uniform(size=100), np.round(rng.uniform(size=100))):
        expected = plain.best_digital(analog, PLACE)
        digital = link.best_digital(analog)
        # A common phase of each sub-band is free.
        turn = np.sum(digital * expected.digital.conj(), axis=1, keepdims=True)
        np.testing.assert_allclose(
            digital, expected.digital * turn / np.abs(turn), rtol=1e-6,
            atol=1e-9 * np.abs(digital).max())


def test_the_best_rate_is_the_capacity_of_the_best_digital_part(small, link_of):
    link, plain = BandLink.to(small.scenario, PLACE, 0), link_of(small)
    analog = np.random.default_rng(0).uniform(size=16)
    expected = plain.capacity(plain.best_digital(analog, PLACE), PLACE)
    assert link.best_rate(analog) * small.scenario.subband_width_hz / np.log(2) == pytest.approx(
        expected, rel=1e-9)


def test_patterns_scatter_by_the_covariance(table1):
    link = BandLink.to(table1.scenario, PLACE, 1)
    rng = np.random.default_rng(0)
    patterns = rng.normal(size=(2, 3, 100, 2)) @ [1, 1j]
    np.testing.assert_allclose(
        link.scatter(patterns), patterns @ table1.vectors['V'][1], rtol=1e-5,
        atol=1e-9 * np.abs(link.spatial).max())


def test_the_modes_make_up_nearly_all_of_the_covariance(table1):
    for band in range(2):
        link = BandLink.to(table1.scenario, PLACE, band)
        assert link.modes.shape[1] < 20
        rest = link.spatial - link.modes @ link.modes.T
        values = np.linalg.eigvalsh(rest)
        assert values[0] > -1e-9 * np.trace(link.spatial)
        assert 0 < np.trace(rest) <= 0.02 * np.trace(link.spatial)


def test_arrays_that_links_share_cannot_be_changed(table1):
    link = BandLink.to(table1.scenario, PLACE, 0)
    for array in (link.onboard, link.spatial, link.modes):
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 0
