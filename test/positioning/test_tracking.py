"""Tracks of moving users, and the mixtures and movement that they assume."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtri

from rhs_isac_ros.codebook import Codebook, random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import (
    BayesEstimator,
    Mixture,
    SignalError,
    Tracker,
    make_estimator,
)
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.tracking import (
    MAX_GAP_S,
    MixtureTracker,
    Motion,
    independent_share,
)
from rhs_isac_ros.system import System

PLACE = np.array([[9.0, -2.0, 0.5], [6.0, 3.0, -0.5]])


def started(motion, spread=0.01):
    covariances = np.tile(spread**2 * np.eye(3), (2, 1, 1))
    return motion.start(Mixture(np.log([0.3, 0.7]), PLACE, covariances))


def cartesian(mixture):
    """Return position, velocity and their covariance [C, 6, 6]."""
    return mixture.means[:, :3], mixture.means[:, 3:], mixture.covariances


def continued(motion, mixture, elapsed_s):
    """Return the components of users that have not turned."""
    return select(motion.predict(mixture, elapsed_s), slice(len(mixture.means)))


def test_means_move_in_straight_lines_and_slow_down():
    motion = Motion(memory_s=2.0)
    mixture = started(motion)
    velocity = np.array([0.3, -0.8, 0.1])
    mixture.means[:, 3:] = velocity
    positions, velocities, _ = cartesian(continued(motion, mixture, 0.5))
    decay = np.exp(-0.25)
    np.testing.assert_allclose(velocities, [decay * velocity] * 2, atol=1e-12)
    np.testing.assert_allclose(positions, PLACE + 2.0 * (1 - decay) * velocity, atol=1e-12)


@pytest.mark.parametrize('elapsed_s', [1e-4, 0.1, 1.5])
def test_covariances_are_those_of_the_random_process(elapsed_s):
    """The reference multiplies many short steps of the process, in Cartesian coordinates."""
    motion = Motion(speed_mps=1.0, memory_s=1.5)
    _, _, found = cartesian(motion.predict(started(motion), elapsed_s))
    step_s, expected = elapsed_s / 2000, np.diag([1e-4, 1 / 3])
    transition = np.array([[1, step_s], [0, 1 - step_s / 1.5]])
    for _ in range(2000):
        expected = transition @ expected @ transition.T
        expected[1, 1] += 2 / 1.5 / 3 * step_s
    for axis in (0, 1, 2):
        block = found[0][np.ix_([axis, axis + 3], [axis, axis + 3])]
        np.testing.assert_allclose(block, expected, rtol=0.02, atol=1e-9)


def test_weights_are_those_of_random_turns():
    motion = Motion(turn_s=2.0)
    weights = np.exp(motion.predict(started(motion), 1.0).log_weights).reshape(-1, 2)
    np.testing.assert_allclose(weights.sum(axis=0), [0.3, 0.7])
    np.testing.assert_allclose(weights[0], np.exp(-0.5) * np.array([0.3, 0.7]))
    np.testing.assert_allclose(weights[1], weights[2])


def test_components_after_a_turn_have_the_moments_of_its_random_moment():
    """The reference draws the moments and the velocities after them."""
    motion, elapsed_s, n = Motion(speed_mps=1.2, memory_s=3.0), 0.4, 40_000
    mixture = started(motion)
    before = np.array([0.3, -0.8, 0.1])
    mixture.means[:, 3:] = before
    _, _, (covariance, _) = cartesian(mixture)
    rng = np.random.default_rng(1)
    for index, bounds in ((2, (0.0, 0.2)), (4, (0.2, 0.4))):
        position, velocity, (found, *_) = cartesian(
            select(motion.predict(mixture, elapsed_s), slice(index, None)))
        start = rng.multivariate_normal([*PLACE[0], *before], covariance, n)
        turn_s = rng.uniform(*bounds, (n, 1))
        after = np.sqrt(motion.velocity_variance) * rng.standard_normal((n, 3))
        drawn = np.hstack([
            start[:, :3] + turn_s * start[:, 3:] + (elapsed_s - turn_s) * after, after])
        np.testing.assert_allclose(
            [*position[0], *velocity[0]], drawn.mean(axis=0), atol=0.02)
        np.testing.assert_allclose(found, np.cov(drawn.T), rtol=0.04, atol=5e-3)


def test_lighter_components_do_not_turn():
    motion = Motion()
    mixture = started(motion)._replace(log_weights=np.array([-20.0, 0.0]))
    assert len(motion.predict(mixture, 0.1).means) == 4


@pytest.mark.parametrize('values', [{'speed_mps': 0.0}, {'memory_s': np.inf}, {'turn_s': -1.0},
    {'speed_mps': np.nan}, {'speed_mps': 1j}])
def test_an_invalid_motion_is_an_error(values):
    with pytest.raises(ValueError, match=f'{next(iter(values))}: .*, expected a positive number'):
        Motion(**values)


PERIOD_S = 0.1
REGION_RADIUS = float(chdtri(3, 0.05))
START = np.array([9.0, -1.0, 0.1])
VELOCITY = np.array([0.6, 0.8, 0.0])


@pytest.fixture
def sample(table1_estimator, shipped):
    """Function that draws the signals at one position of Table I."""
    model = MeasurementModel(Scenario(), shipped)
    rng = np.random.default_rng(2)
    return lambda position: model.sample(np.asarray(position)[None], rng)[0]


@pytest.fixture
def tracker(table1_estimator):
    return Tracker(table1_estimator)


@pytest.fixture
def follow(tracker, sample):
    """Function that tracks a user along a line, and returns the last estimate."""
    def follow(times_s, start=START, velocity=VELOCITY):
        for time_s in times_s:
            estimate = tracker.update(time_s, sample(start + time_s * velocity))
        return estimate
    return follow


def error(estimate, position):
    return float(np.linalg.norm(estimate.mean - position))


def test_a_track_starts_with_the_estimate_of_the_estimator(tracker, table1_estimator, sample):
    signals = sample(START)
    first, alone = tracker.update(3.0, signals), table1_estimator.estimate(signals)
    np.testing.assert_array_equal(first.mean, alone.mean)
    np.testing.assert_array_equal(first.covariance, alone.covariance)
    np.testing.assert_allclose(first.velocity, 0.0)
    # The prior of the velocity has the root mean square of Motion, 1 m/s.
    np.testing.assert_allclose(first.velocity_covariance, np.eye(3) / 3, atol=1e-9)
    assert first.n_phases == 1


@pytest.mark.slow
def test_errors_and_covariances_of_walks(table1_estimator, sample):
    """Over 8 walks of 2 s, errors are half of those of single phases and have 95 % regions."""
    rng = np.random.default_rng(5)
    squares, normalised, alone = [], [], []
    for start in Scenario(roi_size_m=(4.0, 4.0, 1.0)).sample_positions(8, rng):
        tracker, angle = Tracker(table1_estimator), rng.uniform(0, 2 * np.pi)
        velocity = np.array([np.cos(angle), np.sin(angle), 0.0])
        for step in range(20):
            position = start + step * PERIOD_S * velocity
            signals = sample(position)
            estimate = tracker.update(step * PERIOD_S, signals)
            if step >= 12 and step % 3 == 0:
                offset = estimate.mean - position
                squares.append(offset @ offset)
                normalised.append(offset @ np.linalg.solve(estimate.covariance, offset))
                alone.append(error(table1_estimator.estimate(signals), position)**2)
    assert np.mean(squares) < 0.45**2
    assert np.mean(squares) < np.mean(alone) / 4
    # 24 estimates, of which about 8 are independent.
    assert np.mean(np.array(normalised) <= REGION_RADIUS) > 0.8
    # The median of the chi-square distribution with three degrees of freedom is 2.4.
    assert 1 < np.median(normalised) < 5


@pytest.mark.slow
def test_turns_whose_steps_are_the_distance_of_modes():
    """Modes of the band plan are 0.12 m apart: a user that turns back may seem not to have."""
    config = Path(__file__).parents[2] / 'config'
    scenario = dataclasses.replace(
        Scenario.from_yaml(config / 'bandplan.yaml'), roi_center_m=(9, 0, 0),
        roi_size_m=(2, 1, 0.5))
    codebook = Codebook.load(config / 'codebook_bandplan.yaml')
    estimator = make_estimator('bayes', scenario, codebook)
    model, rng, normalised = MeasurementModel(scenario, codebook), np.random.default_rng(1), []
    for _ in range(4):
        tracker, position = Tracker(estimator), np.array([8.9, -0.2, 0.1])
        velocity = np.array([0.6, 0.1, 0.0])
        for step in range(30):
            if step in (10, 20):
                velocity = -velocity
            position = position + PERIOD_S * velocity
            estimate = tracker.update(
                step * PERIOD_S, model.sample(position[None], rng)[0])
            if step >= 5:
                offset = estimate.mean - position
                normalised.append(offset @ np.linalg.solve(estimate.covariance, offset))
    # Tracks without turns have a mean above 18.
    assert np.mean(normalised) < 12
    assert np.mean(np.array(normalised) <= REGION_RADIUS) > 0.75


def test_a_walk_of_metres_between_phases(tracker, sample):
    """The predicted position is much less certain than that of each mode."""
    tracker = Tracker(tracker.estimator, Motion(speed_mps=6.0))
    velocity, errors = np.array([3.6, 4.8, 0.0]), []
    start = np.array([7.0, -4.0, 0.1])
    for k in range(5):
        position = start + 0.3 * k * velocity
        estimate = tracker.update(0.3 * k, sample(position))
        errors.append(error(estimate, position))
    assert np.mean(errors[2:]) < 1.0
    assert np.linalg.norm(estimate.velocity - velocity) < 2.0


@pytest.mark.slow
def test_a_gap_widens_the_prior_and_a_longer_one_ends_the_track(follow, tracker, sample):
    times_s = np.arange(10) * PERIOD_S
    before = follow(times_s)
    after = follow([times_s[-1] + 2.0])
    assert after.n_phases == 11
    assert np.trace(after.velocity_covariance) > np.trace(before.velocity_covariance)
    assert error(after, START + (times_s[-1] + 2.0) * VELOCITY) < 3.0
    again = follow([times_s[-1] + 2.1 + MAX_GAP_S], velocity=np.zeros(3))
    assert again.n_phases == 1


def test_a_prediction_moves_with_the_velocity_and_leaves_the_track(tracker, follow, sample):
    assert tracker.predict(0.0) is None
    times_s = np.arange(10) * PERIOD_S
    before = follow(times_s)
    mean, covariance = tracker.predict(times_s[-1] + 0.2)
    assert np.linalg.norm(mean - before.mean - 0.2 * before.velocity) < 0.05
    assert np.trace(covariance) > np.trace(before.covariance)
    assert tracker.predict(times_s[-1]) is None
    assert tracker.predict(times_s[-1] + MAX_GAP_S + 0.1) is None
    assert follow([times_s[-1] + PERIOD_S]).n_phases == 11


@pytest.mark.slow
def test_an_earlier_phase_does_not_change_the_track(tracker, sample, table1_estimator):
    signals = [sample(START + k * PERIOD_S * VELOCITY) for k in range(6)]
    expected = Tracker(table1_estimator)
    for k in (0, 1, 2, 4, 5):
        wanted = expected.update(k * PERIOD_S, signals[k])
    for k in (0, 1, 2, 4):
        tracker.update(k * PERIOD_S, signals[k])
    late = tracker.update(3 * PERIOD_S, signals[3])
    np.testing.assert_array_equal(late.mean, table1_estimator.estimate(signals[3]).mean)
    assert late.n_phases == 1
    found = tracker.update(5 * PERIOD_S, signals[5])
    np.testing.assert_array_equal(found.mean, wanted.mean)
    np.testing.assert_array_equal(found.covariance, wanted.covariance)


def test_signals_without_a_position_do_not_change_the_track(tracker, follow, sample):
    follow(np.arange(5) * PERIOD_S)
    rejected = tracker.update(5 * PERIOD_S, 1e3 * sample(START))
    assert not rejected.fix
    assert 'residual' in rejected.reason
    assert np.isnan(rejected.velocity).all()
    with pytest.raises(SignalError, match='shape'):
        tracker.update(6 * PERIOD_S, np.zeros((2, 3)))
    assert follow([7 * PERIOD_S]).n_phases == 6


@pytest.mark.slow
def test_a_track_finds_a_user_that_is_suddenly_elsewhere(tracker, sample):
    elsewhere = np.array([12.0, 3.0, -0.3])
    for k in range(10):
        tracker.update(k * PERIOD_S, sample(START))
    for k in range(10, 25):
        estimate = tracker.update(k * PERIOD_S, sample(elsewhere))
    assert error(estimate, elsewhere) < 0.7


@pytest.mark.slow
def test_estimates_are_inside_the_region(tracker, sample):
    scenario = Scenario()
    low, high = scenario.roi_bounds_m
    corner = high - [0.05, 0.05, 0.02]
    for k in range(10):
        estimate = tracker.update(k * PERIOD_S, sample(corner))
        assert (estimate.mean >= low - 1e-9).all()
        assert (estimate.mean <= high + 1e-9).all()


@pytest.mark.slow
def test_a_track_makes_a_user_outside_less_probable(random_beams):
    """Weak signals of a user inside may be those of one outside, but the track was inside.

    The position assumes a user inside, so it does not depend on the probability.
    """
    scenario = Scenario(n_subbands=2, n_frames=4, elements_per_side=5, roi_center_m=(3, 0, 0),
                        roi_size_m=(1, 1, 1), max_power_w=1e-6)
    rng = np.random.default_rng(4)
    codebook = random_beams(scenario, rng)
    alone = make_estimator('bayes', scenario, codebook, reject_outside=True)
    certain = Tracker(make_estimator('bayes', scenario, codebook))
    tracker, model = Tracker(alone), MeasurementModel(scenario, codebook)
    probabilities = []
    for k in range(40):
        signals = model.sample(np.array([[3.3, 0.3, 0.2]]), rng)[0]
        posterior = alone.posterior(signals)
        if not posterior.fix:
            continue
        found, expected = (each.update(k * PERIOD_S, signals) for each in (tracker, certain))
        np.testing.assert_allclose(found.mean, expected.mean)
        np.testing.assert_allclose(found.covariance, expected.covariance)
        assert np.isnan(found.expected_residual) == (found.outside_probability > 0.05)
        probabilities.append((posterior.outside_probability, found.outside_probability))
    single, track = np.array(probabilities).T
    assert track[0] == pytest.approx(single[0], rel=0.05)
    assert np.count_nonzero(single > 0.05) > 5
    assert (track[1:] < single[1:] / 10).all()


@pytest.mark.slow
def test_an_estimator_of_another_codebook_continues_the_track(table1, tracker, follow):
    assert follow(np.arange(10) * PERIOD_S).n_phases == 10
    tracker.estimator = make_estimator('bayes', table1.scenario, table1.codebook)
    model = MeasurementModel(table1.scenario, table1.codebook)
    signals = model.sample((START + 1.0 * VELOCITY)[None], np.random.default_rng(1))[0]
    estimate = tracker.update(1.0, signals)
    assert estimate.n_phases == 11
    assert error(estimate, START + 1.0 * VELOCITY) < 1.0


def test_declared_nuisance_parameters_use_the_gaussians_of_the_modes(random_beams):
    """The exact likelihood has more parameters than the position."""
    scenario = Scenario(
        elements_per_side=6, angular_spread_deg=2.0, roi_center_m=(4, 0, 0),
        roi_size_m=(2, 2, 1), center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), phase_std_rad=0.3)
    rng = np.random.default_rng(1)
    codebook = random_beams(scenario, rng)
    tracker = Tracker(make_estimator('bayes', scenario, codebook))
    model, place = MeasurementModel(scenario, codebook), np.array([4.2, 0.3, 0.1])
    for k in range(8):
        estimate = tracker.update(k * PERIOD_S, model.sample(place[None], rng)[0])
    assert error(estimate, place) < 0.15


def test_the_share_of_new_information_follows_equation_4():
    scenario = Scenario()
    # The first zeros of Eq. (4) lie at 8 and 7 ms.
    shares = [independent_share(scenario, elapsed_s) for elapsed_s in (1e-9, 1e-3, 4e-3, 1e-2)]
    assert shares[0] < 1e-3
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    still = Scenario(max_user_speed_mps=0.0)
    assert 0 < independent_share(still, 1.0) < 1e-5


def test_correlated_multipath_does_not_narrow_the_covariance(table1_estimator, sample):
    """The same signals again after 0.1 ms contain hardly any information."""
    signals = sample(START)
    tracker = Tracker(table1_estimator)
    first = tracker.update(0.0, signals)
    for k in range(1, 10):
        again = tracker.update(k * 1e-4, signals)
    assert np.trace(again.covariance) > 0.8 * np.trace(first.covariance)
    assert again.n_phases == 1


@pytest.mark.slow
def test_a_time_that_is_not_finite_is_an_error_and_does_not_change_the_track(
        table1, table1_estimator):
    bad_s = np.nan, np.inf, -np.inf, 1j, None
    place = np.array([[9.0, 1.0, 0.2]])
    received = MeasurementModel(table1.scenario, table1.codebook).sample(
        np.repeat(place, len(bad_s), axis=0), np.random.default_rng(3))
    tracker, other = Tracker(table1_estimator), Tracker(table1_estimator)
    for step, signals in enumerate(received):
        with pytest.raises(ValueError, match='^time_s: .*expected'):
            tracker.update(bad_s[step], signals)
        found, expected = (each.update(0.3 * step, signals) for each in (tracker, other))
        np.testing.assert_array_equal(found.mean, expected.mean)
        assert found.n_phases == expected.n_phases


MISSING = 1e-6


@pytest.fixture
def mixture_tracker():
    return MixtureTracker(Scenario(), Scenario().roi_bounds_m, Motion())


def likelihood(*places, std_m=0.1):
    """Equally probable Gaussians at some places."""
    return Mixture(np.zeros(len(places)), np.array(places),
                   np.tile(std_m**2 * np.eye(3), (len(places), 1, 1)))


def test_the_movement_decides_between_the_modes_of_mixtures(mixture_tracker):
    rng = np.random.default_rng(4)
    for k in range(12):
        place = START + k * PERIOD_S * VELOCITY
        # The wrong mode does not move like a user.
        wrong = place + [1.0 + 0.3 * k % 1, 0.5, 0.0]
        estimate = mixture_tracker.update(
            k * PERIOD_S, likelihood(wrong, rng.normal(place, 0.1)), MISSING)
    assert estimate.n_phases == 12
    assert error(estimate, place) < 0.2
    assert np.linalg.norm(estimate.velocity - VELOCITY) < 0.4
    # Less than that of a single phase with one mode.
    assert np.trace(estimate.covariance) < 0.03


@pytest.mark.slow
def test_the_covariances_of_tracks_of_mixtures_match_their_errors():
    """Of users who move as assumed."""
    rng, motion, squares = np.random.default_rng(5), Motion(turn_s=1e6), []
    for _ in range(60):
        tracker = MixtureTracker(Scenario(), Scenario().roi_bounds_m, motion)
        velocity = rng.normal(0.0, np.sqrt(motion.velocity_variance), 3)
        for k in range(6):
            place = START + k * PERIOD_S * velocity
            estimate = tracker.update(
                k * PERIOD_S, likelihood(rng.normal(place, 0.1)), MISSING)
        deviation = estimate.mean - place
        squares.append(deviation @ np.linalg.solve(estimate.covariance, deviation))
    assert 0.9 <= np.mean(np.array(squares) < REGION_RADIUS) <= 1.0
    assert 1.5 < np.mean(squares) < 4.0


def test_an_error_that_all_phases_share_is_counted_once():
    """The result is that of conditioning on all phases together, for a user without turns."""
    motion, std_m, shared_m, times_s = Motion(1.0, 1e9, 1e9), 0.1, 0.2, np.arange(8) / 4
    tracker = MixtureTracker(Scenario(), Scenario().roi_bounds_m, motion)
    seen = START + 0.1 * np.random.default_rng(8).standard_normal((len(times_s), 3))
    for time_s, place in zip(times_s, seen, strict=True):
        found = tracker.update(
            time_s, likelihood(place).shared(shared_m**2 * np.eye(3)), MISSING)
    # Along one axis: the position at the end, which may be anywhere, and the velocity.
    slopes = np.column_stack([np.ones(len(times_s)), times_s - times_s[-1]])
    errors = std_m**2 * np.eye(len(times_s)) + shared_m**2
    information = slopes.T @ np.linalg.solve(errors, slopes) + np.diag(
        [0.0, 1 / motion.velocity_variance])
    joint = np.linalg.inv(information)
    expected = joint @ slopes.T @ np.linalg.solve(errors, seen)
    np.testing.assert_allclose(found.mean, expected[0], atol=0.003)
    np.testing.assert_allclose(found.covariance, joint[0, 0] * np.eye(3), atol=0.001)
    np.testing.assert_allclose(found.velocity_covariance, joint[1, 1] * np.eye(3), atol=0.001)


def test_velocities_that_are_measured_are_those_of_the_track():
    """The result is that of conditioning on all phases together, for a user without turns.

    A phase contains the velocity, for users whose velocities have a standard deviation of 2 m/s.
    """
    motion, std = Motion(1.0, 1e9, 1e9), np.array([0.1, 0.3])
    scenario = Scenario(user_speed_std_mps=2.0)
    tracker = MixtureTracker(scenario, scenario.roi_bounds_m, motion)
    rng, times_s = np.random.default_rng(8), np.arange(6) / 4
    seen = [np.concatenate([START, VELOCITY]) + np.repeat(std, 3) * rng.standard_normal(6)
            for _ in times_s]
    own = std[1]**2 * 4 / (4 + std[1]**2)
    for time_s, state in zip(times_s, seen, strict=True):
        state[:3] += time_s * VELOCITY
        mean, covariance = state.copy(), np.diag(np.repeat([std[0]**2, own], 3))
        # The posterior of the velocity, for the likelihood around the value that was measured.
        mean[3:] *= own / std[1]**2
        found = tracker.update(time_s, Mixture(np.zeros(1), mean[None], covariance[None]), 1e-9)
    # Along one axis: the position at the end, which may be anywhere, and the velocity.
    n = len(times_s)
    slopes = np.column_stack([np.ones(2 * n), np.concatenate([times_s - times_s[-1], np.ones(n)])])
    slopes[n:, 0] = 0
    weights = np.repeat(1 / std**2, n)
    # The first phase has the density of velocities of its scenario.
    joint = np.linalg.inv(slopes.T @ (weights[:, None] * slopes) + np.diag([0, 1 / 4]))
    values = np.concatenate([[one[:3] for one in seen], [one[3:] for one in seen]])
    expected = joint @ slopes.T @ (weights[:, None] * values)
    np.testing.assert_allclose(found.mean, expected[0], atol=1e-3)
    np.testing.assert_allclose(found.velocity, expected[1], atol=1e-3)
    np.testing.assert_allclose(found.velocity_covariance, joint[1, 1] * np.eye(3), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize('height_m', [0.0, 1.0], ids=['plane', 'room'])
def test_users_who_move_during_a_cycle_are_tracked(height_m):
    """Positions are better than those of single cycles, and covariances match the errors."""
    scenario = Scenario(
        center_frequencies_hz=(5.25e9, 5.75e9), n_subbands=2, n_frames=12, frame_duration_s=0.015,
        elements_per_side=8, element_interval_wavelengths=0.4, n_feeds=1, refractive_index=1.0,
        feed_positions_m=((0.3, 0.0, 0.0),), max_user_speed_mps=1.5, multipath_to_los_db=-6,
        band_phase_std_rad=6.2832, roi_center_m=(3.5, 0, 0), roi_size_m=(3, 3, height_m),
        user_speed_std_mps=0.8, outside_probability=0.0)
    rng, velocity = np.random.default_rng(0), np.array([0.3, -0.6, 0.0])
    system = System(scenario, random_codebook(scenario, rng))
    tracker, errors, squares = Tracker(BayesEstimator(system), Motion(1.0)), [], []
    for time_s in np.add.outer(100 * np.arange(4), 0.5 * np.arange(5)).ravel():
        place = np.array([3.0, 0.7, 0.0]) + time_s % 100 * velocity
        found = tracker.update(time_s, system.sample(np.append(place, velocity)[None], rng)[0])
        alone, _ = tracker.latest.sighting.mixture.moments()
        errors.append([error(found, place), np.linalg.norm(alone[:3] - place),
                       np.linalg.norm(found.velocity - velocity)])
        deviation = (found.mean - place)[:2]
        squares.append(deviation @ np.linalg.solve(found.covariance[:2, :2], deviation))
    # The first two cycles of a walk are left out.
    tracked_m, alone_m, velocity_mps = np.sqrt(np.mean(
        np.square(np.reshape(errors, (4, 5, 3))[:, 2:]), axis=(0, 1)))
    assert tracked_m < 0.8 * alone_m
    # Half of what is known before the signals.
    assert velocity_mps < 3**0.5 * scenario.user_speed_std_mps / 2
    assert 1 < np.mean(squares) < 4
    predicted, _ = tracker.predict(time_s + 0.5)
    np.testing.assert_allclose(predicted, found.mean + 0.5 * found.velocity, atol=0.1)


def test_late_phases_do_not_change_a_track_of_mixtures(mixture_tracker):
    mixture_tracker.update(1.0, likelihood(START), MISSING)
    assert mixture_tracker.update(1.0, likelihood(PLACE[0]), MISSING) is None
    assert mixture_tracker.update(0.5, likelihood(PLACE[0]), MISSING) is None
    estimate = mixture_tracker.update(1.3, likelihood(START), MISSING)
    assert estimate.n_phases == 2
    assert error(estimate, START) < 0.05


@pytest.mark.parametrize('time_s', [MAX_GAP_S + 1.1, 0.9 - MAX_GAP_S])
def test_a_gap_or_a_reset_of_the_clock_ends_a_track_of_mixtures(mixture_tracker, time_s):
    mixture_tracker.update(1.0, likelihood(START), MISSING)
    estimate = mixture_tracker.update(time_s, likelihood(PLACE[1]), MISSING)
    assert estimate.n_phases == 1
    np.testing.assert_allclose(estimate.mean, PLACE[1])


def test_a_track_of_mixtures_survives_a_wrong_likelihood_and_finds_a_user_elsewhere(
        mixture_tracker):
    for k in range(5):
        mixture_tracker.update(k * PERIOD_S, likelihood(START), MISSING)
    # The surface may well be wrong.
    estimate = mixture_tracker.update(5 * PERIOD_S, likelihood(PLACE[1]), 0.5)
    assert error(estimate, START) < 0.2
    for k in range(6, 12):
        estimate = mixture_tracker.update(k * PERIOD_S, likelihood(PLACE[1]), MISSING)
    assert error(estimate, PLACE[1]) < 0.1


def test_correlated_multipath_does_not_narrow_a_track_of_mixtures(mixture_tracker):
    first = mixture_tracker.update(0.0, likelihood(START), MISSING)
    for k in range(1, 10):
        again = mixture_tracker.update(k * 1e-4, likelihood(START), MISSING)
    assert np.trace(again.covariance) > 0.8 * np.trace(first.covariance)
    assert again.n_phases == 1
