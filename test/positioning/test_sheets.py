"""Gaussians in range and direction, restricted to regions of three, two and one dimensions."""

import itertools

import numpy as np
import pytest
from scipy.stats import qmc

from rhs_isac_ros.model.gaussian import likelihood_loss
from rhs_isac_ros.model.geometry import to_polar, to_positions
from rhs_isac_ros.positioning.sheets import Inside, move_inside
from rhs_isac_ros.positioning.templates import standard_normal

CENTRE, SIZE = np.array([10.0, 4.5, -2.5]), np.array([8.0, 6.0, 2.0])
# Extents relative to SIZE: boxes, planes and lines, and two that are thin but not flat.
EXTENTS = [*itertools.product((0, 1), repeat=3)][1:] + [(1, 1, 1e-3), (1, 1e-3, 1e-3)]
# The range is known to a centimetre, the direction to a few degrees.
CURVATURE = np.array([[1e4, 2e2, -1e2], [2e2, 3e2, 0.0], [-1e2, 0.0, 4e2]])
NORMAL = standard_normal(1024)


def bounds_of(extents, centre=CENTRE):
    half = np.array(extents) * SIZE / 2
    return np.stack([centre - half, centre + half])


def grid(bounds):
    free = bounds[1] > bounds[0]
    # The modes are thin sheets.
    log2_points = 13 + 2 * int(free.sum())
    points = np.tile(bounds.mean(axis=0), (2**log2_points, 1))
    sobol = qmc.Sobol(int(free.sum()), seed=0).random_base2(log2_points)
    points[:, free] = bounds[0, free] + sobol * (bounds[1] - bounds[0])[free]
    return points


def log_density(positions, centre):
    offset = (to_polar(positions) - centre).reshape(-1, 3)
    return -likelihood_loss(offset, CURVATURE[None]).reshape(positions.shape[:-1])


def restricted(centre, bounds):
    """The Gaussian around a centre, expanded at its most likely point inside."""
    point = to_polar(np.clip(to_positions(centre), *bounds))
    for _ in range(4):
        gaussian = Inside.of(
            point[None], (CURVATURE @ (centre - point))[None], CURVATURE[None], bounds)
        point = to_polar(gaussian.nearest()[0])
    return gaussian


@pytest.mark.slow
@pytest.mark.parametrize(('extents', 'shift'), [
    *((extents, (-0.02, -0.1, 0.12)) for extents in EXTENTS),
    ((1, 1, 1), (0.0, 0.0, 0.0)), ((1, 1, 1), (0.01, 0.05, -0.03))], ids=str)
def test_samples_have_the_moments_and_the_mass_of_the_gaussian_in_the_region(extents, shift):
    """Some modes have their unrestricted maxima outside, on other sides of the border."""
    bounds, reference = bounds_of(extents), grid(bounds_of(extents))
    rng = np.random.default_rng(3)
    for inside in rng.uniform(*bounds, (2, 3)):
        centre = to_polar(inside) + shift
        gaussian = restricted(centre, bounds)
        positions, log_weights = gaussian.sample(NORMAL)
        np.testing.assert_allclose(gaussian.log_ratio(positions), log_weights, atol=1e-4)
        weights = np.exp(log_weights[0] + log_density(positions[0], centre))
        expected = np.exp(log_density(reference, centre))
        assert ((positions >= bounds[0]) & (positions <= bounds[1])).all()
        assert weights.mean() == pytest.approx(expected.mean(), rel=0.1)
        mean = np.average(reference, axis=0, weights=expected)
        std = np.sqrt(np.average((reference - mean)**2, axis=0, weights=expected))
        np.testing.assert_allclose(
            np.average(positions[0], axis=0, weights=weights), mean, atol=0.15 * std.max() + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize('extents', EXTENTS, ids=str)
def test_steps_inside_the_region_reach_the_most_likely_position(extents):
    bounds = bounds_of(extents)
    reference, rng = grid(bounds), np.random.default_rng(4)
    for inside in rng.uniform(*bounds, (2, 3)):
        centre = to_polar(inside) + [0.01, 0.1, -0.2]
        found = restricted(centre, bounds).nearest()[0]
        # Points of the grid miss the maximum by a few centimetres.
        assert log_density(found, centre) >= log_density(reference, centre).max() - 0.3
        once = move_inside(centre[None], CURVATURE[None], bounds)[0]
        assert log_density(to_positions(once), centre) >= log_density(
            reference, centre).max() - 10


def test_points_inside_do_not_move():
    bounds = bounds_of((1, 1, 1))
    points = to_polar(np.random.default_rng(0).uniform(*bounds, (50, 3)))
    np.testing.assert_array_equal(
        move_inside(points, np.tile(CURVATURE, (50, 1, 1)), bounds), points)


def test_a_grazing_direction_determines_the_range_along_the_wall():
    """A corridor along the surface: x is far shorter than y, and directions are near the rim."""
    bounds = np.array([[0.05, 15.0, -1.0], [1.5, 25.0, 1.0]])
    point = to_polar(np.array([0.4, 20.0, 0.3]))
    positions, log_weights = Inside.of(
        point[None], np.zeros((1, 3)), CURVATURE[None], bounds).sample(NORMAL)
    weights = np.exp(log_weights[0] + log_density(positions[0], point))
    expected = np.exp(log_density(grid(bounds), point)).mean()
    assert weights.mean() == pytest.approx(expected, rel=0.03)
    assert weights.sum()**2 / (weights**2).sum() > 0.5 * len(weights)


@pytest.mark.parametrize('side', [1.0, -1.0])
@pytest.mark.parametrize('extents', [(0, 0, 1), (1e-3, 0, 1), (0, 1e-3, 1)], ids=str)
def test_a_gaussian_without_direction_reaches_both_sides_of_a_line(extents, side):
    """The elements of a row along y do not tell z from -z."""
    bounds = bounds_of(extents, np.array([10.0, 1.0, 0.2]))
    inside = np.array([10.0, 1.0, 0.7 * side])
    point, curvature = to_polar(inside), np.diag([1e6, 3e2, 1e-2])
    gaussian = Inside.of(point[None], np.zeros((1, 3)), curvature[None], bounds)
    positions, log_weights = gaussian.sample(NORMAL)
    np.testing.assert_allclose(gaussian.log_ratio(positions), log_weights, atol=1e-4)
    reference = grid(bounds)
    expected = np.exp(-likelihood_loss(to_polar(reference) - point, curvature[None]))
    weights = np.exp(log_weights[0] - likelihood_loss(
        to_polar(positions[0]) - point, curvature[None]))
    assert weights.mean() == pytest.approx(expected.mean(), rel=0.05)
    assert np.average(positions[0, :, 2] < 0, weights=weights) == pytest.approx(
        np.average(reference[:, 2] < 0, weights=expected), abs=0.02)


def test_a_range_without_error_leaves_unknown_directions_unknown():
    """Strong signals at two elements along z tell nothing about y."""
    bounds = np.array([[0.2, -1.4, 0.3], [1.1, -1.1, 0.7]])
    point, curvature = to_polar(bounds.mean(axis=0)), np.diag([1e24, 1e-3, 1e15])
    positions, log_weights = Inside.of(
        point[None], np.zeros((1, 3)), curvature[None], bounds).sample(NORMAL)
    assert np.isfinite(log_weights).all()
    assert np.ptp(positions[0, :, 1]) == pytest.approx(0.3, rel=0.05)


def test_a_distant_gaussian_is_sampled_on_the_border():
    bounds = bounds_of((1, 1, 1))
    centre = to_polar(np.array([10.0, 4.0, 9.0]))
    point = to_polar(np.array([10.0, 4.0, -1.5]))
    positions, log_weights = Inside.of(
        point[None], (CURVATURE @ (centre - point))[None], CURVATURE[None], bounds).sample(NORMAL)
    assert np.isfinite(log_weights).all()
    assert (positions[0, :, 2] > -1.8).mean() > 0.8
    assert np.isfinite(to_positions(to_polar(positions))).all()


def test_axes_that_are_equally_wide_are_chosen_in_their_order_whatever_the_rounding():
    bounds = np.array([[5.0, -3.0, -3.0], [15.0, 3.0, 3.0]])
    centre = to_polar(np.array([[10.0, 0.0, 0.0]]))
    for rounding in (-1e-13, 0.0, 1e-13):
        curvature = np.diag([1e4, 3e2 * (1 + rounding), 3e2])[None]
        order = Inside.of(centre, np.zeros((1, 3)), curvature, bounds).order
        assert order.tolist() == [[1, 2, 0]]


@pytest.mark.parametrize('cosine', [-0.32, 0.0, 0.1])
def test_samples_follow_the_sphere_where_a_direction_is_unknown(cosine):
    """A row of elements does not see the height, so any height in the region is as likely."""
    bounds = np.array([[2.5, -1.5, -1.0], [5.5, 1.5, 1.0]])
    point = np.array([[2.83, -0.29, cosine]])
    gaussian = Inside.of(
        point, np.zeros((1, 3)), np.diag(np.array([1.5e-4, 3e-4, 2.0])**-2)[None], bounds)
    positions, log_ratio = gaussian.sample(standard_normal(128))
    logarithm = gaussian.logarithm(positions) + log_ratio
    weights = np.exp(logarithm - logarithm.max())
    assert np.sum(weights)**2 / np.sum(weights**2) > 0.9 * 128
    heights = positions[0, :, 2]
    assert np.average(heights, weights=weights[0]) == pytest.approx(0, abs=0.1)
    assert np.average(heights**2, weights=weights[0]) == pytest.approx(1 / 3, rel=0.1)


def test_a_maximum_behind_the_surface_does_not_move_the_samples_to_the_border():
    """Signals of one band and a few subbands determine one of the directions, and no range."""
    bounds = np.array([[5.5, -0.8, -1.6], [10.4, -0.8, 1.6]])
    point = np.array([[5.6, -0.1415, 0.147]])
    curvature = np.array([[[0.36, -12.7, 0.05], [-12.7, 468.0, -1.7], [0.05, -1.7, 0.25]]])
    gradient = np.array([[-0.6, 18.6, -0.05]])
    gaussian = Inside.of(point, gradient, curvature, bounds)
    positions, log_ratio = gaussian.sample(NORMAL)
    log_weights = (gaussian.logarithm(positions) + log_ratio)[0]
    weights = np.exp(log_weights - log_weights.max())
    reference = grid(bounds)
    exact = np.exp(gaussian.logarithm(reference[None])[0])
    for axis in (0, 2):
        expected = np.average(reference[:, axis], weights=exact)
        spread = np.sqrt(np.average((reference[:, axis] - expected)**2, weights=exact))
        found = np.average(positions[0, :, axis], weights=weights)
        assert found == pytest.approx(expected, abs=0.1 * spread)
        assert np.sqrt(np.average((positions[0, :, axis] - found)**2, weights=weights)
                       ) == pytest.approx(spread, rel=0.1)
    assert weights.sum()**2 / (weights**2).sum() > 0.5 * len(weights)
