"""Line-of-sight gains and their derivatives."""

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import (
    los_and_derivative,
    los_gain,
    los_sums,
)


def test_gains_match_the_vectors(case):
    for band, expected in enumerate(case.vectors['los']):
        gains = los_gain(case.scenario, case.vectors['positions'], band)
        assert gains.shape == expected.shape
        np.testing.assert_allclose(gains, expected, rtol=1e-8)


@pytest.fixture
def wide() -> Scenario:
    """A scenario whose sub-bands, gains and distances all differ from Table I."""
    return Scenario(
        center_frequencies_hz=(1e9, 2.2e9), n_subbands=5, subband_width_hz=7e6,
        elements_per_side=3, element_gain=1.7, user_gain=0.3, roi_center_m=(2, 1, 0),
        roi_size_m=(3, 4, 2))


def test_gains_and_derivatives_match_the_definition(wide, plain):
    """Derivatives are also limits of differences of the gains."""
    positions, step = wide.sample_positions(3, np.random.default_rng(0)), 1e-5
    p = plain(wide)
    for band in range(wide.n_bands):
        gains, slopes = los_and_derivative(wide, positions, band)
        np.testing.assert_array_equal(gains, los_gain(wide, positions, band))
        assert gains.shape == (3, 5, 9)
        assert slopes.shape == (3, 3, 5, 9)
        for n, position in enumerate(positions):
            for j in range(5):
                for m in range(9):
                    np.testing.assert_allclose(
                        gains[n, j, m], p.los(position, band, j, m), rtol=1e-10)
                    difference = [
                        (p.los(position + shift, band, j, m) - p.los(position - shift, band, j, m))
                        / (2 * step) for shift in step * np.eye(3)]
                    np.testing.assert_allclose(
                        slopes[n, :, j, m], p.los_slope(position, band, j, m), rtol=1e-10)
                    np.testing.assert_allclose(
                        slopes[n, :, j, m], difference, rtol=0, atol=1e-7 * np.abs(slopes).max())


def test_sums_over_the_elements_are_those_of_the_gains(table1):
    scenario, rng = table1.scenario, np.random.default_rng(0)
    positions = scenario.sample_positions(4, rng)
    weights = rng.normal(size=(2, scenario.n_subbands, scenario.n_elements, 2)) @ [1, 1j]
    found = los_sums(scenario, positions, [1, 0], weights)
    for by_band, band, row in zip(found, [1, 0], weights, strict=True):
        expected = np.einsum('njm,jm->nj', los_gain(scenario, positions, band), row)
        np.testing.assert_allclose(by_band, expected, rtol=1e-9)
