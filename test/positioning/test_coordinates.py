"""Range and direction cosines, and offsets from modes to the region of interest."""

import numpy as np

from rhs_isac_ros.positioning.coordinates import (
    is_inside,
    likelihood_loss,
    offset_to_roi,
    to_polar,
    to_positions,
)

BOUNDS = np.array([[6.0, -4.0, -1.0], [14.0, 4.0, 1.0]])
# Range and direction are independent here.
UNCOUPLED = np.diag([1e6, 1e3, 1e3])
COUPLED = np.array([[1e6, 2e3, -1e3], [2e3, 1e3, 0.0], [-1e3, 0.0, 1e3]])


def curvatures(matrix, n):
    return np.tile(matrix, (n, 1, 1))


def test_the_region_includes_its_border():
    centre = BOUNDS.mean(axis=0)
    assert is_inside(np.stack([centre, *BOUNDS]), BOUNDS).all()
    for axis in range(3):
        for bound, direction in zip(BOUNDS, (-1, 1), strict=True):
            beyond = centre.copy()
            beyond[axis] = bound[axis] + direction * 1e-9
            assert not is_inside(beyond[None, None], BOUNDS).any()


def test_offsets_inside_the_region_are_zero():
    points = to_polar(np.random.default_rng(0).uniform(*BOUNDS, (50, 3)))
    np.testing.assert_allclose(
        offset_to_roi(points, curvatures(COUPLED, 50), BOUNDS, 0.02), 0, atol=1e-12)


def test_offsets_follow_the_sphere_to_the_border_of_the_region():
    points = to_polar(np.array([[10.0, 0.0, 1.5], [10.0, 4.5, 0.0], [9.0, -5.0, -1.2]]))
    offset = offset_to_roi(points, curvatures(UNCOUPLED, 3), BOUNDS, 0.02)
    np.testing.assert_array_equal(offset[:, 0], 0)
    low, high = BOUNDS
    positions = to_positions(points + offset)
    assert (positions >= low - 0.02).all()
    assert (positions <= high + 0.02).all()


def test_ranges_that_do_not_reach_the_region_change():
    points = np.array([[5.0, 0.0, 0.0]])
    offset = offset_to_roi(points, curvatures(UNCOUPLED, 1), BOUNDS, 0.02)
    # A range error of 2 cm is tolerated.
    np.testing.assert_allclose(offset, [[0.98, 0, 0]], atol=1e-12)


def test_the_range_changes_with_the_direction_so_that_the_loss_is_smallest():
    points = to_polar(np.array([[10.0, 0.0, 1.5], [10.0, 4.5, 0.0]]))
    curvature = curvatures(COUPLED, 2)
    offset = offset_to_roi(points, curvature, BOUNDS, 0.02)
    loss = likelihood_loss(offset, curvature)
    assert (offset[:, 0] != 0).all()
    for step_m in (-1e-5, 1e-5):
        assert (likelihood_loss(offset + [step_m, 0, 0], curvature) > loss).all()


def test_the_loss_is_the_quadratic_form():
    offset = np.array([[1e-3, 0.02, -0.01]])
    expected = sum(offset[0, a] * COUPLED[a, b] * offset[0, b] for a in range(3)
                   for b in range(3)) / 2
    np.testing.assert_allclose(likelihood_loss(offset, COUPLED[None]), [expected])
