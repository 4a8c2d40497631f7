"""Elements at any positions that face in any directions, such as those of a curved panel."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.codebook.unoptimised import random_codebook
from rhs_isac_ros.link import capacity, steer
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario, ScenarioError, geometry
from rhs_isac_ros.model.los import los_and_derivative, los_gain
from rhs_isac_ros.model.multipath import (
    declared_covariance,
    mean_los_power,
    multipath_covariance,
)
from rhs_isac_ros.model.pose import rotation_matrix
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.system import System


def placed(positions, **changes):
    return Scenario(**{'n_feeds': 2, 'element_positions_m': positions, **changes})


def curved(n=5, radius_m=0.4):
    """A cylindrical panel about z, with elements behind the plane x = 0 at its ends."""
    angle, z = np.meshgrid(np.linspace(-0.2, 0.2, n), np.linspace(-0.06, 0.06, n))
    return np.stack([radius_m * (np.cos(angle) - 1), radius_m * np.sin(angle), z], -1).reshape(
        -1, 3)


def outward(n=5):
    """The normals of `curved`, with different lengths."""
    angle = np.tile(np.linspace(-0.2, 0.2, n), n)
    return (1 + np.arange(n * n)[:, None]) * np.stack(
        [np.cos(angle), np.sin(angle), 0.3 * angle], axis=1)


def patch(angles):
    return 2 * np.maximum(np.cos(angles), 0)**1.5


def ripple(angles):
    return 1.2 + 0.5 * np.cos(4 * angles)


#: A panel so near to wide users that the angles to elements and to the x axis differ.
PANEL = placed(curved(), element_normals=outward(), element_gain=patch, user_gain=ripple,
               n_subbands=2, n_frames=2, roi_center_m=(2, 0, 0), roi_size_m=(2, 4, 2))


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


@pytest.mark.slow
@pytest.mark.parametrize('scenario', [
    placed(curved()), PANEL, dataclasses.replace(
        PANEL, user_speed_std_mps=1.0, retune_s=1e-3, band_phase_std_rad=7.0)])
def test_a_curved_panel_has_a_bound_an_estimator_and_beams(scenario):
    rng = np.random.default_rng(0)
    plain = placed(curved(), element_normals=outward())
    assert Scenario(**plain.changes()) == plain
    assert len({plain.id, placed(curved()).id, placed(curved(radius_m=0.5)).id}) == 3
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


def test_gains_of_a_curved_panel_depend_on_the_angles_to_its_normals():
    users = PANEL.sample_positions(4, np.random.default_rng(1))
    wavelength = SPEED_OF_LIGHT_MPS / geometry.subband_frequencies_hz(PANEL)[1, :, None]
    for user, found in zip(users, los_gain(PANEL, users, 1), strict=True):
        offset = user - curved()
        distance = np.linalg.norm(offset, axis=1)
        cosine = np.sum(offset * outward(), axis=1) / np.linalg.norm(outward(), axis=1) / distance
        expected = (patch(np.arccos(cosine)) * ripple(np.arccos(offset[:, 0] / distance))
                    * wavelength / (4 * np.pi * distance) * np.exp(
                        -2j * np.pi * distance / wavelength))
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_multipath_of_a_curved_panel_is_the_integral_over_directions():
    panel = dataclasses.replace(PANEL, multipath_direction_deg=(20, -10))
    pair, n, spread = [0, 19], 300, np.deg2rad(panel.angular_spread_deg)
    # Midpoints, with the cusps of the profile between them.
    azimuth, elevation = np.meshgrid(*(np.concatenate([
        low + (mean - low) * (np.arange(n) + 0.5) / n, mean + (high - mean) * (
            np.arange(n) + 0.5) / n]) for mean, low, high in np.deg2rad(
                [(20, -40, 80), (-10, -70, 50)])))
    density = np.exp(-2**0.5 * (
        abs(azimuth - np.deg2rad(20)) + abs(elevation + np.deg2rad(10))) / spread)
    waves = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                      np.sin(elevation)], axis=-1)
    turns = 2 * np.pi * 3e9 / SPEED_OF_LIGHT_MPS * (waves @ curved()[pair].T)
    units = outward()[pair] / np.linalg.norm(outward()[pair], axis=1, keepdims=True)
    gains = patch(np.arccos(waves @ units.T)) * np.exp(1j * turns)
    product = density * gains[..., 0] * np.conj(gains[..., 1])
    assert multipath_covariance(panel)[1, 0, 19] == pytest.approx(
        product.sum() / density.sum() * mean_los_power(panel, 1), rel=2e-3)


def test_a_turned_surface_has_the_gains_of_turned_users():
    flat = Scenario(elements_per_side=3, n_feeds=2, element_gain=patch)
    turn = rotation_matrix(np.array([0.1, -0.2, 0.3, 1.0]))
    turned = placed(geometry.element_positions(flat) @ turn.T, element_gain=patch,
                    element_normals=np.tile(turn[:, 0], (9, 1)))
    users = flat.sample_positions(5, np.random.default_rng(0))
    gains, slopes = los_and_derivative(turned, users @ turn.T, 0)
    expected, derivative = los_and_derivative(flat, users, 0)
    np.testing.assert_allclose(gains, expected, rtol=1e-9)
    np.testing.assert_allclose(np.einsum('nujm,uv->nvjm', slopes, turn), derivative,
                               atol=1e-9 * abs(derivative).max())


def test_normals_along_x_change_nothing_but_the_id():
    panel = dataclasses.replace(PANEL, element_normals=np.tile([3.0, 0, 0], (25, 1)))
    none = dataclasses.replace(PANEL, element_normals=None)
    users = PANEL.sample_positions(3, np.random.default_rng(0))
    for found, expected in zip(*(los_and_derivative(one, users, 0) for one in (panel, none)),
                               strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12 * abs(expected).max())
    np.testing.assert_allclose(multipath_covariance(panel), multipath_covariance(none), rtol=1e-9)
    assert panel.id != none.id


def test_a_file_with_wrong_normals_is_refused(tmp_path):
    file, positions = tmp_path / 'panel.yaml', 'element_positions_m: [[0, 0, 0], [0, 0.1, 0]]\n'
    for text, words in (
            ('element_normals: [[1, 0, 0]]\n' + positions,
             '1 vectors, expected one for each of the 2 element_positions_m'),
            ('element_normals: [[1, 0, 0], [0, 0, 0]]\n' + positions,
             r'\[0, 0, 0\], expected a length other than 0'),
            ('element_normals: [[1, 0, .nan], [1, 0, 0]]\n' + positions,
             'nan, expected -1000 to 1000')):
        file.write_text(text)
        with pytest.raises(ScenarioError, match=f'panel.yaml: element_normals: {words}'):
            Scenario.from_yaml(file)


def test_a_survey_of_the_multipath_needs_a_grid():
    hall = Scenario.from_yaml(Path(__file__).parents[2] / 'config' / 'hall.yaml')
    with pytest.raises(ScenarioError, match='^element_positions_m: with a file multipath, exp'):
        dataclasses.replace(hall, element_positions_m=curved())
