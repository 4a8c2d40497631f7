"""Positions of elements and feeds, frequencies of sub-bands."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model import geometry as g


def test_positions_and_frequencies_match_the_vectors(case):
    s, vectors = case.scenario, case.vectors
    np.testing.assert_allclose(
        g.element_positions(s), vectors['element_positions'], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        g.feed_positions(s), vectors['feed_positions'], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(g.subband_frequencies_hz(s), vectors['subband_hz'], rtol=1e-14)


@pytest.mark.parametrize('scenario', [
    Scenario(elements_per_side=1, n_feeds=1, n_subbands=1, center_frequencies_hz=(1e9,)),
    Scenario(elements_per_side=5, n_feeds=4, n_subbands=5, center_frequencies_hz=(1e9, 2e9, 9e9),
             element_interval_wavelengths=0.5),
    Scenario(elements_per_side=(5, 2), n_feeds=2),
    Scenario(elements_per_side=(2, 3), n_feeds=2, element_interval_wavelengths=(0.4, 0.25)),
], ids=['one of each', 'odd', 'rectangle', 'two intervals'])
def test_positions_and_frequencies_match_the_definition(scenario, plain):
    p = plain(scenario)
    n_elements, n_feeds = scenario.n_elements, scenario.n_feeds
    assert g.element_intervals_m(scenario) == pytest.approx(p.intervals, rel=1e-14)
    np.testing.assert_allclose(
        g.element_positions(scenario), [p.element(m) for m in range(n_elements)], atol=1e-15)
    np.testing.assert_allclose(
        g.feed_positions(scenario), [p.feed(k) for k in range(n_feeds)], atol=1e-15)
    np.testing.assert_allclose(
        g.subband_frequencies_hz(scenario),
        [[p.frequency(i, j) for j in range(scenario.n_subbands)] for i in range(scenario.n_bands)],
        rtol=1e-14)


def test_bands_follow_each_other_with_time_to_retune():
    scenario = Scenario(n_frames=3, frame_duration_s=0.01, retune_s=0.1,
                        center_frequencies_hz=(2e9, 1e9))
    expected = np.array([[0.0, 0.01, 0.02], [0.13, 0.14, 0.15]])
    np.testing.assert_allclose(g.frame_times_s(scenario), expected - expected.mean(), atol=1e-16)


def test_frame_times_are_relative_to_the_reference_time():
    scenario = Scenario(n_frames=7, frame_duration_s=0.015, center_frequencies_hz=(1e9, 2e9, 3e9))
    times = g.frame_times_s(scenario)
    assert times.shape == (3, 7)
    assert times.mean() == pytest.approx(0, abs=1e-16)
    np.testing.assert_allclose(np.diff(times.ravel()), 0.015)
    np.testing.assert_allclose(times - times[:, :1], [g.frame_lags_s(scenario)] * 3)


@pytest.mark.parametrize(('changes', 'is_named'), [
    ({}, False), ({'retune_s': 1e-3}, False), ({'retune_s': 5e-3}, True),
    ({'frame_duration_s': 0.015, 'max_user_speed_mps': 0.05}, False),
    ({'frame_duration_s': 0.015}, True),
    ({'frame_duration_s': 0.015, 'user_speed_std_mps': 1e-3}, False)])
def test_movement_warning_is_named_if_the_phase_changes_by_a_radian_in_a_cycle(
        changes, is_named):
    """Table I has 3 GHz and 5.6 m/s: 0.35 rad in a millisecond."""
    text = g.movement_warning(Scenario(**changes))
    assert text.startswith('user_speed_std_mps: 0, but users of max_user_speed_mps') is is_named
    assert ('declare about 3.2 m/s' in text) is is_named


def test_a_declared_speed_is_named_if_users_move_far_relative_to_the_range():
    scenario = Scenario(frame_duration_s=0.015, roi_center_m=(2.5, 0, 0), roi_size_m=(2, 2, 0))
    # The nearest place is 1.5 m away, and a cycle takes 0.105 s.
    texts = [g.movement_warning(dataclasses.replace(scenario, user_speed_std_mps=speed))
             for speed in (7.1, 7.2)]
    assert not texts[0]
    assert texts[1].startswith('user_speed_std_mps: 7.2, but such users move by 0.76 m')


def test_given_feed_positions_are_used():
    positions = ((0.0, -0.1, 0.2), (0.01, 0.1, 0.0), (0.0, 0.0, 0.3))
    scenario = dataclasses.replace(Scenario(), feed_positions_m=positions)
    np.testing.assert_array_equal(g.feed_positions(scenario), positions)


def positions_in_front(n, seed):
    return np.random.default_rng(seed).uniform([0.5, -6, -6], [12, 6, 6], (n, 3))


def test_the_conversions_are_inverse_to_each_other():
    positions = positions_in_front(60, 1).reshape(5, 4, 3, 3)
    np.testing.assert_allclose(g.to_positions(g.to_polar(positions)), positions, rtol=1e-10)


def test_directions_outside_the_unit_circle_have_x_0():
    positions = g.to_positions(np.array([[2.0, 0.9, 0.9], [2.0, 1.0, 0.0]]))
    np.testing.assert_allclose(positions, [[0, 1.8, 1.8], [0, 2, 0]], atol=1e-14)


def test_jacobian_matches_finite_differences():
    points, step = g.to_polar(positions_in_front(20, 2)), 1e-6
    matrices = g.jacobian(points)
    assert matrices.shape == (20, 3, 3)
    np.testing.assert_allclose(
        g.polar_derivative(points) @ matrices, np.tile(np.eye(3), (20, 1, 1)), atol=1e-10)
    for a in range(3):
        shift = step * np.eye(3)[a]
        difference = (g.to_positions(points + shift) - g.to_positions(points - shift)) / (2 * step)
        np.testing.assert_allclose(matrices[:, :, a], difference, rtol=1e-6, atol=1e-6)


def test_polar_bounds_are_the_extrema_inside():
    bounds = np.array([[6.0, -4.0, 0.5], [14.0, 4.0, 1.0]])
    axes = np.linspace(*bounds, 41).T
    points = g.to_polar(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3))
    low, high = g.polar_bounds(bounds)
    np.testing.assert_allclose(low, points.min(axis=0), rtol=1e-12)
    np.testing.assert_allclose(high, points.max(axis=0), rtol=1e-12)


def test_the_prior_of_the_region_has_its_variances(small):
    np.testing.assert_allclose(np.linalg.inv(g.region_information(small.scenario)),
                               np.diag(np.square(small.scenario.roi_size_m) / 12))
