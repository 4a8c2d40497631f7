"""Estimation of the pose of a surface from common users."""

import numpy as np
import pytest

from rhs_isac_ros.model import Pose
from rhs_isac_ros.positioning import Mixture, Sighting
from rhs_isac_ros.positioning.alignment import MIN_USERS, PoseError, estimate_pose

BOUNDS = np.array([[5.0, -5.0, -1.0], [15.0, 5.0, 1.0]])
FRONT, SIDE = Pose(), Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0))
# Standard deviations in the frame of the surface: a range is known best.
STD_M = np.array([0.01, 0.1, 0.1])
START = np.array([0.3, -0.4, 0.2, 0.05, -0.08, 0.07])


def sighting(place, pose, rng, n_candidates=1, assumed=None):
    """Return a sighting in which one of several candidates in a row is right.

    The mixture is converted to the frame of the site with the pose `assumed`.
    """
    assumed = assumed or pose
    local = pose.to_surface(place) + STD_M * rng.standard_normal(3)
    steps = np.arange(n_candidates) - rng.integers(n_candidates)
    candidates = local + steps[:, None] * [0.55, 0.0, 0.0]
    covariances = np.tile(np.diag(STD_M**2), (n_candidates, 1, 1))
    return Sighting(assumed, Mixture(
        np.zeros(n_candidates), assumed.to_site(candidates),
        assumed.covariances_to_site(covariances)))


def sightings(rng, n=40, n_candidates=1, n_outliers=0, start=START, bounds_m=BOUNDS):
    """Return the sightings of both surfaces; outliers are different users at each surface."""
    places, others = rng.uniform(*bounds_m, size=(2, n, 3))
    seen = np.where((np.arange(n) < n_outliers)[:, None], others, places)
    return ([sighting(place, FRONT, rng, n_candidates) for place in places],
            [sighting(place, SIDE, rng, n_candidates, SIDE.displaced(start)) for place in seen])


def normalised_error(found):
    error = found.error_of(SIDE)
    return error @ np.linalg.solve(found.covariance, error)


@pytest.mark.slow
@pytest.mark.parametrize(('n', 'seeds'), [(40, range(4)), (MIN_USERS, range(2))])
def test_a_pose_is_found_with_a_covariance_that_fits_its_error(n, seeds):
    squares = [normalised_error(estimate_pose(
        *sightings(np.random.default_rng(seed), n), BOUNDS)) for seed in seeds]
    # The mean of 4 chi-square variables with 6 degrees of freedom has a deviation of 1.7.
    assert 2.0 < np.mean(squares) < 11.0


@pytest.mark.slow
def test_wrong_candidates_and_outliers_do_not_matter():
    found = estimate_pose(*sightings(
        np.random.default_rng(1), n_candidates=4, n_outliers=6), BOUNDS)
    assert np.linalg.norm(found.error_of(SIDE)[:3]) < 0.15
    assert normalised_error(found) < 25


@pytest.mark.slow
def test_users_in_a_plane_determine_a_pose():
    plane = BOUNDS * [1, 1, 0]
    found = estimate_pose(*sightings(
        np.random.default_rng(1), n_candidates=4, n_outliers=6, bounds_m=plane), plane)
    assert np.linalg.norm(found.error_of(SIDE)[:3]) < 0.15
    assert normalised_error(found) < 25


def test_the_result_is_in_the_frame_of_the_reference():
    reference, other = sightings(np.random.default_rng(2))
    moved = Pose((1.0, 2.0, 3.0), (0.0, 0.0, 0.3, 1.0))
    shifted = [Sighting(moved, Mixture(
        one.mixture.log_weights, moved.to_site(one.mixture.means),
        moved.covariances_to_site(one.mixture.covariances))) for one in reference]
    found = estimate_pose(reference, other, BOUNDS)
    again = estimate_pose(shifted, [Sighting(
        SIDE.displaced(START), one.mixture) for one in other], BOUNDS)
    np.testing.assert_allclose(again.to_site(np.eye(3)), moved.to_site(found.to_site(np.eye(3))),
                               atol=0.02)


def test_the_number_of_sightings_is_checked():
    reference, other = sightings(np.random.default_rng(3), n=MIN_USERS)
    with pytest.raises(PoseError, match='sightings: 10 and 9, expected equal numbers, at least'):
        estimate_pose(reference, other[1:], BOUNDS)
    with pytest.raises(PoseError, match='sightings: 9 and 9'):
        estimate_pose(reference[1:], other[1:], BOUNDS)


@pytest.mark.slow
def test_users_at_rest_count_once():
    once = sightings(np.random.default_rng(6), n=20)
    found, again = (estimate_pose(*(n * one for one in once), BOUNDS) for n in (1, 4))
    np.testing.assert_allclose(found.error_of(again), np.zeros(6), atol=1e-5)
    np.testing.assert_allclose(again.covariance, found.covariance, rtol=1e-3, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize('half_m', [0.0, 0.03, 4.0])
def test_users_at_one_place_or_on_a_line_do_not_determine_a_pose(half_m):
    rng = np.random.default_rng(4)
    places = [10.0, 0.0, 0.0] + np.linspace(-half_m, half_m, 40)[:, None] * [1.0, 0.5, 0.0]
    with pytest.raises(PoseError, match='expected users at more different places'):
        estimate_pose([sighting(place, FRONT, rng) for place in places],
                      [sighting(place, SIDE, rng) for place in places], BOUNDS)
