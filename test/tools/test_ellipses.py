"""Ellipses against a tabulated quantile and a rotation matrix."""

import numpy as np
import pytest

from rhs_isac_ros.tools.pictures import ellipse_95, limits_with_ellipses

# From a table of the chi-square distribution with two degrees of freedom.
CHI_SQUARE_95 = 5.991


@pytest.mark.parametrize('seed', range(3))
def test_the_ellipse_matches_the_covariance(seed):
    root = np.random.default_rng(seed).normal(size=(2, 2))
    width, height, angle_deg = ellipse_95(root @ root.T)
    angle = np.radians(angle_deg)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    found = rotation @ np.diag([width**2, height**2]) @ rotation.T / 4
    assert found == pytest.approx(CHI_SQUARE_95 * root @ root.T, rel=1e-3)


def test_the_ellipse_of_no_variance_is_a_point():
    assert ellipse_95(np.zeros((2, 2)))[:2] == (0.0, 0.0)


def test_limits_contain_the_ellipses_up_to_the_bounds():
    limits, bounds = np.array([[0.0, 0.0], [10.0, 10.0]]), np.array([[-2.0, -2.0], [12.0, 12.0]])
    width, height, _ = ellipse_95(np.diag([0.25, 1e6]))
    assert limits_with_ellipses(
        limits, bounds, [np.array([9.5, 5.0])], [np.diag([0.25, 1e6])]) == pytest.approx(
            np.array([[0.0, -2.0], [9.5 + min(width, height) / 2, 12.0]]))
    inside = limits_with_ellipses(limits, bounds, [np.array([5.0, 5.0])], [np.eye(2)])
    assert inside.tolist() == limits_with_ellipses(limits, bounds, [], []).tolist() == (
        limits.tolist())
