"""Mixtures of Gaussians over position and velocity, and the movement that tracks assume."""

import numpy as np
import pytest

from rhs_isac_ros.positioning.coordinates import (
    concatenate,
    jacobian,
    log_sum,
    to_polar,
    to_positions,
)
from rhs_isac_ros.positioning.motion import Mixture, Motion, reduce

PLACE = np.array([[9.0, -2.0, 0.5], [6.0, 3.0, -0.5]])


def started(motion, spread=0.01):
    points = to_polar(PLACE)
    inverse = np.linalg.inv(jacobian(points))
    covariances = spread**2 * inverse @ np.swapaxes(inverse, 1, 2)
    return motion.start(points, covariances, np.log([0.3, 0.7]))


def cartesian(mixture):
    """Return position, velocity and their covariance [C, 6, 6] in Cartesian coordinates."""
    by_point = jacobian(mixture.means[:, :3])
    both = np.zeros((len(by_point), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = by_point
    return (to_positions(mixture.means[:, :3]),
            np.matmul(by_point, mixture.means[:, 3:, None])[..., 0],
            both @ mixture.covariances @ np.swapaxes(both, 1, 2))


def continued(motion, mixture, elapsed_s):
    """Return the components of users that have not turned."""
    return motion.predict(mixture, elapsed_s).select(slice(len(mixture.means)))


def test_a_mixture_starts_at_rest_with_the_assumed_speed():
    mixture = started(Motion(speed_mps=2.0))
    positions, velocities, covariances = cartesian(mixture)
    np.testing.assert_allclose(positions, PLACE)
    np.testing.assert_array_equal(velocities, 0.0)
    np.testing.assert_allclose(np.trace(covariances[0, 3:, 3:]), 4.0)


def test_means_move_in_straight_lines_and_slow_down():
    motion = Motion(memory_s=2.0)
    mixture = started(motion)
    velocity = np.array([0.3, -0.8, 0.1])
    by_point = jacobian(mixture.means[:, :3])
    mixture.means[:, 3:] = np.linalg.solve(by_point, velocity[None, :, None])[..., 0]
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


def test_two_short_predictions_without_a_turn_equal_a_long_one():
    motion = Motion()
    once = continued(motion, started(motion), 0.4)
    twice = continued(motion, continued(motion, started(motion), 0.1), 0.3)
    np.testing.assert_allclose(twice.log_weights, once.log_weights)
    np.testing.assert_allclose(twice.means, once.means, atol=1e-9)
    np.testing.assert_allclose(twice.covariances, once.covariances, rtol=1e-6, atol=1e-12)


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
    by_point = jacobian(mixture.means[:, :3])
    before = np.array([0.3, -0.8, 0.1])
    mixture.means[:, 3:] = np.linalg.solve(by_point, before[None, :, None])[..., 0]
    _, _, (covariance, _) = cartesian(mixture)
    rng = np.random.default_rng(1)
    for index, bounds in ((2, (0.0, 0.2)), (4, (0.2, 0.4))):
        position, velocity, (found, *_) = cartesian(
            motion.predict(mixture, elapsed_s).select(slice(index, None)))
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


def test_users_stay_in_front_of_the_surface():
    motion = Motion(memory_s=100.0)
    mixture = started(motion)
    mixture.means[:, 3] = -10.0
    assert (to_positions(motion.predict(mixture, 5.0).means[:, :3])[:, 0] > 0).all()


@pytest.mark.parametrize('values', [{'speed_mps': 0.0}, {'memory_s': np.inf}, {'turn_s': -1.0}])
def test_an_invalid_motion_is_an_error(values):
    with pytest.raises(ValueError, match=f'{next(iter(values))}: .*, expected a positive number'):
        Motion(**values)


def moments(mixture):
    weights = np.exp(mixture.log_weights)
    total = weights.sum()
    mean = weights @ mixture.means / total
    offsets = mixture.means - mean
    spread = mixture.covariances + offsets[:, :, None] * offsets[:, None]
    return total, mean, np.tensordot(weights, spread, axes=1) / total


def random_mixture(n, spread, seed=0):
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((n, 6, 6))
    means = [10, 0, 0, 0, 0, 0] + spread * rng.standard_normal((n, 6))
    return Mixture(rng.standard_normal(n), means,
                   roots @ np.swapaxes(roots, 1, 2) + np.eye(6))


def test_close_components_are_merged_without_a_change_of_moments():
    mixture = random_mixture(12, 0.05)
    merged = reduce(mixture, 8)
    assert len(merged.means) == 1
    for found, expected in zip(moments(merged), moments(mixture), strict=True):
        np.testing.assert_allclose(found, expected)


def test_distant_components_remain_the_heaviest_first():
    mixture = random_mixture(12, 1e4)
    kept = reduce(mixture, 12)
    order = np.argsort(-mixture.log_weights)
    np.testing.assert_allclose(kept.log_weights, mixture.log_weights[order])
    np.testing.assert_allclose(kept.means, mixture.means[order])
    np.testing.assert_array_equal(reduce(mixture, 3).means, kept.means[:3])


def test_components_of_negligible_weight_are_discarded():
    mixture = random_mixture(3, 1e4)
    light = mixture._replace(log_weights=mixture.log_weights - 25)
    np.testing.assert_allclose(
        reduce(concatenate(mixture, light), 12).means, reduce(mixture, 12).means)


def test_weights_are_normalised():
    assert abs(log_sum(random_mixture(9, 1.0).normalised().log_weights)) < 1e-12


def test_velocities_of_components_add_to_the_covariance():
    """Two components on the x axis, where the coordinates are those of the position."""
    means = np.array([[10.0, 0, 0, 1, 0, 0], [10.0, 0, 0, -1, 0, 0.1]])
    mixture = Mixture(np.log([0.5, 0.5]), means, np.tile(0.01 * np.eye(6), (2, 1, 1)))
    mean, covariance = mixture.velocity()
    np.testing.assert_allclose(mean, [0, 0, 0.5])
    np.testing.assert_allclose(np.diag(covariance), [1.01, 1.0, 1.25])
    np.testing.assert_allclose(covariance[0, 2], -0.5)
