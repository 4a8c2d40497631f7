"""Expected capacity against random draws, and the points that stand for a posterior."""

import numpy as np
import pytest

from rhs_isac_ros.link import capacity, expected_capacity, steer
from rhs_isac_ros.link.expected import posterior_points

PLACE = np.array([9.0, 1.5, -0.4])
# Like the posteriors of the shipped codebook: long in range, short across.
LONG = np.diag([0.9, 0.2, 0.12])**2


def turned(covariance, seed=0):
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return axes @ covariance @ axes.T


@pytest.mark.parametrize('covariance', [LONG, turned(LONG), 0.3**2 * np.eye(3)],
                         ids=['along', 'turned', 'round'])
@pytest.mark.parametrize('band', [0, 1])
def test_the_mean_is_that_of_random_draws(table1, covariance, band):
    scenario = table1.scenario
    beam = steer(scenario, PLACE, band)
    draws = np.random.default_rng(1).multivariate_normal(PLACE, covariance, 4000)
    rates = capacity(scenario, beam, draws)
    expected = expected_capacity(scenario, beam, PLACE, covariance)
    assert expected == pytest.approx(rates.mean(), abs=4 * rates.std() / np.sqrt(len(rates)))
    assert expected < capacity(scenario, beam, PLACE[None])[0]


def test_without_variance_it_is_the_capacity_at_the_mean(table1):
    scenario = table1.scenario
    beam = steer(scenario, PLACE)
    assert expected_capacity(scenario, beam, PLACE, np.zeros((3, 3))) == capacity(
        scenario, beam, PLACE[None])[0]


@pytest.mark.parametrize('covariance', [LONG, turned(LONG), turned(np.diag([1.0, 0.3, 0.0]))])
def test_points_have_the_moments_of_the_posterior(table1, covariance):
    points, weights = posterior_points(table1.scenario, PLACE, covariance)
    assert len(points) <= 27
    assert weights.min() > 0
    assert weights.sum() == pytest.approx(1, rel=1e-12)
    offsets = points - PLACE
    np.testing.assert_allclose(weights @ offsets, 0, atol=1e-12)
    np.testing.assert_allclose(
        np.einsum('n,na,nb->ab', weights, offsets, offsets), covariance, atol=1e-9)
    direction = np.array([0.6, -0.5, 0.4])
    variance = direction @ covariance @ direction
    fourth = weights @ (offsets @ direction)**4
    assert fourth == pytest.approx(3 * variance**2, rel=1e-9)


def test_axes_without_variance_have_one_node(table1):
    points, weights = posterior_points(table1.scenario, PLACE, np.zeros((3, 3)))
    np.testing.assert_array_equal(points, [PLACE])
    np.testing.assert_array_equal(weights, [1])
    points, _ = posterior_points(table1.scenario, PLACE, np.diag([0, 1.0, 0]))
    assert len(points) == 3
    assert (points[:, [0, 2]] == PLACE[[0, 2]]).all()


def test_no_point_is_nearer_to_the_surface_than_a_user_can_be(table1):
    scenario = table1.scenario
    begins_m = scenario.roi_bounds_m[0][0]
    points, _ = posterior_points(scenario, np.array([6.0, 0, 0]), 25 * np.eye(3))
    assert points[:, 0].min() == begins_m
    # A mean that is nearer still is believed.
    points, _ = posterior_points(scenario, np.array([2.0, 0, 0]), 25 * np.eye(3))
    assert points[:, 0].min() == 2.0
    assert points[:, 0].max() > 6


def test_the_same_posterior_has_the_same_points(table1):
    first, second = (posterior_points(table1.scenario, PLACE, turned(LONG)) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize('covariance', [
    -np.eye(3), np.arange(9.0).reshape(3, 3), np.full((3, 3), 1e300), 1e308 * np.eye(3),
    np.full((3, 3), 1.7e308), np.full((3, 3), 5e-324)])
def test_what_is_no_covariance_still_gives_a_number(table1, covariance):
    scenario = table1.scenario
    beam = steer(scenario, PLACE)
    expected = expected_capacity(scenario, beam, PLACE, covariance)
    assert 0 < expected <= capacity(scenario, beam, PLACE[None])[0] * 1.1


@pytest.mark.parametrize(('mean', 'covariance', 'name'), [
    (np.zeros(2), np.eye(3), 'mean'), (np.array([9, np.nan, 0]), np.eye(3), 'mean'),
    (PLACE, np.eye(2), 'covariance'), (PLACE, np.ones(9), 'covariance'),
    (PLACE, np.full((3, 3), np.inf), 'covariance')])
def test_what_is_no_posterior_is_an_error(table1, mean, covariance, name):
    with pytest.raises(ValueError, match=rf'(?s)^{name}: .* expected \[3.* finite'):
        posterior_points(table1.scenario, mean, covariance)
