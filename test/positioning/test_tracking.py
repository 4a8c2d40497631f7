"""Tracks of users over successive positioning phases."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtri

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import Motion, SignalError, Tracker, make_estimator
from rhs_isac_ros.positioning.tracking import MAX_GAP_S, independent_share

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


def test_position_and_velocity_of_a_walk_converge(follow):
    times_s = np.arange(30) * PERIOD_S
    estimate = follow(times_s)
    assert error(estimate, START + times_s[-1] * VELOCITY) < 0.4
    assert np.linalg.norm(estimate.velocity - VELOCITY) < 0.6
    assert estimate.n_phases == 30
    assert np.trace(estimate.covariance) < 0.2
    for covariance in (estimate.covariance, estimate.velocity_covariance):
        assert np.linalg.eigvalsh(covariance).min() > 0


@pytest.mark.slow
def test_errors_and_covariances_of_walks(table1_estimator, sample):
    """Over 12 walks of 3 s, errors are half of those of single phases and have 95 % regions."""
    rng = np.random.default_rng(5)
    squares, normalised, alone = [], [], []
    for start in Scenario(roi_size_m=(4.0, 4.0, 1.0)).sample_positions(12, rng):
        tracker, angle = Tracker(table1_estimator), rng.uniform(0, 2 * np.pi)
        velocity = np.array([np.cos(angle), np.sin(angle), 0.0])
        for step in range(30):
            position = start + step * PERIOD_S * velocity
            signals = sample(position)
            estimate = tracker.update(step * PERIOD_S, signals)
            if step >= 20 and step % 3 == 0:
                offset = estimate.mean - position
                squares.append(offset @ offset)
                normalised.append(offset @ np.linalg.solve(estimate.covariance, offset))
                alone.append(error(table1_estimator.estimate(signals), position)**2)
    assert np.mean(squares) < 0.45**2
    assert np.mean(squares) < np.mean(alone) / 4
    # 48 estimates, of which about 12 are independent.
    assert np.mean(np.array(normalised) <= REGION_RADIUS) > 0.8
    # The median of the chi-square distribution with three degrees of freedom is 2.4.
    assert 1 < np.median(normalised) < 5


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


def test_a_gap_widens_the_prior_and_a_longer_one_ends_the_track(follow, tracker, sample):
    times_s = np.arange(20) * PERIOD_S
    before = follow(times_s)
    after = follow([times_s[-1] + 2.0])
    assert after.n_phases == 21
    assert np.trace(after.velocity_covariance) > np.trace(before.velocity_covariance)
    assert error(after, START + (times_s[-1] + 2.0) * VELOCITY) < 3.0
    again = follow([times_s[-1] + 2.1 + MAX_GAP_S], velocity=np.zeros(3))
    assert again.n_phases == 1


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


def test_a_track_finds_a_user_that_is_suddenly_elsewhere(tracker, sample):
    elsewhere = np.array([12.0, 3.0, -0.3])
    for k in range(15):
        tracker.update(k * PERIOD_S, sample(START))
    for k in range(15, 35):
        estimate = tracker.update(k * PERIOD_S, sample(elsewhere))
    assert error(estimate, elsewhere) < 0.7


def test_a_user_stops_and_goes(tracker, sample):
    position = START.copy()
    for k in range(60):
        if not 20 <= k < 40:
            position = position + PERIOD_S * VELOCITY
        estimate = tracker.update(k * PERIOD_S, sample(position))
        if k == 39:
            assert np.linalg.norm(estimate.velocity) < 0.5
    assert error(estimate, position) < 0.4
    assert estimate.velocity @ VELOCITY > 0.3


def test_estimates_are_inside_the_region(tracker, sample):
    scenario = Scenario()
    low, high = scenario.roi_bounds_m
    corner = high - [0.05, 0.05, 0.02]
    for k in range(20):
        estimate = tracker.update(k * PERIOD_S, sample(corner))
        assert (estimate.mean >= low - 1e-9).all()
        assert (estimate.mean <= high + 1e-9).all()


def test_the_probability_of_a_user_outside_is_that_of_single_phases(random_beams):
    """Weak signals of a user inside may be those of one outside."""
    scenario = Scenario(n_subbands=2, n_frames=4, elements_per_side=5, roi_center_m=(3, 0, 0),
                        roi_size_m=(1, 1, 1), max_power_w=1e-6)
    rng = np.random.default_rng(4)
    codebook = random_beams(scenario, rng)
    alone = make_estimator('bayes', scenario, codebook, reject_outside=True)
    certain = Tracker(make_estimator('bayes', scenario, codebook))
    tracker, model = Tracker(alone), MeasurementModel(scenario, codebook)
    doubts = []
    for k in range(40):
        signals = model.sample(np.array([[3.3, 0.3, 0.2]]), rng)[0]
        posterior = alone.posterior(signals)
        if posterior.modes is None:
            continue
        found, expected = (each.update(k * PERIOD_S, signals) for each in (tracker, certain))
        np.testing.assert_allclose(found.mean, expected.mean)
        np.testing.assert_allclose(found.covariance, expected.covariance)
        assert found.outside_probability == posterior.estimate.outside_probability
        doubts.append(found.outside_probability > 0.05)
        assert np.isnan(found.expected_residual) == doubts[-1]
    assert 5 < sum(doubts) < len(doubts) - 5


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
