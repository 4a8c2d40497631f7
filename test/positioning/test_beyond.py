"""The evidence of several surfaces for a user outside of the region of a site."""

import numpy as np
import pytest

from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.model.geometry import to_polar
from rhs_isac_ros.positioning import Sighting
from rhs_isac_ros.positioning.beyond import log_evidence, places_of
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.sheets import Sheets

FRONT = Scenario()
SIDE = Scenario(pose=Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0)))
BOUNDS = FRONT.roi_bounds_m
INSIDE = Mixture(np.zeros(1), np.array([[10.0, 0.0, 0.0]]), 0.01 * np.eye(3)[None])
STD = np.array([1.0, 0.05, 0.05])
LOG_RATIO = 1.0
# In front of both surfaces.
PLACE, OTHER = np.array([18.0, -2.0, 1.0]), np.array([9.0, 9.0, 0.5])


def seen(scenario, place=None, share=1.0, inside=INSIDE, log_ratio=LOG_RATIO):
    """Return what a surface says that sees a user outside at a place with a probability."""
    places = None
    if place is not None:
        outside = Sheets(np.log([share]), to_polar(scenario.pose.to_surface(place))[None],
                         np.diag(STD**2)[None])
        places = places_of(outside, log_ratio, scenario)
    return Sighting(scenario.pose, inside, 1e-9, outside_log_ratio=log_ratio, places=places)


def evidence(*sightings):
    """Return the evidence if the surfaces have the region of the site."""
    return log_evidence(sightings, [0.0] * len(sightings), BOUNDS)


def log_in_sight(*poses, n=200_000, farthest_m=47.5):
    """Return the logarithm of the share of the prior outside of the region, in sight of all."""
    rng = np.random.default_rng(0)
    sight = rng.standard_normal((len(poses), n, 3))
    sight[..., 0] = np.abs(sight[..., 0])
    sight *= farthest_m * rng.random((len(poses), n, 1)) / np.linalg.norm(
        sight, axis=2, keepdims=True)
    places = np.stack([pose.to_site(each) for pose, each in zip(poses, sight, strict=True)])
    outside = ((places < BOUNDS[0]) | (places > BOUNDS[1])).any(axis=2)
    in_sight = np.all([(pose.to_surface(places)[..., 0] > 0) & (np.linalg.norm(
        places - pose.origin, axis=2) < farthest_m) for pose in poses], axis=0)
    return np.log(np.mean(outside & in_sight))


def test_one_surface_has_its_own_evidence():
    assert evidence(seen(FRONT)) == pytest.approx(LOG_RATIO, abs=1e-6)
    assert evidence(seen(FRONT, PLACE)) == pytest.approx(LOG_RATIO, abs=0.05)
    assert evidence(seen(FRONT, PLACE, share=0.5)) == pytest.approx(LOG_RATIO, abs=0.05)


def test_a_user_outside_is_at_one_place():
    unknown = evidence(seen(FRONT), seen(SIDE))
    assert unknown == pytest.approx(2 * LOG_RATIO, abs=1e-6)
    assert evidence(seen(FRONT, PLACE), seen(SIDE, PLACE)) > unknown + 3
    assert evidence(seen(FRONT, PLACE), seen(SIDE, OTHER)) < unknown - 10


def test_a_surface_without_places_has_no_influence_on_the_place():
    # Their evidences multiply, whatever the place.
    assert evidence(seen(FRONT, PLACE), seen(SIDE)) == pytest.approx(2 * LOG_RATIO, abs=0.05)
    # Beyond what a surface lists, the likelihood is a constant. The prior is the mean of both.
    one, other = (np.linalg.norm(each.pose.to_surface(PLACE)) for each in (FRONT, SIDE))
    assert evidence(seen(FRONT, PLACE), seen(SIDE, OTHER, share=0.5)) == pytest.approx(
        2 * LOG_RATIO + np.log(0.5) + np.log((1 + (one / other)**2) / 2)
        + log_in_sight(FRONT.pose) - log_in_sight(FRONT.pose, SIDE.pose), abs=0.05)


def test_products_have_the_integral_of_the_likelihoods():
    one, other = seen(FRONT, PLACE), seen(SIDE, PLACE)
    positions = np.random.default_rng(0).uniform(PLACE - 5, PLACE + 5, (100_000, 3))
    logs = sum(sighting.places.gaussians.log_density(positions) for sighting in (one, other))
    ranges = [to_polar(each.pose.to_surface(positions))[:, 0] for each in (FRONT, SIDE)]
    prior = np.mean([1 / (2 * np.pi * sighting.places.farthest_m * range_m**2)
                     for sighting, range_m in zip((one, other), ranges, strict=True)], axis=0)
    outside = ((positions < BOUNDS[0]) | (positions > BOUNDS[1])).any(axis=1)
    expected = np.log(np.mean(np.exp(logs) * prior * outside) * 1000.0) - log_in_sight(
        FRONT.pose, SIDE.pose)
    assert evidence(one, other) == pytest.approx(expected, abs=0.1)


def test_positions_in_the_region_of_a_surface_may_be_outside_of_that_of_the_site():
    # The site is the half of the region that is nearer to the surface in front.
    bounds = np.array([BOUNDS[0], [10.0, *BOUNDS[1, 1:]]])
    place = np.array([14.0, -1.0, 0.5])
    mixture = Mixture(np.zeros(1), place[None], 0.01 * np.eye(3)[None])
    found = log_evidence(
        [seen(FRONT, PLACE, inside=mixture), seen(SIDE, place)], [-50.0, 0.0], bounds)
    apart = log_evidence(
        [seen(FRONT, PLACE, inside=mixture), seen(SIDE, OTHER)], [-50.0, 0.0], bounds)
    assert found > apart + 5


def test_a_place_moves_with_its_surface():
    moved = Pose((10.1, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0))
    sighting = seen(SIDE, PLACE)
    places = sighting.at(moved).places
    np.testing.assert_allclose(
        places.gaussians.means, sighting.places.gaussians.means + [0.1, 0.0, 0.0], atol=1e-9)
