"""Range and direction cosines."""

import numpy as np

from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions


def positions_in_front(n, seed):
    return np.random.default_rng(seed).uniform([0.5, -6, -6], [12, 6, 6], (n, 3))


def test_points_are_range_and_direction_cosines():
    for x, y, z in positions_in_front(5, 0):
        distance = (x * x + y * y + z * z)**0.5
        point = to_polar(np.array([x, y, z]))
        np.testing.assert_allclose(point, [distance, y / distance, z / distance], rtol=1e-14)


def test_the_conversions_are_inverse_to_each_other():
    positions = positions_in_front(60, 1).reshape(5, 4, 3, 3)
    np.testing.assert_allclose(to_positions(to_polar(positions)), positions, rtol=1e-10)


def test_directions_outside_the_unit_circle_have_x_0():
    positions = to_positions(np.array([[2.0, 0.9, 0.9], [2.0, 1.0, 0.0]]))
    np.testing.assert_allclose(positions, [[0, 1.8, 1.8], [0, 2, 0]], atol=1e-14)


def test_jacobian_matches_finite_differences():
    points, step = to_polar(positions_in_front(20, 2)), 1e-6
    matrices = jacobian(points)
    assert matrices.shape == (20, 3, 3)
    for a in range(3):
        shift = step * np.eye(3)[a]
        difference = (to_positions(points + shift) - to_positions(points - shift)) / (2 * step)
        np.testing.assert_allclose(matrices[:, :, a], difference, rtol=1e-6, atol=1e-6)
