"""Poses of surfaces: frames, and the uncertainty that they add to positions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rhs_isac_ros.model import Pose
from rhs_isac_ros.model.pose import quaternion_product, rotation_matrix

# The surface is at (10, -10, 0) and looks along y of the site.
SIDE = Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0))
TILTED = Pose((1.0, -2.0, 3.0), tuple(Rotation.from_euler('xyz', [0.3, -0.5, 1.2]).as_quat()))
PLACES = np.array([[10.0, 2.0, -0.5], [7.0, -3.0, 1.0]])


def test_a_pose_is_the_frame_of_the_site_by_default():
    np.testing.assert_array_equal(Pose().to_site(PLACES), PLACES)
    np.testing.assert_array_equal(Pose().covariances_to_site(np.diag([1.0, 2.0, 3.0])),
                                  np.diag([1.0, 2.0, 3.0]))


def test_positions_turn_and_move():
    np.testing.assert_allclose(
        SIDE.to_site(PLACES), [[8.0, 0.0, -0.5], [13.0, -3.0, 1.0]], atol=1e-12)


def test_vectors_turn_only():
    np.testing.assert_allclose(SIDE.vectors_to_site(np.array([1.0, 2.0, 3.0])),
                               [-2.0, 1.0, 3.0], atol=1e-12)


@pytest.mark.parametrize('pose', [SIDE, TILTED])
def test_both_directions_are_inverse(pose):
    np.testing.assert_allclose(pose.to_surface(pose.to_site(PLACES)), PLACES, atol=1e-12)
    np.testing.assert_allclose(
        pose.vectors_to_surface(pose.vectors_to_site(PLACES)), PLACES, atol=1e-12)
    covariance = np.cov(np.random.default_rng(1).standard_normal((3, 9)))
    np.testing.assert_allclose(
        pose.covariances_to_surface(pose.covariances_to_site(covariance)), covariance)


def test_covariances_turn_with_their_vectors():
    vectors = np.random.default_rng(1).standard_normal((50, 3))
    np.testing.assert_allclose(
        TILTED.covariances_to_site(np.cov(vectors.T)), np.cov(TILTED.vectors_to_site(vectors).T))


def test_a_quaternion_is_that_of_scipy():
    np.testing.assert_allclose(
        TILTED.rotation, Rotation.from_quat(TILTED.quaternion).as_matrix(), atol=1e-12)


def test_a_product_of_quaternions_rotates_by_the_second_one_first():
    one, other = Rotation.from_euler('xyz', [[0.3, 0.1, 0.0], [0.0, 0.7, -0.4]]).as_quat()
    np.testing.assert_allclose(rotation_matrix(quaternion_product(one, other)),
                               rotation_matrix(one) @ rotation_matrix(other), atol=1e-12)


@pytest.mark.parametrize('turn', [
    (0.0, 0.0, 0.0), (0.1, -0.2, 0.3), (1.0, 2.0, -1.5), (0.0, 0.0, -3.0)])
def test_the_error_of_a_displaced_pose_is_its_displacement(turn):
    error = np.array([0.3, -0.2, 0.1, *turn])
    np.testing.assert_allclose(TILTED.error_of(TILTED.displaced(error)), error, atol=1e-12)


# The squares of most of these lengths are 0 or infinite.
@pytest.mark.parametrize('length', [0.5, 5e-324, 1e-200, 1e200, 1.7e308])
def test_the_length_of_the_quaternion_does_not_matter(length):
    scaled = Pose(SIDE.position_m, (0.0, 0.0, length, length))
    np.testing.assert_allclose(scaled.to_site(PLACES), SIDE.to_site(PLACES), atol=1e-12)
    np.testing.assert_allclose(scaled.displaced(np.zeros(6)).error_of(SIDE), 0, atol=1e-12)


@pytest.mark.parametrize('value', [0.0, np.nan, np.inf])
def test_numbers_without_a_direction_are_no_quaternion(value):
    with pytest.raises(ValueError, match='quaternion: .*expected finite numbers'):
        rotation_matrix(np.array([0.0, 0.0, value, 0.0]))


def test_a_quaternion_with_named_parts_has_no_order():
    assert Pose(quaternion={'w': 4, 'x': 1, 'y': 2, 'z': 3}) == Pose(quaternion=(1, 2, 3, 4))
    with pytest.raises(ValueError, match="quaternion: {'x': 1}, expected x, y, z and w"):
        Pose(quaternion={'x': 1})


def test_the_default_uncertainty_is_2_cm_and_a_fifth_of_a_degree():
    np.testing.assert_allclose(np.sqrt(np.diag(Pose().covariance)),
                               [0.02] * 3 + [np.radians(0.2)] * 3)


def test_a_turn_acts_across_the_line_of_sight_in_proportion_to_the_range():
    spread = Pose(uncertainty=(0.0, 1.0)).spread(np.array([[10.0, 0.0, 0.0]]))
    variance = (10 * np.radians(1.0))**2
    np.testing.assert_allclose(spread[0], np.diag([0.0, variance, variance]), atol=1e-15)


def test_the_spread_is_the_covariance_of_displaced_positions():
    """To first order in the errors: the slopes are differences."""
    root = 1e-3 * np.random.default_rng(3).standard_normal((6, 6))
    pose = Pose(TILTED.position_m, TILTED.quaternion, root @ root.T)
    slopes = np.stack([(pose.displaced(step).to_site(PLACES) - pose.displaced(-step).to_site(
        PLACES)) / 2e-4 for step in 1e-4 * np.eye(6)], axis=-1)
    np.testing.assert_allclose(pose.spread(pose.to_site(PLACES)),
                               slopes @ root @ root.T @ np.swapaxes(slopes, 1, 2), rtol=1e-6)


def test_a_turn_also_moves_positions_along_the_line_of_sight_to_second_order():
    root = np.diag([0.0, 0.0, 0.0, 0.05, 0.03, 0.08])
    pose = Pose(TILTED.position_m, TILTED.quaternion, root @ root)
    errors = np.random.default_rng(5).standard_normal((2000, 6)) @ root
    # Opposite errors leave no mean of the first order.
    offsets = np.array([pose.displaced(one).to_site(PLACES) for one in np.concatenate(
        [errors, -errors])]) - pose.to_site(PLACES)
    found, places = pose.scatter(pose.to_site(PLACES)), pose.to_site(PLACES) - pose.origin
    sights = places / np.linalg.norm(places, axis=1, keepdims=True)
    along = np.mean(np.sum(offsets * sights, axis=2)**2, axis=0)
    np.testing.assert_allclose(
        np.einsum('np,npq,nq->n', sights, found, sights), along, rtol=0.1)
    np.testing.assert_allclose(
        np.trace(found, axis1=1, axis2=2), np.mean(np.sum(offsets**2, axis=2), axis=0), rtol=0.05)


def test_a_surface_sees_users_of_a_thin_region_beside_it():
    box = np.array([[4.0, -3.0, 1.0], [6.0, 3.0, 1.0]])
    pose = Pose(SIDE.position_m, SIDE.quaternion, (0.1, 0.0))
    seen = pose.seen(box)
    # Along other axes, the errors are small in comparison.
    np.testing.assert_array_equal(seen[:, :2], box[:, :2])
    users = SIDE.to_surface(pose.displaced([0.0, 0.0, 0.25, 0.0, 0.0, 0.0]).to_site(box))
    assert (seen[0, 2] < users[:, 2]).all() and (users[:, 2] < seen[1, 2]).all()
    np.testing.assert_allclose(seen[:, 2], [0.7, 1.3])
    np.testing.assert_allclose(Pose(uncertainty=(0.0, 1.0)).seen(box)[1, 2] - 1.0, 3 * np.radians(
        np.linalg.norm(box[1, :2])), rtol=1e-6)
    np.testing.assert_array_equal(Pose(uncertainty=(0.0, 0.0)).seen(box), box)
    # No user is behind the surface.
    assert pose.seen(np.array([[0.2, -3.0, 1.0], [0.2, 3.0, 1.0]]))[0, 0] == pytest.approx(0.1)


def test_the_errors_of_a_pose_turn_velocities():
    turned = Pose(uncertainty=np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 1e-4]))
    np.testing.assert_allclose(turned.spread_of_vectors(np.array([2.0, 0.0, 0.0])),
                               np.diag([0.0, 4e-4, 0.0]), atol=1e-12)


def test_a_displaced_surface_turns_about_itself():
    error = np.array([0.1, 0.2, -0.3, 0.0, 0.0, np.pi / 2])
    moved = TILTED.displaced(error)
    np.testing.assert_allclose(moved.origin, TILTED.origin + error[:3])
    np.testing.assert_allclose(
        moved.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]] @ TILTED.rotation, atol=1e-12)
    assert moved.uncertainty == TILTED.uncertainty


def test_equal_poses_have_equal_hashes():
    again = Pose(np.array(SIDE.position_m), [0, 0, 1, 1], np.array([0.02, 0.2]))
    assert again == SIDE and hash(again) == hash(SIDE)
    assert Pose(uncertainty=(0.0, 0.0)) != Pose()


@pytest.mark.parametrize(('field', 'value', 'message'), [
    ('position_m', (1.0, 2.0), r'position_m: shape \(2,\), expected \[3\]'),
    ('position_m', (1.0, np.nan, 2.0), 'position_m: not finite'),
    ('quaternion', (0.0, 0.0, 1.0), r'quaternion: shape \(3,\), expected \[4\]'),
    ('quaternion', (0.0, 0.0, 0.0, 0.0), 'quaternion: .* a length other than 0'),
    ('uncertainty', (0.1, -1.0), 'uncertainty: -1, expected at least 0'),
    ('uncertainty', (0.1, 0.1, 0.1), r'uncertainty: shape \(3,\), expected \[2\] or \[6, 6\]'),
    ('uncertainty', np.diag([1.0, 1, 1, 1, 1, -1]), 'uncertainty: smallest eigenvalue -1'),
    ('uncertainty', np.triu(np.ones((6, 6))), 'uncertainty: .* expected a symmetric matrix'),
])
def test_invalid_poses_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        Pose(**{field: value})
