"""Eq. (10) at a position and over a posterior, and beam patterns, compared with plain loops."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.calibration import survey
from rhs_isac_ros.link import (
    Beamformer,
    actual_capacity,
    beam_pattern,
    capacity,
    capacity_report,
    expected_capacities,
    steer,
)
from rhs_isac_ros.link.capacity import posterior_points
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.hall import PathChannel
from rhs_isac_ros.model.multipath import spatial_covariance

POSITION = np.array([9.0, 1.5, -0.4])
# Long in range and short across, as are the posteriors of the shipped codebook.
LONG = np.diag([0.9, 0.2, 0.12])**2


def random_beam(scenario, rng, band=0):
    digital = rng.normal(size=(scenario.n_subbands, scenario.n_feeds, 2)) @ [1, 1j]
    digital *= np.sqrt(scenario.max_power_w / np.sum(np.abs(digital)**2))
    return Beamformer(rng.uniform(size=scenario.n_elements), digital, band)


def test_capacity_matches_the_reference_values(case):
    beam = Beamformer(case.vectors['tx_analog'], case.vectors['tx_digital'], 0)
    values = capacity(case.scenario, beam, case.vectors['positions'])
    assert values.shape == case.vectors['capacity_band1'].shape
    np.testing.assert_allclose(values, case.vectors['capacity_band1'], rtol=1e-8)


@pytest.mark.parametrize('band', [0, 1])
def test_each_band_has_its_own_capacity(table1, reference_link, band):
    rng = np.random.default_rng(band)
    beam, position = random_beam(table1.scenario, rng, band), np.array([7.0, 2.0, -0.4])
    value = capacity(table1.scenario, beam, position[None])[0]
    assert value == pytest.approx(reference_link(table1, band).capacity(beam, position), rel=1e-8)
    other = dataclasses.replace(beam, band=1 - band)
    assert capacity(table1.scenario, other, position[None])[0] != pytest.approx(value, rel=1e-4)


def test_a_beam_that_is_off_has_no_capacity(small):
    scenario = small.scenario
    positions = scenario.sample_positions(3, np.random.default_rng(2))
    beam = random_beam(scenario, np.random.default_rng(2))
    for off in (Beamformer(np.zeros(16), beam.digital),
                Beamformer(beam.analog, np.zeros((3, 2), complex))):
        assert (capacity(scenario, off, positions) == 0).all()


@pytest.mark.parametrize(('changes', 'words'), [
    ({'analog': np.ones(15)}, ['analog: shape (15,)', '[N_E] = (16,)']),
    ({'analog': np.ones((1, 16))}, ['analog: shape (1, 16)']),
    ({'digital': np.ones((2, 2))}, ['digital: shape (2, 2)', '[N_SB, K] = (3, 2)']),
    ({'digital': np.ones(3)}, ['digital: shape (3,)']),
    ({'band': 1}, ['band: 1', 'expected 0 to 0']),
    ({'band': -1}, ['band: -1', 'expected 0 to 0']),
])
def test_a_beam_that_does_not_fit_the_scenario_is_an_error(small, changes, words):
    beam = dataclasses.replace(
        Beamformer(small.vectors['tx_analog'], small.vectors['tx_digital']), **changes)
    with pytest.raises(ValueError, match='expected') as caught:
        capacity(small.scenario, beam, np.array([[9.0, 0.0, 0.0]]))
    for word in words:
        assert word in str(caught.value)


def rotated(covariance, seed=0):
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return axes @ covariance @ axes.T


@pytest.mark.parametrize(('covariance', 'band'), [(rotated(LONG), 0), (0.3**2 * np.eye(3), 1)],
                         ids=['rotated', 'isotropic'])
def test_expected_capacity_matches_random_draws(table1, covariance, band):
    scenario = table1.scenario
    beam = steer(scenario, POSITION, band)
    draws = np.random.default_rng(1).multivariate_normal(POSITION, covariance, 4000)
    rates = capacity(scenario, beam, draws)
    (expected,) = expected_capacities(scenario, [beam], POSITION, covariance)
    assert expected == pytest.approx(rates.mean(), abs=4 * rates.std() / np.sqrt(len(rates)))
    assert expected < capacity(scenario, beam, POSITION[None])[0]


@pytest.mark.parametrize('covariance', [LONG, rotated(LONG), rotated(np.diag([1.0, 0.3, 0.0]))])
def test_points_have_the_moments_of_the_posterior(table1, covariance):
    points, weights = posterior_points(table1.scenario, POSITION, covariance)
    assert len(points) <= 27
    assert weights.min() > 0
    assert weights.sum() == pytest.approx(1, rel=1e-12)
    offsets = points - POSITION
    np.testing.assert_allclose(weights @ offsets, 0, atol=1e-12)
    np.testing.assert_allclose(
        np.einsum('n,na,nb->ab', weights, offsets, offsets), covariance, atol=1e-9)
    direction = np.array([0.6, -0.5, 0.4])
    variance = direction @ covariance @ direction
    fourth = weights @ (offsets @ direction)**4
    assert fourth == pytest.approx(3 * variance**2, rel=1e-9)


def test_no_point_is_closer_to_the_surface_than_region_and_mean(table1):
    scenario = table1.scenario
    low_m = scenario.roi_bounds_m[0][0]
    points, _ = posterior_points(scenario, np.array([6.0, 0, 0]), 25 * np.eye(3))
    assert points[:, 0].min() == low_m
    # The mean itself is never moved.
    points, _ = posterior_points(scenario, np.array([2.0, 0, 0]), 25 * np.eye(3))
    assert points[:, 0].min() == 2.0
    assert points[:, 0].max() > 6


@pytest.mark.parametrize('covariance', [
    -np.eye(3), np.arange(9.0).reshape(3, 3), np.full((3, 3), 1e300), 1e308 * np.eye(3),
    np.full((3, 3), 1.7e308), np.full((3, 3), 5e-324)])
def test_an_invalid_covariance_still_gives_a_finite_capacity(table1, covariance):
    scenario = table1.scenario
    beam = steer(scenario, POSITION)
    (expected,) = expected_capacities(scenario, [beam], POSITION, covariance)
    assert 0 < expected <= capacity(scenario, beam, POSITION[None])[0] * 1.1


@pytest.mark.parametrize(('mean', 'covariance', 'name'), [
    (np.zeros(2), np.eye(3), 'mean'), (np.array([9, np.nan, 0]), np.eye(3), 'mean'),
    (POSITION, np.eye(2), 'covariance'), (POSITION, np.ones(9), 'covariance'),
    (POSITION, np.full((3, 3), np.inf), 'covariance')])
def test_invalid_moments_are_errors_that_name_the_field(table1, mean, covariance, name):
    with pytest.raises(ValueError, match=rf'^{name}: .* expected '):
        posterior_points(table1.scenario, mean, covariance)


def test_a_measured_covariance_has_its_own_capacity(table1, reference_link, shipped):
    """Multipath of one direction: the covariance is complex, unlike a declared one."""
    scenario, rng = table1.scenario, np.random.default_rng(0)
    model = MeasurementModel(scenario, shipped)
    places = scenario.sample_positions(40, rng)
    wave = np.exp(2j * np.pi * rng.uniform(size=100)) * 1e-3
    gains = rng.normal(size=(40, 2)) @ [1, 1j]
    received = model.sample(places, rng) + gains[:, None, None] * (model.radiation @ wave)
    measured = dataclasses.replace(
        scenario, multipath=survey(scenario, shipped, places, received))
    spatial = spatial_covariance(measured).matrix
    assert np.abs(spatial[0].imag).max() > 0.05 * np.abs(spatial[0]).max()
    link = reference_link(table1)
    link.spatial = spatial[0]
    beam = random_beam(scenario, rng)
    assert capacity(measured, beam, POSITION[None])[0] == pytest.approx(
        link.capacity(beam, POSITION), rel=1e-8)
    steered = steer(measured, POSITION)
    assert capacity(measured, steered, POSITION[None])[0] > 1.1 * capacity(
        measured, beam, POSITION[None])[0]


def test_the_actual_capacity_is_that_of_the_paths(small):
    """A reflection in phase with the direct path doubles the amplitude."""
    scenario, rng = small.scenario, np.random.default_rng(0)
    beam, users = random_beam(scenario, rng), scenario.sample_positions(3, rng)
    assert actual_capacity(scenario, beam, users) == pytest.approx(
        capacity(scenario, beam, users))
    blocked = np.array([False, True, False])
    assert actual_capacity(scenario, beam, users, blocked) == pytest.approx(
        np.where(blocked, capacity(scenario, beam, 1e9 * users), capacity(scenario, beam, users)))
    f0 = scenario.center_frequencies_hz[0]
    distance = np.linalg.norm(users, axis=1)[:, None]
    a = np.tile(299_792_458 / (4 * np.pi * f0 * distance), (1, 2)) + 0j
    paths = PathChannel(users, a, np.stack([users, users], axis=1), np.tile([0, 1], (3, 1)), f0)
    traced = dataclasses.replace(scenario, channel=paths)
    no_multipath = dataclasses.replace(
        scenario, multipath_to_los_db=-200.0, noise_psd_dbm_hz=scenario.noise_psd_dbm_hz
        - 10 * np.log10(4))
    np.testing.assert_allclose(actual_capacity(traced, beam, users),
                               capacity(no_multipath, beam, users), rtol=1e-6)
    np.testing.assert_allclose(capacity(traced, beam, users), capacity(scenario, beam, users))
    report = capacity_report(traced, steer(traced, users[0]), users[0])
    assert abs(report.loss_percent) < 1
    assert report.actual_bps == pytest.approx(
        actual_capacity(traced, steer(traced, users[0]), users[:1])[0], rel=1e-9)


def test_the_pattern_matches_plain_loops(small, reference_link):
    link, beam = reference_link(small), random_beam(small.scenario, np.random.default_rng(3))
    found = beam_pattern(small.scenario, beam, 4.0, step_deg=45.0)
    angles = np.radians([-90, -45, 0, 45, 90])
    power = np.zeros((5, 5))
    for e, elevation in enumerate(angles):
        for a, azimuth in enumerate(angles):
            position = 4.0 * np.array([np.cos(elevation) * np.cos(azimuth),
                                       np.cos(elevation) * np.sin(azimuth),
                                       np.sin(elevation)])
            assert 4.0 * found.directions[e, a] == pytest.approx(position)
            weights = np.einsum('jk,jkm->jm', beam.digital, link.onboard) * beam.analog
            power[e, a] = np.sum(np.abs(np.sum(weights * link.los(position), axis=1))**2)
    assert found.relative == pytest.approx(power / power.max(), rel=1e-8)
    assert found.distance_m == 4.0


def test_both_cuts_contain_the_strongest_direction(small):
    found = beam_pattern(
        small.scenario, random_beam(small.scenario, np.random.default_rng(4)), 7.0)
    azimuth, azimuth_cut = found.azimuth_cut()
    elevation, elevation_cut = found.elevation_cut()
    assert np.degrees(azimuth) == pytest.approx(np.arange(-90, 91, 5))
    assert np.degrees(elevation) == pytest.approx(np.arange(-90, 91, 5))
    assert azimuth_cut.max() == elevation_cut.max() == 1.0
    (row,), (column,) = np.nonzero(found.relative == 1.0)
    assert found.peak == (row, column)
    assert (azimuth_cut == found.relative[row]).all()
    assert (elevation_cut == found.relative[:, column]).all()


@pytest.mark.parametrize('azimuth_deg', [-30.0, 25.0])
def test_the_strongest_direction_is_the_direction_of_steering(azimuth_deg):
    scenario, azimuth = Scenario(), np.radians(azimuth_deg)
    position = 10.0 * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    found = beam_pattern(scenario, steer(scenario, position), 10.0, step_deg=2.5)
    angles, power = found.azimuth_cut()
    assert np.degrees(angles[np.argmax(power)]) == pytest.approx(azimuth_deg, abs=5.0)


def test_the_pattern_of_a_beam_that_is_off_is_zero(small):
    beam = random_beam(small.scenario, np.random.default_rng(5))
    found = beam_pattern(small.scenario, Beamformer(np.zeros(16), beam.digital), 5.0)
    assert (found.relative == 0).all()


def test_errors_name_field_value_and_expectation(small):
    beam = random_beam(small.scenario, np.random.default_rng(6))
    with pytest.raises(ValueError, match='distance_m: 0, expected a positive number'):
        beam_pattern(small.scenario, beam, 0)
    with pytest.raises(ValueError, match='step_deg: -1, expected a positive number'):
        beam_pattern(small.scenario, beam, 1, step_deg=-1)
    with pytest.raises(ValueError, match='band: 7'):
        beam_pattern(small.scenario, Beamformer(beam.analog, beam.digital, 7), 1)
