"""The settings for robot_localization, in a filter of another library with the same equations.

robot_localization has no wheel, so filterpy runs its model of a robot in a plane.
"""

from pathlib import Path

import numpy as np
import pytest
import yaml

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator

FILE = Path(__file__).parents[2] / 'docs' / 'examples' / 'ekf.yaml'
CONFIG = Path(__file__).parents[2] / 'config'
# Of the 15 variables of robot_localization: x, y, yaw, and the velocities along x, y and yaw.
USED = [0, 1, 5, 6, 7, 11]
STEP_S, CYCLE_S, END_S = 0.05, 0.5, 60.0
SPEED_MPS, RADIUS_M, CENTER_M = 0.8, 3.0, (10.0, 0.0)
# The antenna in the frame of the robot [m].
OFFSET_M = np.array([0.3, -0.2])


@pytest.fixture(scope='module')
def settings():
    return yaml.safe_load(FILE.read_text(encoding='utf-8'))['ekf_filter_node']['ros__parameters']


def turn(yaw):
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def drive(now_s):
    """Return the position [2] of the robot in a circle, and its heading."""
    angle = SPEED_MPS / RADIUS_M * now_s
    return (CENTER_M + RADIUS_M * np.array([np.cos(angle), np.sin(angle)]), angle + np.pi / 2)


def antenna(now_s):
    position, yaw = drive(now_s)
    return position + turn(yaw) @ OFFSET_M


@pytest.fixture(scope='module')
def poses():
    """Poses of the network, as (time, position [2], covariance [2, 2])."""
    scenario = Scenario.from_yaml(CONFIG / 'quick.yaml')
    codebook, rng = Codebook.load(CONFIG / 'codebook_quick.yaml'), np.random.default_rng(5)
    estimator = make_estimator('bayes', scenario, codebook)
    times_s = np.arange(CYCLE_S, END_S, CYCLE_S)
    places = np.array([[*antenna(now_s), 0.0] for now_s in times_s])
    received = simulate_received(scenario, codebook, places, rng)
    estimates = [estimator.estimate(one) for one in received]
    return [(now_s, one.mean[:2], one.covariance[:2, :2])
            for now_s, one in zip(times_s, estimates, strict=True) if not one.reason]


class Filter:
    """The filter that the settings describe, with `filterpy`."""

    def __init__(self, settings, threshold):
        kalman = pytest.importorskip('filterpy.kalman')
        self.ekf = kalman.ExtendedKalmanFilter(len(USED), 2)
        pick = {name: np.array(settings[name], float)[USED] for name in (
            'initial_state', 'initial_estimate_covariance', 'process_noise_covariance')}
        self.ekf.x = pick['initial_state']
        self.ekf.P = np.diag(pick['initial_estimate_covariance'])
        self.ekf.Q = np.diag(pick['process_noise_covariance']) * STEP_S
        self.threshold, self.rejected = threshold, 0

    def predict(self):
        x, y, yaw, u, v, rate = self.ekf.x
        step = turn(yaw) * STEP_S
        self.ekf.F = np.eye(len(USED))
        self.ekf.F[:2, 3:5] = step
        self.ekf.F[:2, 2] = step @ [-v, u]
        self.ekf.F[2, 5] = STEP_S
        self.ekf.x = self.ekf.x + np.concatenate([step @ [u, v], [STEP_S * rate, 0.0, 0.0, 0.0]])
        self.ekf.P = self.ekf.F @ self.ekf.P @ self.ekf.F.T + self.ekf.Q

    def update(self, config, values, covariance):
        rows = np.eye(len(USED))[np.array(config)[USED]]
        residual = values - rows @ self.ekf.x
        total = rows @ self.ekf.P @ rows.T + covariance
        if residual @ np.linalg.solve(total, residual) > self.threshold**2:
            self.rejected += 1
            return
        self.ekf.update(values, lambda x: rows, lambda x: rows @ x, R=covariance)


def run(settings, poses, threshold, rng):
    """Return the errors of the filter [m] after 20 s, the normalised ones, and the filter."""
    position, yaw = drive(0.0)
    start = np.zeros(15)
    # The settings ask for a start within some metres and half a radian.
    start[[0, 1, 5]] = *(antenna(0.0) + [1.5, -1.0]), yaw + 0.4
    found, errors, normalised = Filter({**settings, 'initial_state': start}, threshold), [], []
    waiting = list(poses)
    rate = SPEED_MPS / RADIUS_M
    # The velocity of the antenna in its own frame, with a bias of the wheels.
    velocity = 1.02 * (np.array([SPEED_MPS, 0.0]) + rate * np.array([-OFFSET_M[1], OFFSET_M[0]]))
    for step in range(1, int(END_S / STEP_S)):
        now_s = step * STEP_S
        found.predict()
        found.update(settings['odom0_config'], [*velocity, rate] + 0.02 * rng.normal(size=3),
                     4e-4 * np.eye(3))
        if waiting and waiting[0][0] <= now_s + STEP_S / 2:
            _, mean, covariance = waiting.pop(0)
            found.update(settings['pose0_config'], mean, covariance)
        if now_s > 20.0:
            error = found.ekf.x[:2] - antenna(now_s)
            errors.append(np.linalg.norm(error))
            normalised.append(error @ np.linalg.solve(found.ekf.P[:2, :2], error))
    return np.array(errors), np.array(normalised), found


def test_the_filter_follows_a_robot_more_closely_than_the_positions(settings, poses):
    raw = np.array([np.linalg.norm(mean - antenna(now_s)) for now_s, mean, _ in poses])
    errors, normalised, found = run(
        settings, poses, settings['pose0_rejection_threshold'], np.random.default_rng(6))
    assert np.sqrt(np.mean(errors**2)) < 0.5 * np.sqrt(np.mean(raw**2))
    # Most positions are used.
    assert found.rejected < 0.1 * len(poses)
    # The covariance of the filter is not much too small: the mean is 2 for a consistent one.
    assert np.mean(normalised) < 6.0


def test_a_wrong_mode_is_rejected(settings, poses):
    """A position 4 m away with a small covariance, as of one mode of several."""
    threshold, rng = settings['pose0_rejection_threshold'], np.random.default_rng(6)
    wrong = [(now_s, mean + [4.0, 0.0], 0.01 * np.eye(2)) if n % 10 == 9 and now_s > 15.0
             else (now_s, mean, covariance) for n, (now_s, mean, covariance) in enumerate(poses)]
    errors, _, found = run(settings, wrong, threshold, rng)
    unprotected, *_ = run(settings, wrong, np.inf, rng)
    assert found.rejected >= 8
    assert np.sqrt(np.mean(errors**2)) < 0.5 * np.sqrt(np.mean(unprotected**2))


def test_only_velocities_of_the_odometry_and_the_position_of_the_pose_are_used(settings):
    assert [n for n, used in enumerate(settings['pose0_config']) if used] == [0, 1]
    assert [n for n, used in enumerate(settings['odom0_config']) if used] == [6, 7, 11]
    # The filter publishes the transform from map to odom only in the frame of the map.
    assert settings['world_frame'] == settings['map_frame'] != settings['odom_frame']
