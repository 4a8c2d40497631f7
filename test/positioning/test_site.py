"""Sites with several surfaces, their files and positions from all surfaces."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.positioning import SignalError, Site, SiteError, SiteEstimator
from rhs_isac_ros.positioning.agreement import PoseTest
from rhs_isac_ros.positioning.fusion import Fuser
from rhs_isac_ros.positioning.site import site_text
from rhs_isac_ros.system import System

CONFIG = Path(__file__).parents[2] / 'config'
BOUNDS = np.array([[5.0, -5.0, -1.0], [15.0, 5.0, 1.0]])
EXACT = (0.0, 0.0)
SCENARIO = Scenario.from_yaml(CONFIG / 'bandplan.yaml')
CODEBOOK = Codebook.load(CONFIG / 'codebook_bandplan.yaml')
FRONT, SIDE = (
    System(dataclasses.replace(SCENARIO, pose=pose), CODEBOOK)
    for pose in (Pose(uncertainty=EXACT), Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0), EXACT)))
SITE = Site({'front': FRONT, 'side': SIDE}, BOUNDS)


@pytest.fixture(scope='module')
def estimator():
    return SiteEstimator(SITE)


@pytest.fixture(scope='module')
def cycles():
    """Positions, and the signals of each cycle by the name of the surface."""
    rng = np.random.default_rng(2)
    positions = rng.uniform(*BOUNDS, size=(30, 3))
    received = SITE.sample(positions, rng)
    return positions, [{name: signals[number] for name, signals in received.items()}
                       for number in range(len(positions))]


@pytest.fixture(scope='module')
def located(estimator, cycles):
    """The estimates from both surfaces, and from each of them."""
    received = {name: np.stack([one[name] for one in cycles[1]]) for name in ('front', 'side')}
    return [estimator.estimate({name: received[name] for name in names})
            for names in (['front', 'side'], ['front'], ['side'])]


@pytest.mark.slow
def test_all_surfaces_locate_better_than_one(located, cycles):
    both, *alone = (np.mean(np.sum((found.mean - cycles[0])**2, axis=1)) for found in located)
    assert both < 0.7 * min(alone)


@pytest.mark.slow
def test_a_surface_without_a_signal_is_left_out(estimator, cycles):
    cycle = cycles[1][0]
    silent = np.zeros_like(cycle['side'])
    assert set(estimator.sightings({**cycle, 'side': silent})) == {'front'}
    mixtures = [estimator.estimate(received).mixture for received in (
        {**cycle, 'side': silent}, {'front': cycle['front']})]
    np.testing.assert_array_equal(mixtures[0].means, mixtures[1].means)
    none = estimator.estimate({'side': silent})
    assert not none.fix
    assert none.reason.startswith('side: energy of the signals')


def test_several_shots_are_located_at_once(estimator, cycles):
    shots = [*cycles[1][:2], {name: np.zeros_like(one) for name, one in cycles[1][0].items()}]
    received = {name: np.stack([shot[name] for shot in shots]) for name in ('front', 'side')}
    found = estimator.estimate(received)
    assert found.fix.tolist() == [True, True, False]
    for n in range(2):
        np.testing.assert_allclose(found[n].mean, estimator.estimate(shots[n]).mean, atol=1e-6)
        np.testing.assert_allclose(found[n].mixture.moments()[0], found.mean[n], rtol=1e-12)
    with pytest.raises(SignalError, match="'side': 1} shots, expected equal numbers"):
        estimator.estimate({**received, 'side': received['side'][:1]})
    with pytest.raises(SignalError, match='received: 3 shots, expected one'):
        estimator.sightings(received)


def test_arrays_with_a_mask_are_refused(estimator, cycles):
    hidden = {**cycles[1][0], 'side': np.ma.array(cycles[1][0]['side'])}
    for answer in (estimator.estimate, estimator.sightings):
        with pytest.raises(SignalError, match='received: a masked array'):
            answer(hidden)
    with pytest.raises(ValueError, match='positions: a masked array'):
        SITE.sample(np.ma.array(cycles[0]), np.random.default_rng(0))


@pytest.mark.slow
def test_users_outside_have_no_position_and_users_inside_have_one(estimator, located):
    assert located[0].fix.all()
    rng = np.random.default_rng(6)
    positions = rng.uniform(BOUNDS[0] - [3, 3, 1], BOUNDS[1] + [5, 5, 1], size=(120, 3))
    distances = np.linalg.norm(positions - np.clip(positions, *BOUNDS), axis=1)
    received = SITE.sample(positions[distances > 0.5][:30], rng)
    found = estimator.estimate(received)
    assert found.fix.sum() <= 1
    assert all(reason.startswith('position outside of the region')
               for reason, fix in zip(found.reason, found.fix, strict=True) if not fix)


def test_users_on_a_plane_have_a_position_if_the_pose_is_off_as_declared():
    plane, pose = BOUNDS * [1.0, 1.0, 0.0], Pose(uncertainty=(0.1, 0.0))
    quick = dataclasses.replace(
        Scenario.from_yaml(CONFIG / 'quick.yaml'), roi_size_m=(10.0, 10.0, 0.0),
        multipath_to_los_db=-30.0, outside_probability=0.25, pose=pose)
    system = System(quick, Codebook.load(CONFIG / 'codebook_quick.yaml'))
    rng, moved = np.random.default_rng(1), pose.displaced([0.0, 0.0, 0.15, 0.0, 0.0, 0.0])
    users = rng.uniform(*plane, size=(20, 3))
    found = SiteEstimator(Site({'front': system}, plane)).estimate(
        {'front': system.sample(moved.to_surface(users), rng)})
    assert found.fix.all()
    np.testing.assert_array_equal(found.mean[:, 2], 0.0)
    errors = (found.mean - users)[:, :2]
    squares = np.einsum('ni,nij,nj->n', errors, np.linalg.inv(found.covariance[:, :2, :2]), errors)
    assert squares.max() < 20


def test_the_example_is_two_surfaces_at_a_right_angle():
    site = Site.from_yaml(CONFIG / 'site.yaml')
    assert list(site.surfaces) == ['front', 'side']
    assert site.leader == 'front'
    np.testing.assert_array_equal(site.bounds_m, BOUNDS)
    front, side = (one.pose.vectors_to_site(np.array([1.0, 0.0, 0.0]))
                   for one in site.surfaces.values())
    assert front @ side == pytest.approx(0.0)
    assert site.surfaces['side'].pose.uncertainty == Pose().uncertainty


def written(folder, change=lambda content: None):
    """Write the example with a change, and return its path."""
    content = yaml.safe_load((CONFIG / 'site.yaml').read_text(encoding='utf-8'))
    for one in content['surfaces'].values():
        one |= {name: str(CONFIG / one[name]) for name in ('scenario', 'codebook')}
    change(content)
    path = folder / 'site.yaml'
    path.write_text(yaml.safe_dump(content), encoding='utf-8')
    return path


def test_a_pose_is_by_default_that_of_the_scenario(tmp_path):
    def change(content):
        del content['surfaces']['front']['pose']
    assert Site.from_yaml(written(tmp_path, change)).surfaces['front'].pose == Pose()


@pytest.mark.parametrize(('change', 'message'), [
    (lambda site: site['surfaces'].update(side=copy.deepcopy(site['surfaces']['front'])),
     r'front, side: pose \(0.0, 0.0, 0.0\) m, expected surfaces with different scenarios'),
    (lambda site: site.pop('roi_size_m'), r"site.yaml: .*, expected the keys \['roi_center_m'"),
    (lambda site: site.update(extra=1), r"site.yaml: \['extra', .*\], expected the keys"),
    (lambda site: site.update(surfaces={}), 'surfaces: none, expected at least one'),
    (lambda site: site.update(surfaces=[1]), 'surfaces: expected a mapping of names to surfaces'),
    (lambda site: site['surfaces'].update({'Top/1': site['surfaces'].pop('side')}),
     "surfaces: 'Top/1', expected a name of small letters"),
    (lambda site: site['surfaces']['side'].pop('codebook'), 'side: .* expected the keys'),
    (lambda site: site['surfaces']['side'].update(place=1), 'side: .*place.* expected the keys'),
    (lambda site: site['surfaces']['side'].update(pose=1), 'side: pose: 1, expected a mapping'),
    (lambda site: site['surfaces']['side'].update(scenario=3), 'unsupported operand'),
    (lambda site: site['surfaces']['side'].update(scenario='none.yaml'), 'none.yaml: cannot be'),
    (lambda site: site['surfaces']['side'].update(codebook=str(CONFIG / 'codebook.yaml')),
     'codebook.yaml: analog'),
    (lambda site: site['surfaces']['side']['pose'].update(position_m=[10.0, 0.0, 0.0]),
     'side: roi_center_m'),
])
def test_invalid_files_are_refused(tmp_path, change, message):
    with pytest.raises(SiteError, match=message) as error:
        Site.from_yaml(written(tmp_path, change))
    assert 'site.yaml' in str(error.value)


def test_the_region_of_a_surface_in_a_file_is_that_of_the_site(tmp_path):
    def change(content):
        content['surfaces']['side']['pose'].update(position_m=[10.0, -9.0, 0.5])
    scenario = Site.from_yaml(written(tmp_path, change)).surfaces['side'].scenario
    np.testing.assert_array_equal(scenario.roi_bounds_m, [[4.0, -5.0, -1.5], [14.0, 5.0, 0.5]])
    # As long as it is the same, estimators use the same tables.
    example = Site.from_yaml(CONFIG / 'site.yaml').surfaces['side'].scenario
    assert example.id == dataclasses.replace(SCENARIO, pose=example.pose).id


def test_a_file_with_other_poses_is_the_same_site(tmp_path):
    pose = Pose((10.1, -10.2, 0.1), (0.0, 0.1, 1.0, 1.0), tuple(map(tuple, 1e-4 * np.eye(6))))
    (tmp_path / 'below').mkdir()
    path = tmp_path / 'below' / 'moved.yaml'
    path.write_text(site_text(written(tmp_path), {'side': pose}, path.parent), encoding='utf-8')
    before, after = (Site.from_yaml(file) for file in (written(tmp_path), path))
    assert after.surfaces['side'].pose == pose
    assert after.surfaces['front'].scenario == before.surfaces['front'].scenario
    assert after.surfaces['side'].codebook.id == before.surfaces['side'].codebook.id


def test_a_file_behind_a_link_names_the_same_files(tmp_path):
    (tmp_path / 'deep' / 'er' / 'real').mkdir(parents=True)
    link = tmp_path / 'link'
    link.symlink_to(tmp_path / 'deep' / 'er' / 'real')
    first = written(tmp_path)
    for source, folder in ((first, link), (link / 'moved.yaml', tmp_path)):
        path = folder / 'moved.yaml'
        path.write_text(site_text(source, {}, folder), encoding='utf-8')
        assert Site.from_yaml(path).surfaces.keys() == Site.from_yaml(first).surfaces.keys()


def test_the_region_of_a_turned_surface_may_be_larger():
    turned = dataclasses.replace(
        SCENARIO, pose=Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.1, 1.0), EXACT))
    with pytest.raises(SiteError, match='side: roi_center_m'):
        Site({'side': System(turned, CODEBOOK)}, BOUNDS)
    large = dataclasses.replace(turned, roi_size_m=(14.0, 14.0, 2.0))
    assert Site({'side': System(large, CODEBOOK)}, BOUNDS).surfaces


def test_drawn_agreements_are_references_for_their_places(estimator):
    agreements, places = estimator.draw_agreements(5, np.random.default_rng(2))
    assert [*agreements[0]] == [('front', 'side')]
    assert len(agreements) == len(places) <= 5
    assert ((places >= BOUNDS[0]) & (places <= BOUNDS[1])).all()
    PoseTest(agreements, places).add(agreements[0], places[0])


def test_signals_of_no_or_an_unknown_surface_are_refused(estimator, cycles):
    for received in ({}, {'left': cycles[1][0]['side']}):
        with pytest.raises(SignalError, match=r"surfaces \[.*\], expected some of \['front'"):
            estimator.estimate(received)


def test_all_surfaces_see_the_same_velocity(monkeypatch):
    seen = {}
    monkeypatch.setattr(System, 'sample', lambda self, states, rng: seen.setdefault(
        self.pose, states))
    walking = [dataclasses.replace(one.scenario, user_speed_std_mps=1.0) for one in (FRONT, SIDE)]
    site = Site({name: System(scenario, CODEBOOK) for name, scenario in zip(
        ('front', 'side'), walking, strict=True)}, BOUNDS)
    places = np.random.default_rng(1).uniform(*BOUNDS, size=(200, 3))
    for states in (places, np.hstack([places, [[1.0, 2.0, 0.0]] * 200])):
        seen.clear()
        site.sample(states, np.random.default_rng(2))
        front, side = ([pose.to_site(one[:, :3]), pose.vectors_to_site(one[:, 3:])]
                       for pose, one in seen.items())
        np.testing.assert_allclose(front, side, atol=1e-12)
        np.testing.assert_allclose(front[0], places)
        if states is places:
            np.testing.assert_allclose(front[1].std(axis=0), 1.0, atol=0.2)
    np.testing.assert_allclose(front[1], states[:, 3:])
    with pytest.raises(ValueError, match=r'positions: shape \(3,\), expected \[N, 3\] or'):
        site.sample(places[0], np.random.default_rng(2))


@pytest.mark.parametrize('bounds_m', [BOUNDS[::-1], BOUNDS[:1], np.nan * BOUNDS])
def test_bounds_are_two_corners(bounds_m):
    with pytest.raises(SiteError, match='bounds_m: .*expected'):
        Site({'front': FRONT}, bounds_m)
    with pytest.raises(ValueError, match='bounds_m: .*expected'):
        Fuser(bounds_m)
    assert Site({'front': FRONT}, BOUNDS.astype(int).tolist()).bounds_m.dtype == float
