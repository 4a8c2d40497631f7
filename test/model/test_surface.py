"""The surface: element signals, feeds, combining, and their matrix form."""

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario, elementwise, surface
from rhs_isac_ros.model.los import los_gain


@pytest.fixture(scope='module')
def odd(random_beams):
    """A small scenario with odd sizes and feeds off the centre line, and a random codebook."""
    scenario = Scenario(
        center_frequencies_hz=(1.9e9, 2.5e9, 3.3e9), n_subbands=3, n_frames=2, n_feeds=2,
        elements_per_side=3, refractive_index=1.6, subband_width_hz=2e7,
        feed_positions_m=((0.0, -0.05, 0.02), (0.01, 0.03, -0.01)))
    return scenario, random_beams(scenario, np.random.default_rng(0))


def complex_array(rng, *shape):
    return rng.normal(size=(*shape, 2)) @ [1, 1j]


def test_onboard_matrix_matches_the_vectors(case):
    matrix = surface.onboard_matrix(case.scenario)
    assert matrix.shape == case.vectors['B'].shape
    np.testing.assert_allclose(matrix, case.vectors['B'], rtol=1e-8)
    assert not matrix.flags.writeable


def test_onboard_matrix_matches_the_definition(odd, plain):
    scenario, _ = odd
    p = plain(scenario)
    matrix = surface.onboard_matrix(scenario)
    assert matrix.shape == (3, 3, 2, 9)
    for index in np.ndindex(matrix.shape):
        np.testing.assert_allclose(matrix[index], p.onboard(*index), rtol=1e-10)


def test_radiation_matrix_matches_the_definition(odd, plain):
    scenario, codebook = odd
    p = plain(scenario, codebook.analog, codebook.digital)
    matrix = surface.radiation_matrix(scenario, codebook)
    assert matrix.shape == (3, 6, 9)
    for band in range(3):
        scale = np.abs(p.pattern(band)).max()
        np.testing.assert_allclose(matrix[band], p.pattern(band), rtol=0, atol=1e-11 * scale)


def test_feeds_then_combining_equals_a_row_of_the_matrix_form(odd):
    """Row j F + q of T_i acts on the element signals of sub-band j in frame q."""
    scenario, codebook = odd
    matrix = surface.radiation_matrix(scenario, codebook)
    elements = complex_array(np.random.default_rng(5), 3, 2, 3, 9)
    for band in range(3):
        for q in range(2):
            feeds = surface.feed_signals(
                scenario, band, codebook.analog[band, q], elements[band, q])
            combined = surface.combine(codebook.digital[band, :, q], feeds, 0.0)
            for j in range(3):
                expected = sum(matrix[band, 2 * j + q, m] * elements[band, q, j, m]
                               for m in range(9))
                np.testing.assert_allclose(combined[j], expected, rtol=1e-9)


def test_the_matched_configuration_follows_the_interference(small):
    scenario = small.scenario
    los = los_gain(scenario, np.array([[8.0, 1.0, 0.2]]), 0)[0]
    onboard = surface.onboard_matrix(scenario)[0]
    matched = elementwise.matched_configuration(los, onboard)
    interference = [sum(los[j, m] * onboard[j, k, m] for j in range(3) for k in range(2)).real
                    for m in range(16)]
    assert (np.argsort(matched) == np.argsort(interference)).all()
    np.testing.assert_allclose(
        2 * matched - 1, np.array(interference) / np.abs(interference).max())
    assert matched.min() >= 0
    assert matched.max() <= 1
    assert np.isclose(matched, 0).any() or np.isclose(matched, 1).any()


@pytest.mark.parametrize('seed', range(3))
def test_the_matched_configuration_does_not_depend_on_scale_and_spans_the_range(seed):
    rng = np.random.default_rng(seed)
    los, onboard = complex_array(rng, 3, 9), complex_array(rng, 3, 2, 9)
    matched = elementwise.matched_configuration(los, onboard)
    assert matched.shape == (9,)
    np.testing.assert_allclose(elementwise.matched_configuration(1e-4 * los, onboard), matched)
    # A change of sign turns constructive into destructive interference.
    np.testing.assert_allclose(elementwise.matched_configuration(-los, onboard), 1 - matched)
    np.testing.assert_allclose(elementwise.matched_configuration(los, -onboard), 1 - matched)
    assert np.abs(matched - 0.5).max() == pytest.approx(0.5)
