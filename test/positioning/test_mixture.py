"""Mixtures of Gaussians over position and velocity."""

import numpy as np

from rhs_isac_ros.positioning.mixture import Mixture, concatenate, log_sum, reduce


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
