"""Mixtures of Gaussians in the frame of the site."""

import pickle

import numpy as np
import pytest
from scipy.stats import Covariance, multivariate_normal

from rhs_isac_ros.model import Pose
from rhs_isac_ros.positioning.mixture import Mixture, with_velocities
from rhs_isac_ros.positioning.segments import select


def mixture(seed, n=3, size=3, spread=1.0):
    rng = np.random.default_rng(seed)
    roots = spread * rng.standard_normal((n, size, size)) + np.eye(size)
    return Mixture(
        rng.normal(size=n), rng.standard_normal((n, size)), roots @ roots.swapaxes(1, 2))


def one(mean, covariance, log_weight=0.0):
    return Mixture(np.array([log_weight]), np.array([mean], float), np.array([covariance], float))


def test_mixtures_are_equal_if_they_are_the_same():
    first, second = mixture(1), mixture(1)
    assert first == first != second
    assert [second, first].index(first) == 1
    assert len({first, second}) == 2


@pytest.mark.parametrize('n', [0, 2])
def test_a_pickled_mixture_is_the_same(n):
    """Surfaces that list no place outside have a mixture without components."""
    before = select(mixture(1), np.arange(n)).shared(np.eye(3))
    after = pickle.loads(pickle.dumps(before))
    assert type(after) is Mixture
    np.testing.assert_array_equal(after.constant_covariance, np.eye(3))
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_moments_are_those_of_the_density():
    both = Mixture(np.log([0.2, 0.6]), np.array([[0.0, 0, 0], [4.0, 0, 0]]),
                   np.array([np.eye(3), 2 * np.eye(3)]))
    mean, covariance = both.moments()
    np.testing.assert_allclose(mean, [3.0, 0.0, 0.0])
    np.testing.assert_allclose(covariance, np.diag([1.75 + 3.0, 1.75, 1.75]))


@pytest.mark.parametrize('size', [3, 6])
@pytest.mark.parametrize('thickness', [1.0, 1e-5])
def test_the_density_is_a_sum_of_gaussians(size, thickness):
    """As in a region that is a plane.

    Without a Cholesky factor, SciPy 1.17.1 takes eigenvalues below 2e-10 of the largest for 0.
    """
    scale = np.array([1.0, 1.0, thickness] * (size // 3))
    wide, points = mixture(2, size=size), np.random.default_rng(3).normal(size=(4, 5, size))
    both = Mixture(wide.log_weights, scale * wide.means,
                   scale[:, None] * wide.covariances * scale)
    expected = sum(np.exp(weight) * multivariate_normal(mean, Covariance.from_cholesky(
        np.linalg.cholesky(covariance))).pdf(scale * points)
        for weight, mean, covariance in zip(*both, strict=True))
    np.testing.assert_allclose(both.log_density(scale * points), np.log(expected))


def test_samples_have_the_moments_of_the_mixture():
    both = mixture(4)
    samples = both.sample(200_000, np.random.default_rng(5))
    mean, covariance = both.moments()
    scale = np.trace(covariance)
    np.testing.assert_allclose(samples.mean(axis=0), mean, atol=0.01 * np.sqrt(scale))
    np.testing.assert_allclose(np.cov(samples.T), covariance, atol=0.02 * scale)


@pytest.mark.parametrize('size', [3, 6], ids=['positions', 'positions and velocities'])
def test_a_product_is_the_product_of_the_densities(size):
    """A likelihood of positions also updates velocities."""
    first, second = mixture(6, size=size), mixture(7, n=2)
    points = np.random.default_rng(8).normal(size=(20, size))
    np.testing.assert_allclose(first.product(second).log_density(points),
                               first.log_density(points) + second.log_density(points[:, :3]))


VARIANCE = np.diag([30.0, 40.0, 50.0])


def moving(seed, n=3):
    """Components whose velocities are known better than a prior with `VARIANCE`."""
    return mixture(seed, n=n, size=6, spread=0.4)


def test_without_the_prior_a_mixture_is_a_likelihood():
    both, points = moving(9), np.random.default_rng(10).normal(size=(20, 6))
    prior = multivariate_normal(np.zeros(3), VARIANCE).logpdf(points[:, 3:])
    np.testing.assert_allclose(both.without_prior(VARIANCE).log_density(points) + prior,
                               both.log_density(points))


def test_velocities_that_exceed_the_prior_are_no_information():
    wide = one(np.zeros(6), np.diag([1.0, 1, 1, 90, 90, 90])).without_prior(VARIANCE)
    assert np.linalg.eigvalsh(wide.covariances[0])[3:].min() > 1e4


def test_velocities_at_a_position_are_conditional():
    both, place = moving(11), np.array([[0.3, -0.2, 0.5]])
    mean, covariance, _ = both.velocities(place)
    grid = np.stack(np.meshgrid(*[np.linspace(-8, 8, 41)] * 3), axis=-1).reshape(-1, 3)
    weights = np.exp(both.log_density(np.hstack([np.broadcast_to(place, grid.shape), grid])))
    np.testing.assert_allclose(mean[0], weights @ grid / weights.sum(), atol=1e-3)
    np.testing.assert_allclose(covariance[0], np.cov(
        grid.T, ddof=0, aweights=weights), atol=1e-3)


def test_velocities_of_several_surfaces_are_multiplied_with_one_prior():
    first, second = moving(13, n=1), moving(14, n=1)
    exact = first.product(second.without_prior(VARIANCE))
    places = first.position().product(second.position())
    found = with_velocities(places, [first, second], VARIANCE)
    for one_of, other in zip(found.velocities(places.means), exact.velocities(places.means),
                             strict=True):
        np.testing.assert_allclose(one_of, other, rtol=1e-9)
    np.testing.assert_allclose(found.means[:, :3], places.means)
    np.testing.assert_allclose(found.covariances[:, :3, :3], places.covariances)


def test_a_surface_that_disagrees_about_the_velocity_weakens_a_place():
    """Of two places, the first surface sees a velocity of the other direction at one."""
    first = Mixture(np.zeros(2), np.array([[0.0, 0, 0, 2, 0, 0], [9.0, 0, 0, -2, 0, 0]]),
                    np.array([np.eye(6) / 4] * 2))
    second = first._replace(means=np.abs(first.means))
    found = with_velocities(first.position(), [first, second], VARIANCE)
    assert found.log_weights[0] > found.log_weights[1] + 10
    np.testing.assert_allclose(found.means[0, 3:], [2, 0, 0], atol=0.02)


def test_a_moved_mixture_turns_velocities():
    pose, both = Pose((1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8)), moving(15)
    moved = both.moved(Pose(), pose)
    np.testing.assert_allclose(moved.means[:, :3], pose.to_site(both.means[:, :3]))
    np.testing.assert_allclose(moved.means[:, 3:], pose.vectors_to_site(both.means[:, 3:]))
    np.testing.assert_allclose(
        moved.covariances[:, 3:, :3], pose.covariances_to_site(both.covariances[:, 3:, :3]))
    for old, new in zip(both.position().moved(Pose(), pose), moved.position(), strict=True):
        np.testing.assert_allclose(old, new)


def test_the_position_is_a_marginal():
    both = mixture(14, size=6)
    mean, covariance = both.moments()
    np.testing.assert_allclose(both.position().moments()[0], mean[:3])
    np.testing.assert_allclose(both.position().moments()[1], covariance[:3, :3])


def test_a_component_for_the_whole_region_is_nearly_uniform_in_it():
    narrow, size_m = one(np.zeros(3), 0.01 * np.eye(3), 7.0), np.array([4.0, 6.0, 2.0])
    both = narrow.or_within(np.ones(3), np.diag(size_m**2), 0.02)
    assert both.log_weights[0] == pytest.approx(np.log(0.98))
    inside = 1 + size_m * (np.random.default_rng(13).random((4000, 3)) - 0.5)
    wide = select(both, slice(1, None))
    assert np.exp(wide.log_density(inside)).mean() * size_m.prod() == pytest.approx(
        0.02, rel=0.15)


def test_a_user_elsewhere_moves_as_fast_in_any_direction():
    both = mixture(3, size=6).or_within(np.zeros(3), np.eye(3), 0.1)
    mean, covariance = mixture(3, size=6).moments()
    np.testing.assert_array_equal(both.means[-1, 3:], 0.0)
    square = np.trace(covariance[3:, 3:]) + mean[3:] @ mean[3:]
    np.testing.assert_allclose(both.covariances[-1, 3:, 3:], square / 3 * np.eye(3))


def test_merging_preserves_mass_mean_and_covariance():
    both = mixture(15, n=8)
    merged = both.reduce(1, distance=np.inf)
    assert len(merged.means) == 1
    np.testing.assert_allclose(merged.log_mass, both.log_mass)
    np.testing.assert_allclose(merged.means[0], both.moments()[0])
    np.testing.assert_allclose(merged.covariances[0], both.moments()[1])


def test_components_merge_by_their_distance_relative_to_their_covariance():
    # The second component is 0.5 m from the first one along a wide axis, the third one 0.1 m
    # along a narrow one.
    thin = np.diag([1e-4, 1.0, 1.0])
    far = Mixture(np.log([0.5, 0.3, 0.2]), np.array([[0.0, 0, 0], [0.0, 0.5, 0], [0.1, 0, 0]]),
                  np.array([thin] * 3))
    reduced = far.reduce(8)
    np.testing.assert_allclose(np.exp(reduced.log_weights), [0.8, 0.2])
    np.testing.assert_allclose(reduced.means[1], [0.1, 0.0, 0.0])


def test_the_lightest_components_are_discarded():
    separate = Mixture(np.log([0.1, 0.6, 0.3, 1e-9]), 100.0 * np.eye(4, 3),
                       np.array([np.eye(3)] * 4))
    np.testing.assert_allclose(np.exp(separate.reduce(2).log_weights), [0.6, 0.3])
    assert len(separate.reduce(8).means) == 3


def test_the_product_of_two_square_roots_is_the_mixture():
    covariance = np.diag([0.04, 1.0, 0.25])
    mixture = Mixture(np.array([-0.7]), np.array([[9.0, 1.0, 0.0]]), covariance[None])
    root = mixture.powered(0.5)
    points = np.array([[9.1, 0.5, 0.2], [8.7, 1.5, -0.3]])
    np.testing.assert_allclose(root.log_density(points), mixture.log_density(points) / 2)
    np.testing.assert_allclose(
        root.product(root).log_density(points), mixture.log_density(points))


def test_a_mixture_without_mass_is_refused():
    with pytest.raises(ValueError, match='log_weights: maximum -inf, expected'):
        Mixture([-np.inf], [[8.0, 0.0, 0.0]], [np.eye(3)])
