"""Positions from the signals of several surfaces."""

import dataclasses
import pickle

import numpy as np
import pytest

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Pose, Scenario
from rhs_isac_ros.model.gaussian import moments
from rhs_isac_ros.model.geometry import polar_derivative, to_polar, to_positions
from rhs_isac_ros.positioning import Sighting, make_estimator
from rhs_isac_ros.positioning.fusion import Fuser, fuse
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.sheets import Sheets

BOUNDS = np.array([[5.0, -5.0, -1.0], [15.0, 5.0, 1.0]])
EXACT = (0.0, 0.0)
FRONT = Pose(uncertainty=EXACT)
SIDE = Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0), EXACT)
OPPOSITE = Pose((20.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), EXACT)
HIGH = Pose((20.0, 0.0, 2.0), (0.0, 0.0, 1.0, 0.0), EXACT)
PLACE = np.array([8.0, 1.0, 0.2])
# Standard deviations of range [m] and direction cosines of a mode.
STD = np.array([0.01, 0.05, 0.02])


def sheets(pose, places, log_weights=(0.0,), std=STD, missing=1e-12):
    """Return modes at positions of the site that are Gaussian around the surface."""
    means = np.array(places, float).reshape(-1, 3)
    by_site = polar_derivative(to_polar(pose.to_surface(means))) @ pose.rotation.T
    precision = np.swapaxes(by_site, 1, 2) @ np.diag(1 / std**2) @ by_site
    return Sighting(pose, Mixture(np.array(log_weights, float), means, np.linalg.inv(precision)),
                    missing)


def log_likelihood(sighting, positions, std=STD):
    """Evaluate modes with weight 1 at positions [N, 3], by their definition around the surface."""
    points = to_polar(sighting.pose.to_surface(positions))
    centres = to_polar(sighting.pose.to_surface(sighting.mixture.means))
    squares = np.sum(((points[:, None] - centres) / std)**2, axis=2)
    volumes = np.linalg.slogdet(sighting.mixture.covariances)[1] / 2
    return np.logaddexp.reduce(sighting.mixture.log_weights - volumes - squares / 2, axis=1)


def integrated(sightings, bounds=BOUNDS, n=400_000, std=STD):
    """Return mean and covariance of the product by importance sampling in the region."""
    rng = np.random.default_rng(0)
    # Positions in the region of each mode of the first surface.
    first = sightings[0]
    means = to_polar(first.pose.to_surface(first.mixture.means))
    chosen = rng.integers(len(means), size=n)
    points = means[chosen] + std * rng.standard_normal((n, 3))
    points = points[np.hypot(points[:, 1], points[:, 2]) < 1]
    r, u, v = points.T
    local = r[:, None] * np.stack([np.sqrt(1 - u**2 - v**2), u, v], axis=1)
    positions = first.pose.to_site(local)
    squares = np.sum(((points[:, None] - means) / std)**2, axis=2)
    log_proposal = np.logaddexp.reduce(-squares / 2, axis=1)
    # The density of a position is that of (r, u, v) divided by the volume element.
    log_weights = sum(log_likelihood(one, positions, std) for one in sightings) - log_proposal
    log_weights += 2 * np.log(r) - np.log(np.sqrt(1 - u**2 - v**2))
    log_weights[~((positions >= bounds[0]) & (positions <= bounds[1])).all(axis=1)] = -np.inf
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    mean = weights @ positions
    return mean, (positions - mean).T @ ((positions - mean) * weights[:, None])


def with_velocity(sighting, velocity, std_mps=1.0, radial_mps=0.02):
    """Add a velocity that is known along the line of sight, and otherwise has the prior."""
    mean, covariance = sighting.mixture.moments()
    sight = mean - sighting.pose.origin
    sight /= np.linalg.norm(sight)
    information = np.eye(3) / std_mps**2 + np.outer(sight, sight) / radial_mps**2
    joint = np.zeros((1, 6, 6))
    joint[0, :3, :3], joint[0, 3:, 3:] = covariance, np.linalg.inv(information)
    along = joint[0, 3:, 3:] @ sight * (sight @ velocity) / radial_mps**2
    return dataclasses.replace(sighting, mixture=Mixture(
        np.zeros(1), np.concatenate([mean, along])[None], joint))


def test_two_surfaces_see_the_velocity_along_two_lines_of_sight():
    velocity = np.array([0.7, -0.4, 0.0])
    seen = [sheets(FRONT, PLACE), sheets(SIDE, PLACE)]
    plain = fuse(seen, BOUNDS)
    assert np.isnan(plain.velocity).all()
    both = fuse([with_velocity(one, velocity) for one in seen], BOUNDS, 0.0, 1.0)
    np.testing.assert_allclose(both.mean, plain.mean, atol=1e-6)
    np.testing.assert_allclose(both.covariance, plain.covariance, atol=1e-6)
    np.testing.assert_allclose(both.velocity, velocity, atol=0.03)
    std = np.sqrt(np.diag(both.velocity_covariance))
    assert (std[:2] < 0.05).all() and std[2] == pytest.approx(1, abs=0.02)
    assert both.mixture.means.shape[1] == 6
    # A surface whose scenario declares no velocity only locates the user.
    one = fuse([with_velocity(seen[0], velocity), seen[1]], BOUNDS, 0.0, 1.0)
    np.testing.assert_allclose(one.covariance, plain.covariance, atol=1e-6)
    assert np.sqrt(np.linalg.eigvalsh(one.velocity_covariance)) == pytest.approx(
        [0.02, 1, 1], rel=0.02)


def assert_moments(fused, mean, covariance, tolerance=0.05):
    assert fused.mixture.log_mass == pytest.approx(0, abs=1e-12)
    found, spread = fused.mixture.moments()
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found / std, mean / std, atol=tolerance)
    np.testing.assert_allclose(spread / np.outer(std, std), covariance / np.outer(std, std),
                               atol=2 * tolerance)


@pytest.mark.parametrize('others', [[], [SIDE], [OPPOSITE], [SIDE, OPPOSITE]],
                         ids=['alone', 'side', 'opposite', 'three'])
def test_the_posterior_is_the_integral_of_the_product(others):
    # The modes of each surface are not exactly at the same place.
    places = [PLACE + [0.005, 0.1, 0.02], PLACE + [0.1, -0.004, 0.0], PLACE + [0.0, 0.06, 0.05]]
    sightings = [sheets(pose, place)
                 for pose, place in zip([FRONT, *others], places, strict=False)]
    assert_moments(fuse(sightings, BOUNDS), *integrated(sightings))


@pytest.mark.slow
def test_only_modes_that_agree_remain():
    # The wrong modes of one surface are at other places than those of the other one.
    front = sheets(FRONT, [PLACE, PLACE + [0.6, 0.0, 0.0]], [0.0, 1.0])
    side = sheets(SIDE, [PLACE, PLACE + [0.0, 0.6, 0.0]], [0.0, 1.0])
    sightings = [front, side]
    assert_moments(fuse(sightings, BOUNDS), *integrated(sightings))


@pytest.mark.slow
def test_many_modes_at_regular_distances_have_the_moments_of_all_their_products():
    """Of 1728 similar products, none may be left out or have too few samples."""
    std, steps_m = np.array([0.02, 0.3, 0.3]), np.arange(-6, 6)[:, None]
    sightings = []
    for pose, step_m in ((FRONT, 0.1), (SIDE, 0.12), (HIGH, 0.09)):
        sight = PLACE - pose.origin
        sightings.append(sheets(pose, PLACE + step_m * steps_m * sight / np.linalg.norm(sight),
                                np.zeros(12), std))
    assert_moments(fuse(sightings, BOUNDS), *integrated(sightings, n=100_000, std=std), 0.1)


def test_the_order_of_the_surfaces_does_not_matter():
    sightings = [sheets(pose, [PLACE, PLACE + offset], [0.0, 0.3]) for pose, offset in (
        (FRONT, [0.6, 0.1, 0.0]), (SIDE, [0.0, 0.5, 0.1]), (OPPOSITE, [0.3, 0.1, 0.1]))]
    one, other = fuse(sightings, BOUNDS), fuse(sightings[::-1], BOUNDS)
    assert_moments(one, *other.mixture.moments(), tolerance=0.02)
    np.testing.assert_allclose(one.log_agreement, other.log_agreement, atol=0.02)


TURNED = Pose((5.0, -75**0.5, 0.0), (0.0, 0.0, 0.5, 0.75**0.5), EXACT)


@pytest.mark.parametrize(('others', 'std', 'places', 'wide'), [
    ([OPPOSITE], [0.02, 0.1, 0.2], [[8.0, 1.0, 0.2]] * 2, 'z'),
    ([OPPOSITE], [0.005, 0.1, 0.1], [[13.36, -1.73, 0.41], [13.33, 0.53, 0.83]], 'y'),
    # The spheres meet in two arcs, several metres apart.
    ([OPPOSITE], [0.02, 0.4, 0.02], [[6.397, -2.57, 0.08], [6.816, 2.59, 0.24]], 'y'),
    ([HIGH], [0.02, 0.4, 0.02], [[11.96, -0.797, 0.687], [11.22, 2.498, 0.599]], 'y'),
    ([TURNED], [0.005, 0.1, 0.1], [[9.8, -3.0, -0.5]] * 2, 'z'),
    ([OPPOSITE, SIDE], [0.02, 0.1, 0.2], [[8.0, 1.0, 0.2]] * 3, 'z'),
], ids=['rim', 'apart', 'two arcs', 'other height', '60 degrees', 'three'])
@pytest.mark.slow
def test_sheets_that_are_broad_across_have_the_moments_of_their_product(
        others, std, places, wide):
    std = np.array(std)
    sightings = [sheets(pose, place, std=std)
                 for pose, place in zip([FRONT, *others], places, strict=True)]
    mean, covariance = integrated(sightings, std=std, n=500_000)
    fused = fuse(sightings, BOUNDS)
    offset = fused.mean - mean
    assert offset @ np.linalg.solve(covariance, offset) < 0.03
    axis = 'xyz'.index(wide)
    assert covariance[axis, axis] > 0.02
    np.testing.assert_allclose(np.diag(fused.covariance) / np.diag(covariance), 1.0, atol=0.2)


ABOVE = Pose((10.0, 3.0, 9.0), (0.0, 0.5**0.5, 0.0, 0.5**0.5), EXACT)


def multilaterated(sightings, std, n=40_000):
    """Return mean and covariance of a product of thin sheets, by samples of the three ranges.

    Newton's method finds the place with each triple of ranges.
    """
    rng, origins = np.random.default_rng(0), np.stack([one.pose.origin for one in sightings])
    peaks = np.stack([np.linalg.norm(one.mixture.means - one.pose.origin, axis=1)
                      for one in sightings])
    ranges = std[0] * rng.standard_normal((n, 3)) + np.stack(
        [rng.choice(row, n) for row in peaks], axis=1)
    log_proposal = np.logaddexp.reduce(
        -((ranges[:, :, None] - peaks) / std[0])**2 / 2, axis=2).sum(axis=1)
    places = np.tile(PLACE, (n, 1))
    for _ in range(6):
        sight = places[:, None] - origins
        found = np.linalg.norm(sight, axis=2)
        slopes = sight / found[:, :, None]
        places += np.linalg.solve(slopes, (ranges - found)[..., None])[..., 0]
    logs = (sum(log_likelihood(one, places, std) for one in sightings)
            - log_proposal - np.linalg.slogdet(slopes)[1])
    weights = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    assert 1 / np.sum(weights**2) > n / 50
    mean = weights @ places
    return mean, (places - mean).T @ ((places - mean) * weights[:, None])


@pytest.mark.slow
def test_many_thin_sheets_of_three_surfaces_meet_in_points():
    std, rng = np.array([0.001, 0.05, 0.05]), np.random.default_rng(0)
    sightings = [sheets(pose, PLACE + rng.normal(scale=0.3, size=(8, 3)), np.zeros(8), std)
                 for pose in (FRONT, SIDE, ABOVE)]
    assert_moments(fuse(sightings, BOUNDS), *multilaterated(sightings, std))


def test_positions_are_inside_the_region():
    # The mode has its maximum 0.3 m above the region.
    sightings = [sheets(FRONT, [8.0, 1.0, 1.3])]
    fused = fuse(sightings, BOUNDS)
    assert (fused.mixture.means <= BOUNDS[1]).all()
    assert_moments(fused, *integrated(sightings), tolerance=0.15)


def test_a_region_without_height_keeps_its_height():
    flat = np.array([[5.0, -5.0, 0.0], [15.0, 5.0, 0.0]])
    fused = fuse([sheets(FRONT, PLACE), sheets(SIDE, PLACE)], flat)
    mean, covariance = fused.mixture.moments()
    np.testing.assert_allclose(mean[2], 0.0, atol=0.005)
    assert covariance[2, 2] < 0.005**2


def test_arcs_of_nearly_one_circle_meet_along_a_crescent():
    """In a plane across, surfaces side by side see such arcs."""
    half, std = np.radians(2.5), np.array([0.05, 0.3, 0.3])
    turned = Pose(tuple(10.0 * np.array([1 - np.cos(2 * half), -np.sin(2 * half), 0.0])),
                  (0.0, 0.0, np.sin(half), np.cos(half)), EXACT)
    plane = np.array([[9.0, -5.0, -2.0], [9.0, 5.0, 2.0]])
    sightings = [sheets(pose, [9.0, 1.5, 1.0], std=std) for pose in (FRONT, turned)]
    y, z = (one.ravel() for one in np.meshgrid(*np.linspace(plane[0, 1:], plane[1, 1:], 400).T))
    positions = np.column_stack([0 * y + 9.0, y, z])
    weights = np.exp(sum(log_likelihood(one, positions, std) for one in sightings))
    weights /= weights.sum()
    mean = weights @ positions
    deviation = np.sqrt(weights @ (positions - mean)**2)[1:]
    fused = fuse(sightings, plane)
    np.testing.assert_allclose((fused.mean - mean)[1:] / deviation, 0.0, atol=0.1)
    np.testing.assert_allclose(
        np.sqrt(np.diag(fused.covariance))[1:] / deviation, 1.0, atol=0.1)


def test_a_line_meets_two_sheets_on_either_side():
    """Seen values of a line across: surfaces that face each other see both sides alike."""
    std, x, z = np.array([0.05, 0.3, 0.3]), 6.718, 0.208
    line = np.array([[x, -5.0, z], [x, 5.0, z]])
    sightings = [sheets(FRONT, [6.89, -1.74, -2.17], std=std),
                 sheets(OPPOSITE, [9.37, 6.75, 5.09], std=std)]
    y = np.linspace(-5.0, 5.0, 20_001)
    logs = sum(log_likelihood(one, np.column_stack([0 * y + x, y, 0 * y + z]), std)
               for one in sightings)
    weights = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    mean, fused = weights @ y, fuse(sightings, line)
    deviation = np.sqrt(weights @ (y - mean)**2)
    assert deviation > 3
    np.testing.assert_allclose(fused.mean, [x, mean, z], atol=0.05)
    np.testing.assert_allclose(np.sqrt(fused.covariance[1, 1]), deviation, rtol=0.02)


def test_a_density_on_a_line_is_a_likelihood_along_it():
    """Broad modes have the moments of samples in the region, and say nothing across a line."""
    line, normal = np.array([[10.0, -5.0, 0.4], [10.0, 5.0, 0.4]]), np.linspace(-4, 4, 801)
    y, std = 1.5 + 0.1 * normal, np.array([0.2, 0.02, 0.1])
    positions, density = np.column_stack([0 * y + 10, y, 0 * y + 0.4]), np.exp(-normal**2 / 2)
    found = Sheets.of_density(np.zeros(1), *(each[None] for each in moments(
        density / density.sum(), to_polar(positions))), line)
    turned = Pose((5.0, -5 * 3**0.5, 0.0), (0.0, 0.0, 0.5, 3**0.5 / 2), EXACT)
    other = sheets(turned, [10.2, 1.7, 0.5], std=std)
    weights = density * np.exp(log_likelihood(other, positions, std))
    weights /= weights.sum()
    mean = weights @ y
    fused = fuse([Sighting(FRONT, found.to_mixture(FRONT), 1e-12, found), other], line)
    np.testing.assert_allclose(fused.mean, [10.0, mean, 0.4], atol=0.002)
    np.testing.assert_allclose(fused.covariance[1, 1], weights @ (y - mean)**2, rtol=0.05)


def test_a_turned_surface_sees_users_beside_the_line_that_they_are_on():
    """The user is where the line has the range of the sheet, which a turn does not change."""
    std, line = np.array([1e-3, 2e-5, 2e-5]), np.array([[10.0, -5.0, 0.4], [10.0, 5.0, 0.4]])
    pose = Pose((5.0, -5 * 3**0.5, 0.0), (0.0, 0.0, 0.5, 3**0.5 / 2), (0.0, 0.5))
    place, turn = np.array([10.0, 1.5, 0.4]), np.radians([0.0, 0.0, 0.0, 0.5, 0.3, 0.7])
    seen = dataclasses.replace(sheets(
        dataclasses.replace(pose, uncertainty=EXACT),
        pose.to_site(pose.displaced(turn).to_surface(place)), std=std), pose=pose)
    fused, sight = fuse([seen], line), place - pose.origin
    along = sight[1] / np.linalg.norm(sight)
    assert fused.mean[1] == pytest.approx(place[1], abs=std[0] / along)
    assert np.sqrt(fused.covariance[1, 1]) == pytest.approx(std[0] / along, rel=0.05)
    # The logarithm of the density of the turn, relative to its maximum.
    across = np.cross(sight, turn[3:]) / np.radians(0.5)
    assert fused.log_agreement == pytest.approx(-across @ across / (sight @ sight) / 2, abs=0.1)


def test_an_uncertain_pose_widens_the_posterior_by_its_covariance():
    place = np.array([10.0, 0.0, 0.0])
    uncertain = Pose(uncertainty=(0.3, 0.0))
    alone = fuse([sheets(FRONT, place, std=STD / 100)], BOUNDS).mixture.moments()[1]
    found = fuse([dataclasses.replace(sheets(FRONT, place, std=STD / 100), pose=uncertain)],
                 BOUNDS)
    np.testing.assert_allclose(found.mixture.moments()[1] - alone, 0.09 * np.eye(3), atol=0.01)


@pytest.mark.slow
def test_the_constant_part_of_a_covariance_is_that_of_displaced_poses():
    """To first order in the errors of both poses: the slopes are differences."""
    one, other = (dataclasses.replace(pose, uncertainty=(0.02, 0.2)) for pose in (FRONT, SIDE))
    seen = [sheets(pose, PLACE, std=STD / 100) for pose in (one, other)]

    def displaced(sighting, error):
        pose = sighting.pose.displaced(error)
        return dataclasses.replace(
            sighting, pose=pose, mixture=sighting.mixture.moved(sighting.pose, pose))

    def mean(errors):
        return fuse(list(map(displaced, seen, np.split(errors, 2))), BOUNDS).mean
    slopes = np.stack([(mean(step) - mean(-step)) / 2e-3 for step in 1e-3 * np.eye(12)], axis=1)
    constant = fuse(seen, BOUNDS).mixture.constant_covariance
    np.testing.assert_allclose(
        constant, slopes[:, :6] @ one.covariance @ slopes[:, :6].T
        + slopes[:, 6:] @ other.covariance @ slopes[:, 6:].T, atol=0.1 * constant.max())


def test_widening_keeps_the_weights_of_the_modes():
    # The modes are so far apart that they do not overlap. One is much narrower.
    front = sheets(FRONT, [PLACE, PLACE + [4.0, 0.0, 0.0]], np.log([0.3, 0.7]))
    front.mixture.covariances[1] *= 1e-2
    wide = dataclasses.replace(front, pose=Pose(uncertainty=(0.02, 0.0)))
    found = fuse([wide], BOUNDS).mixture
    np.testing.assert_allclose(np.sort(np.exp(found.log_weights)), [0.3, 0.7], rtol=0.03)


@pytest.mark.parametrize('missing', [1e-3, 1 - 1e-9])
def test_surfaces_that_disagree_make_the_posterior_broad(missing):
    far = PLACE + [3.0, -2.0, 0.0]
    fused = fuse([sheets(FRONT, PLACE, missing=missing), sheets(SIDE, far, missing=missing)],
                 BOUNDS)
    mean, covariance = fused.mixture.moments()
    np.testing.assert_allclose(fused.mixture.probabilities, [0.5, 0.5], atol=0.1)
    for place in (PLACE, far):
        offset = place - mean
        assert offset @ np.linalg.solve(covariance, offset) < 2


def test_a_surface_that_is_probably_blocked_has_little_weight():
    far = PLACE + [3.0, -2.0, 0.0]
    fused = fuse([sheets(FRONT, PLACE, missing=1e-3), sheets(SIDE, far, missing=0.9)], BOUNDS)
    np.testing.assert_allclose(fused.mixture.moments()[0], PLACE, atol=0.05)


def test_agreement_is_the_density_of_the_signals_relative_to_separate_users():
    # With narrow Gaussians of equal width, the integral of the product is that of Gaussians.
    std_m, volume_m3 = 0.01, 200.0
    place, pose = np.array([10.0, 0.0, 0.0]), Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0), EXACT)
    offset = np.array([0.015, -0.01, 0.0])
    first = Sighting(FRONT, Mixture(np.zeros(1), place[None], std_m**2 * np.eye(3)[None]), 1e-12)
    second = Sighting(pose, first.mixture._replace(means=place[None] + offset), 1e-12)
    expected = (np.log(volume_m3) - 1.5 * np.log(4 * np.pi * std_m**2)
                - offset @ offset / (4 * std_m**2))
    np.testing.assert_allclose(fuse([first, second], BOUNDS).log_agreement, expected, atol=0.01)
    np.testing.assert_allclose(fuse([first], BOUNDS).log_agreement, 0.0, atol=0.01)


def test_fusion_needs_a_surface():
    with pytest.raises(ValueError, match='sightings: none, expected at least one'):
        fuse([], BOUNDS)


@pytest.fixture(scope='module')
def world():
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.56e9, 2.6e9), n_frames=2, elements_per_side=6)
    codebook = random_codebook(scenario, np.random.default_rng(1))
    return scenario, codebook, make_estimator('bayes', scenario, codebook)


def drawn(world, pose, positions, seed):
    scenario, codebook, _ = world
    model = MeasurementModel(scenario, codebook)
    return model.sample(pose.to_surface(positions), np.random.default_rng(seed))


def test_one_surface_has_the_moments_of_its_modes(world):
    scenario, _, estimator = world
    positions = scenario.sample_positions(20, np.random.default_rng(2))
    for signals in drawn(world, SIDE, positions, 3):
        alone = estimator.posterior(signals)
        fused = fuse([alone.sighting.at(SIDE)], BOUNDS)
        assert_moments(fused, SIDE.to_site(alone.mean), SIDE.covariances_to_site(alone.covariance),
                       tolerance=0.12)


def test_products_of_the_same_sightings_are_computed_once():
    fuser, one, two, three = Fuser(BOUNDS), *(
        sheets(pose, PLACE) for pose in (FRONT, SIDE, OPPOSITE))
    pair = fuser.fuse([one, two])
    assert fuser.fuse((one, two)) is pair
    # The same numbers as without the others, to the last bit.
    for group in ([one, two], [one, two, three], [two, three]):
        found, expected = fuser.fuse(group), fuse(group, BOUNDS)
        assert found.log_agreement == expected.log_agreement
        assert np.array_equal(found.mixture.means, expected.mixture.means)
    # The surface is the same, but may be elsewhere with a higher probability.
    assert fuser.fuse([one, dataclasses.replace(two, missing=0.5)]) is not pair
    copied = pickle.loads(pickle.dumps(fuser))
    assert copied.fuse([one, two]).log_agreement == pair.log_agreement


def outside_probability(*log_ratios, poses=(FRONT, SIDE), place=PLACE, **fields):
    """Return that of surfaces that agree on a place in the region of the site."""
    return fuse([dataclasses.replace(sheets(pose, place), outside_log_ratio=log_ratio, **fields)
                 for pose, log_ratio in zip(poses, log_ratios, strict=False)],
                BOUNDS, 0.5).outside_probability


def test_a_single_surface_decides_by_its_own_evidence():
    for log_ratio in (-3.0, 0.0, 3.0):
        assert outside_probability(log_ratio) == pytest.approx(
            1 / (1 + np.exp(-log_ratio)), abs=0.02)


def test_surfaces_that_agree_are_evidence_for_a_user_inside():
    agreement = float(fuse([sheets(FRONT, PLACE), sheets(SIDE, PLACE)], BOUNDS).log_agreement)
    assert agreement > 3
    assert outside_probability(agreement / 2, agreement / 2) == pytest.approx(0.5, abs=0.02)
    assert outside_probability(0.0, 0.0) < 0.05
    # A surface that is blocked has no evidence.
    assert outside_probability(20.0, 0.0, missing=1 - 1e-11) == pytest.approx(0.5, abs=0.02)


def test_a_surface_that_sees_the_user_beyond_the_region_of_the_site_is_evidence():
    beyond = PLACE + [0.0, 6.0, 0.0]
    assert outside_probability(-20.0, place=beyond) > 0.99
    assert outside_probability(-20.0, -20.0, place=beyond) > 0.99


def test_the_tail_of_a_sheet_far_beyond_the_region_agrees_with_no_surface():
    # The second surface has a narrow mode four metres beyond the border, at thousands of standard
    # deviations. Its values in the region are inaccurate.
    turned = Pose((5.0, -75**0.5, 0.0), (0.0, 0.0, 0.5, 0.75**0.5))
    seen = [dataclasses.replace(
        sheets(pose, pose.to_site(to_positions(points))), missing=1e-3,
        sheets=Sheets(np.zeros(1), points, 1e-6 * np.array([covariance])))
        for pose, points, covariance in (
            (Pose(), np.array([[12.8921, -0.3585, 0.0152]]),
             [[2.53, 3.46, 0.05], [3.46, 144.6, -5.84], [0.05, -5.84, 136.7]]),
            (turned, np.array([[7.01756, -0.9196, 0.03918]]),
             [[0.0835, 0.0604, 0.3188], [0.0604, 1.8733, 1.0258], [0.3188, 1.0258, 14.875]]))]
    assert fuse(seen, BOUNDS).log_agreement < np.log(1e-3) + 0.1


def test_a_user_in_the_region_of_the_site_is_likelier_the_larger_that_of_the_surface():
    """Evidences outside are relative to the average over the region of the surface."""
    turned = Pose((10 - 50**0.5, -50**0.5, 0.0), (0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8)),
                  EXACT)
    twice = BOUNDS * [1.0, 2.0, 1.0]
    for pose, region_m, ratio in ((FRONT, None, 1), (FRONT, BOUNDS, 1), (FRONT, twice, 2),
                                  (turned, None, 2)):
        one = sheets(pose, PLACE)
        found = outside_probability(1.0, poses=[pose], sheets=one.likelihood, region_m=region_m)
        assert found == pytest.approx(1 / (1 + ratio * np.exp(-1)), abs=0.01)


@pytest.mark.parametrize('pose', [
    FRONT, dataclasses.replace(FRONT, quaternion=(np.sin(0.3), 0.0, 0.0, np.cos(0.3)))],
    ids=['along an axis', 'turned'])
def test_the_error_of_a_pose_is_no_evidence_for_a_user_beside_a_line(pose):
    """The surface sees users beside the line in its own frame, which is no region elsewhere."""
    line = np.array([[10.0, -5.0, 0.4], [10.0, 5.0, 0.4]])
    exact = sheets(pose, [10.0, 1.5, 0.4], std=STD / 10)
    one = dataclasses.replace(
        exact, pose=dataclasses.replace(pose, uncertainty=(0.05, 0.0)), sheets=exact.likelihood,
        outside_log_ratio=-20.0)
    assert fuse([one], line, 0.5).outside_probability < 1e-6


def test_users_are_inside_if_no_surface_knows_about_users_outside():
    assert np.isnan(outside_probability(np.nan, np.nan))
