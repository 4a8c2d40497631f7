"""Shapes of a scene, compared with their geometry."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rhs_isac_ros.link import BeamPattern
from rhs_isac_ros.monitoring.shapes import ellipsoid_95, lobe_m, user_colour

# From a table of the chi-square distribution with three degrees of freedom.
CHI_SQUARE_95 = 7.815


@pytest.mark.parametrize('seed', range(4))
def test_the_ellipsoid_is_that_of_the_covariance(seed):
    root = np.random.default_rng(seed).normal(size=(3, 3))
    half_m, quaternion = ellipsoid_95(root @ root.T)
    turn = Rotation.from_quat(quaternion).as_matrix()
    assert turn @ np.diag(half_m**2) @ turn.T == pytest.approx(
        CHI_SQUARE_95 * root @ root.T, rel=1e-3, abs=1e-3)


def test_a_covariance_that_is_negative_by_rounding_gives_no_extent():
    half_m, _ = ellipsoid_95(np.diag([1.0, 0.0, -1e-18]))
    assert sorted(half_m) == pytest.approx([0, 0, np.sqrt(CHI_SQUARE_95)], rel=1e-3)


def test_the_radius_of_a_lobe_is_the_level_in_decibels():
    """0 dB is at the distance of the pattern, -20 dB at the centre."""
    directions = np.array([[[1.0, 0, 0], [0, 1, 0]], [[0, 0, 1], [0.6, 0.8, 0]]])
    relative = np.array([[1.0, 0.1], [0.01, 0.0]])
    points = lobe_m(BeamPattern(directions, relative, 8.0))
    assert points == pytest.approx(np.array([[[8, 0, 0], [0, 4, 0]], [[0, 0, 0], [0, 0, 0]]]))


def test_users_have_different_colours():
    colours = {user_colour(user) for user in (1, 2, 3, 2**32 - 1)}
    assert len(colours) == 4
    assert all(0 <= part <= 1 for colour in colours for part in colour)
