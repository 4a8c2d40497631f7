"""The link of one band, compared with the reference implementation."""

import numpy as np
import pytest

from rhs_isac_ros.link.band_link import BandLink

POSITION = np.array([8.0, -2.0, 0.5])


@pytest.mark.parametrize('band', [0, 1])
def test_the_best_digital_part_matches_the_reference(table1, reference_link, band):
    link, reference = BandLink.to(table1.scenario, POSITION, band), reference_link(table1, band)
    rng = np.random.default_rng(0)
    for analog in (rng.uniform(size=100), np.round(rng.uniform(size=100))):
        expected = reference.best_beam(analog, POSITION)
        digital = link.best_digital(analog)
        # The common phase of each sub-band is arbitrary.
        rotation = np.sum(digital * expected.digital.conj(), axis=1, keepdims=True)
        np.testing.assert_allclose(
            digital, expected.digital * rotation / np.abs(rotation), rtol=1e-6,
            atol=1e-9 * np.abs(digital).max())


def test_the_best_rate_is_the_capacity_of_the_best_digital_part(small, reference_link):
    link, reference = BandLink.to(small.scenario, POSITION, 0), reference_link(small)
    analog = np.random.default_rng(0).uniform(size=16)
    expected = reference.capacity(reference.best_beam(analog, POSITION), POSITION)
    assert link.best_rate(analog) * small.scenario.subband_width_hz / np.log(2) == pytest.approx(
        expected, rel=1e-9)


def test_scatter_multiplies_by_the_covariance(table1):
    link = BandLink.to(table1.scenario, POSITION, 1)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(2, 3, 100, 2)) @ [1, 1j]
    np.testing.assert_allclose(
        link.scatter(weights), weights @ table1.vectors['V'][1], rtol=1e-5,
        atol=1e-9 * np.abs(link.spatial).max())


def test_the_modes_contain_nearly_all_of_the_multipath_power(table1):
    for band in range(2):
        link = BandLink.to(table1.scenario, POSITION, band)
        assert link.modes.shape[1] < 20
        rest = link.spatial - link.modes @ link.modes.T
        values = np.linalg.eigvalsh(rest)
        assert values[0] > -1e-9 * np.trace(link.spatial)
        assert 0 < np.trace(rest) <= 0.02 * np.trace(link.spatial)


def test_shared_arrays_are_read_only(table1):
    link = BandLink.to(table1.scenario, POSITION, 0)
    for array in (link.onboard, link.spatial, link.modes):
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 0
