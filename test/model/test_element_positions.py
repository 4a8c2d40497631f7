"""Elements at any positions, such as those of a curved panel."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.codebook.unoptimised import random_codebook
from rhs_isac_ros.link import capacity, steer
from rhs_isac_ros.model import Scenario, ScenarioError, geometry
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import declared_covariance, multipath_covariance
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.system import System


def placed(positions, **changes):
    return Scenario(**{'n_feeds': 2, 'element_positions_m': positions, **changes})


def curved(n=5, radius_m=0.4):
    """A cylindrical panel about z, with elements behind the plane x = 0 at its ends."""
    angle, z = np.meshgrid(np.linspace(-0.2, 0.2, n), np.linspace(-0.06, 0.06, n))
    return np.stack([radius_m * (np.cos(angle) - 1), radius_m * np.sin(angle), z], -1).reshape(
        -1, 3)


@pytest.mark.parametrize('changes', [{}, {
    'multipath_direction_deg': (20, -10), 'element_gain': lambda angles: np.maximum(
        np.cos(angles), 0)}])
def test_given_positions_of_a_grid_are_the_grid(changes):
    grid = Scenario(elements_per_side=(5, 4), n_feeds=2, **changes)
    given = placed(geometry.element_positions(grid), **changes)
    assert given.n_elements == 20
    np.testing.assert_allclose(geometry.feed_positions(given), geometry.feed_positions(grid))
    spatial, expected = (multipath_covariance(one) for one in (given, grid))
    np.testing.assert_allclose(spatial, expected, atol=1e-7 * np.abs(expected).max())
    np.testing.assert_allclose(
        declared_covariance(given).power, declared_covariance(grid).power, rtol=1e-7)
    users = grid.sample_positions(3, np.random.default_rng(0))
    np.testing.assert_array_equal(los_gain(given, users, 1), los_gain(grid, users, 1))


def test_a_curved_panel_has_a_bound_an_estimator_and_beams():
    scenario, rng = placed(curved()), np.random.default_rng(0)
    assert Scenario(**scenario.changes()) == scenario
    assert scenario.id != placed(curved(radius_m=0.5)).id
    model = System(scenario, random_codebook(scenario, rng))
    users, step = scenario.sample_positions(4, rng), 1e-6 * rng.normal(size=3)
    _, slopes = model.mean_and_jacobian(users)
    change = (model.mean(users + step) - model.mean(users - step)) / 2
    np.testing.assert_allclose(np.einsum('nuir,u->nir', slopes, step), change,
                               atol=1e-4 * np.abs(change).max())
    # The quadratic form of a covariance is positive for a panel that is not flat.
    assert np.linalg.eigvalsh(multipath_covariance(scenario)).min() > -1e-12
    estimates = BayesEstimator(model).estimate(model.sample(users, rng))
    assert estimates.fix.all()
    beam = steer(scenario, users[0])
    assert capacity(scenario, beam, users[:1])[0] > capacity(
        scenario, dataclasses.replace(beam, analog=np.full(25, 0.5)), users[:1])[0]


def test_a_survey_of_the_multipath_needs_a_grid():
    hall = Scenario.from_yaml(Path(__file__).parents[2] / 'config' / 'hall.yaml')
    with pytest.raises(ScenarioError, match='^element_positions_m: with a file multipath, exp'):
        dataclasses.replace(hall, element_positions_m=curved())
