"""Positions and velocities of users who move during a cycle."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtri
from walking_users import WALKING, inside, system_of, users_of

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import to_polar, to_positions, velocity_std_mps
from rhs_isac_ros.positioning import BayesEstimator, MlEstimator
from rhs_isac_ros.positioning.lattice import Resolution
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.search import Modes
from rhs_isac_ros.system import System

CONFIG = Path(__file__).parents[2] / 'config'


@pytest.fixture(scope='module')
def walking():
    system = system_of()
    return system, BayesEstimator(system)


@pytest.mark.parametrize('declared', [{}, dict(
    timing_std_s=1e-7, user_gain_std_db=2.0, carrier_offset_std_hz=3.0, element_error_rms=0.05)],
    ids=['plain', 'impaired'])
@pytest.mark.parametrize('moves', [False, True])
def test_gradient_and_information_are_those_of_the_likelihood(declared, moves):
    """The observed information differs from the expected one only by noise."""
    from rhs_isac_ros.positioning.search import OneState

    system, rng = system_of(**declared), np.random.default_rng(1)
    likelihood = Likelihood(system)
    conditional = OneState(likelihood)._conditional
    state, n = users_of(system.scenario, 1, 1.0, rng), len(likelihood.nuisance)
    signals = likelihood.signals(system.sample(state, rng))
    point, values = to_polar(state[:, :3]), 0.1 * rng.standard_normal((1, n))
    values[:, :2] = state[:, 3:5]
    local = conditional.at(point, values, moves=moves).local(values, signals)
    unknowns = np.hstack([point, values])[0]
    first = 0 if moves else 3
    assert local.gradient.shape == (1, 3 + n - first)
    for row in range(first, 3 + n):
        step = np.zeros(3 + n)
        step[row] = 1e-6
        ahead, behind = (conditional.at(one[None, :3], one[None, 3:]).local(
            one[None, 3:], signals) for one in (unknowns + step, unknowns - step))
        slope = (ahead.value - behind.value)[0] / 2e-6
        if row < 5 or not declared:
            assert local.gradient[0, row - first] == pytest.approx(
                slope, rel=1e-3, abs=0.5 if row < 3 else 1e-2)
    # What depends on a velocity that is held needs no derivatives with respect to it.
    held = conditional.at(point, values, moves=moves, turns=False).local(values, signals)
    rest = np.r_[:3 - first, 5 - first:3 + n - first]
    assert held.value == pytest.approx(local.value, abs=1e-8)
    np.testing.assert_allclose(held.gradient[:, rest], local.gradient[:, rest], atol=1e-6)
    np.testing.assert_allclose(
        held.information[:, rest[:, None], rest], local.information[:, rest[:, None], rest])


@pytest.mark.slow
def test_positions_and_velocities_are_in_their_regions(walking):
    system, estimator = walking
    rng = np.random.default_rng(2)
    states = np.vstack([users_of(system.scenario, 10, speed, rng) for speed in (0, 0.3, 1, 2)])
    estimate = estimator.estimate(system.sample(states, rng))
    assert estimate.fix.all()
    errors = np.hstack([estimate.mean, estimate.velocity]) - states
    # Nobody moves up or down.
    np.testing.assert_array_equal(estimate.velocity[:, 2], 0)
    errors, joint = np.delete(errors, [2, 5], 1), estimate.joint_covariance
    joint = np.delete(np.delete(joint, [2, 5], 1), [2, 5], 2)
    assert inside(errors[:, :2], joint[:, :2, :2], 2) >= 0.85
    assert inside(errors, joint, 4) >= 0.85
    assert np.sqrt(np.mean(errors[:, 2:]**2)) < 0.3


@pytest.mark.parametrize('changes', [
    dict(roi_center_m=(2.5, -2, 0), roi_size_m=(0, 2, 0)),
    dict(roi_center_m=(4, 0, -2), roi_size_m=(4, 2, 0), user_gain_std_db=6.0),
    dict(roi_center_m=(10, -0.4, 0.4), roi_size_m=(6, 0, 0), user_gain_std_db=6.0,
         frame_duration_s=2e-3)], ids=['line', 'gain', 'gain on a line ahead'])
def test_strong_signals_are_found_wherever_users_can_be(changes):
    """Where users cannot have all rates or ranges, starts have those that they can have."""
    system, rng = system_of(multipath_to_los_db=-20, **changes), np.random.default_rng(7)
    scenario, n = system.scenario, 8
    states = np.hstack([scenario.sample_positions(n, rng),
                        velocity_std_mps(scenario) * rng.standard_normal((n, 3))])
    estimate = BayesEstimator(system).estimate(system.sample(states, rng))
    assert estimate.fix.all()
    axes = np.flatnonzero(scenario.roi_size_m)
    assert inside((estimate.mean - states[:, :3])[:, axes],
                  estimate.covariance[:, axes[:, None], axes], len(axes)) >= 7 / 8


def test_the_nearest_rates_in_a_plane_keep_what_signals_show():
    """A radial speed turns the phase; the direction hardly changes in a cycle."""
    system = system_of(roi_center_m=(2, -2, 0), roi_size_m=(0, 1, 1))
    prior, point = Likelihood(system).nuisance, to_polar(np.array([[2.0, -2.0, 0.3]]))
    values = np.zeros((1, len(prior)))
    found = prior.rates(prior.with_rates(values, point, np.array([[1.0, 0.0, 0.0]])), point)
    assert found[0, 0] == pytest.approx(1, abs=0.05)
    values[0, :2] = 0.7, -0.4
    rates = prior.rates(values, point)
    np.testing.assert_allclose(prior.with_rates(values, point, rates), values)
    np.testing.assert_allclose(
        prior.with_rates(np.zeros_like(values), point, rates)[0, :2], values[0, :2], atol=0.05)


def test_single_frames_show_no_radial_speed():
    """Starts that differ only by such a speed would displace others."""
    scenario = dataclasses.replace(WALKING, n_frames=1, frame_duration_s=0.3)
    radial, *across = Resolution.of(scenario).rate_steps
    assert radial > 1e9
    assert max(across) < 1
    alone = dataclasses.replace(scenario, center_frequencies_hz=(5e9,))
    assert Resolution.of(alone).rate_steps.min() > 1e9
    table = BayesEstimator(system_of(n_frames=1, roi_size_m=(0, 0.5, 0)))._region.table
    np.testing.assert_array_equal(table._speeds, 0)


def test_what_a_prior_determines_does_not_reduce_the_residual():
    short, long = (BayesEstimator(
        system_of(frame_duration_s=duration_s, timing_std_s=1e-12), lazy=True)
        for duration_s in (1e-6, 0.015))
    state = users_of(WALKING, 1, 0.5, np.random.default_rng(1))
    for estimator, n_velocity in (short, 0), (long, 2):
        signals = estimator._likelihood.signals(
            estimator.system.sample(state, np.random.default_rng(2)))
        zeros = np.zeros(1)
        values = np.zeros((1, len(estimator._likelihood.nuisance)))
        values[:, :2] = state[:, 3:5]
        modes = Modes(zeros.astype(int), to_polar(state[:, :3]), zeros, zeros, zeros, values,
                      zeros, zeros)
        # Two coordinates in the plane, and the phases of two bands.
        assert estimator._n_fitted(modes, signals) == pytest.approx(4 + n_velocity, abs=0.2)


@pytest.mark.slow
def test_the_sign_of_the_speed_across_the_line_of_sight_is_found(walking):
    """Two speeds of opposite signs have equal changes of the range; their modes share a place."""
    system, estimator = walking
    state = np.array([[2.8294, -0.0726, 0.0, -0.2773, 0.9608, 0.0]] * 24)
    found = estimator.estimate(system.sample(state, np.random.default_rng(6)))
    errors = (found.velocity - state[:, 3:])[:, :2]
    squares = np.einsum('ni,nij,nj->n', errors, np.linalg.inv(
        found.velocity_covariance[:, :2, :2]), errors)
    assert np.count_nonzero(squares > chdtri(2, 1e-3)) <= 2


@pytest.fixture(scope='module')
def walkers(walking):
    """States, signals, and the posteriors without a prior."""
    system, estimator = walking
    rng = np.random.default_rng(5)
    states = users_of(system.scenario, 4, 1.0, rng)
    received = system.sample(states, rng)
    return states, received, [estimator.posterior(signals) for signals in received]


@pytest.mark.slow
@pytest.mark.parametrize('size', [3, 6], ids=['positions', 'velocities'])
def test_a_prior_changes_positions_and_velocities_together(walking, walkers, size):
    """The covariance was negative where a prior changed that of positions alone."""
    rng = np.random.default_rng(6)
    std = np.array([0.3, 0.3, 1e-4, 0.3, 0.3, 1e-4])[:size]
    variances = []
    for state, signals, without in zip(*walkers, strict=True):
        mean = state[:size] + std * rng.standard_normal(size)
        prior = Mixture(np.zeros(1), mean[None], np.diag(std**2)[None])
        variances.append([])
        for found in walking[1].posterior(signals, prior=prior), without:
            mean, covariance = found.mixture.moments()
            np.testing.assert_allclose(np.r_[found.mean, found.velocity], mean, atol=1e-12)
            np.testing.assert_allclose(found.joint_covariance, covariance, atol=1e-12)
            assert np.linalg.eigvalsh(covariance).min() >= 0
            variances[-1].append(np.trace(covariance[:size, :size]))
    with_prior, without_prior = np.mean(variances, axis=0)
    assert with_prior < without_prior


@pytest.mark.parametrize('std_rad', [0.0, 2 * np.pi], ids=['known', 'unknown'])
def test_the_search_compares_no_phases_of_bands(std_rad):
    """The range, and with it the phases, changes by wavelengths within a cycle."""
    prior = Likelihood(system_of(band_phase_std_rad=std_rad)).nuisance
    rng, shape = np.random.default_rng(1), (len(prior.phases), 5)
    outputs = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    np.testing.assert_allclose(prior.amplitude(outputs), np.abs(outputs).sum(axis=0))
    turns = prior.phases @ prior.start(outputs, np.zeros(5)).T
    np.testing.assert_allclose(np.exp(1j * turns), outputs / np.abs(outputs))


@pytest.mark.slow
def test_users_who_walk_are_located_with_known_phases_of_bands():
    system, rng = system_of(band_phase_std_rad=0.0), np.random.default_rng(2)
    states = users_of(system.scenario, 8, 1.0, rng)
    estimate = BayesEstimator(system).estimate(system.sample(states, rng))
    assert estimate.fix.all()
    errors = estimate.mean - states[:, :3]
    assert inside(errors[:, :2], estimate.covariance[:, :2, :2], 2) >= 7 / 8


@pytest.mark.parametrize('std_hz', [0.5, 30.0])
def test_broad_offsets_of_the_carrier_and_radial_speeds_share_the_doppler_shift(std_hz):
    """Whatever the search found, speeds are distributed as those with the same total shift."""
    prior = Likelihood(system_of(carrier_offset_std_hz=std_hz)).nuisance
    rng, n = np.random.default_rng(5), 20_000
    points = np.tile(to_polar(np.array([[2.5, 0.8, 0.0]])), (n, 1))
    away, to_hz = to_positions(points[0]) / points[0, 0], 5.5e9 / 299792458.0
    drawn = np.zeros((n, len(prior)))
    drawn[:, :3] = rng.standard_normal((n, 3))
    speeds = drawn[:, :2] @ prior.velocity[:2, :2].T @ away[:2]
    total_hz = std_hz * drawn[:, 2] - to_hz * speeds
    found = np.zeros_like(drawn)
    found[:, 2] = total_hz / std_hz
    velocities = prior.velocities(found, points, rng.standard_normal(n))
    if std_hz < 1:
        np.testing.assert_array_equal(velocities, 0)
    else:
        np.testing.assert_array_equal(velocities[:, 2], 0)
        np.testing.assert_allclose(*(np.cov(one, total_hz) for one in (
            speeds, velocities @ away)), rtol=0.05)


def test_without_the_phases_of_bands_range_and_radial_speed_are_ambiguous():
    """A range step that the phases of the bands explain leaves the signals as they are."""
    system, rng = system_of(multipath_to_los_db=-40.0), np.random.default_rng(4)
    likelihood = Likelihood(system)
    state = users_of(system.scenario, 1, 1.0, rng)
    signals = likelihood.signals(system.sample(state, rng))
    point, values = to_polar(state[:, :3]), np.zeros((1, len(likelihood.nuisance)))
    values[:, :2] = state[:, 3:5]

    def log_likelihood(longer_m=0.0, faster_mps=0.0, settled=True):
        moved = point + [longer_m, 0, 0]
        sight = to_positions(moved) / moved[0, 0]
        changed = likelihood.nuisance.carried(values, point, moved)
        changed[:, :2] += faster_mps * sight[:, :2]
        located = likelihood.at(moved, changed)
        if settled:
            changed = located.settled(changed, signals)
        return located.local(changed, signals).value[0]

    values = likelihood.at(point, values).settled(values, signals)
    best = log_likelihood()
    assert log_likelihood(0.005) > best - 20
    assert log_likelihood(0.005, settled=False) < best - 1000
    assert log_likelihood(0.0, 0.05) < best - 1000


def test_ml_has_the_most_likely_velocity(walking):
    system, _ = walking
    rng = np.random.default_rng(6)
    states = users_of(system.scenario, 3, 1.0, rng)
    estimate = MlEstimator(system).estimate(system.sample(states, rng))
    assert np.abs(estimate.velocity - states[:, 3:]).max() < 1
    assert np.linalg.eigvalsh(estimate.joint_covariance).min() > -1e-12


@pytest.mark.parametrize(('file', 'codebook'), [
    ('table1', 'codebook_ambiguity'), ('bandplan', 'codebook_bandplan')])
def test_users_at_rest_cost_nothing_for_those_who_walk(file, codebook):
    scenario = Scenario.from_yaml(CONFIG / f'{file}.yaml')
    system = System(scenario, Codebook.load(CONFIG / f'{codebook}.yaml'))
    estimator = BayesEstimator(system, lazy=True)
    assert not estimator._movement
    assert estimator._likelihood.nuisance.velocity.shape == (3, 0)
    positions = scenario.sample_positions(5, np.random.default_rng(1))
    mean, slopes = system.mean_and_jacobian(positions)
    at_rest, by_state = system.mean_and_jacobian(np.hstack([positions, np.zeros((5, 3))]))
    np.testing.assert_allclose(at_rest, mean, rtol=1e-9)
    np.testing.assert_allclose(by_state[:, :3], slopes, rtol=1e-9, atol=1e-12)
