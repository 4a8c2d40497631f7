"""The surface and the site of a node, from its parameters and namespace."""

import dataclasses
import types
from pathlib import Path

import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Site
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.fusion import Fusion
from rhs_isac_ros.ros.place import Place
from rhs_isac_ros.support.fields import ParameterError

FILE = str(Path(__file__).parents[2] / 'config' / 'site.yaml')


@pytest.fixture(scope='module')
def site():
    return Site.from_yaml(FILE)


def place(namespace, site_file=FILE, scenario_file='', of_site=False):
    values = types.SimpleNamespace(site_file=site_file, scenario_file=scenario_file)
    return Place.of(values, namespace, of_site)


def listed(one, kinds):
    return [(prefix, scenario.id, set(of_prefix))
            for prefix, scenario, of_prefix in one.sources(kinds)]


def test_without_a_site_every_message_is_of_the_own_scenario():
    one = place('/lab', '')
    assert one.scenario.id == Scenario().id
    assert one.codebook is None
    assert one.seed(5) == 5
    assert listed(one, Channel.RECEIVES) == [('', Scenario().id, set(Channel.RECEIVES))]


@pytest.mark.parametrize(('namespace', 'base'), [('/side', ''), ('/lab/two/side', '/lab/two')])
def test_a_surface_receives_shared_messages_from_the_leader(site, namespace, base):
    one, (front, side) = place(namespace), site.surfaces.values()
    assert one.scenario.id == side.scenario.id != front.scenario.id
    assert one.codebook.id == side.codebook.id
    shared = {m.GroundTruth, m.Pilot}
    assert listed(one, Channel.RECEIVES) == [
        ('', side.scenario.id, set(Channel.RECEIVES) - shared),
        (f'{base}/front/', front.scenario.id, shared)]


def test_the_leader_receives_all_messages_from_itself(site):
    one = place('/front')
    assert {prefix for prefix, *_ in one.sources(Channel.RECEIVES)} == {'', '/front/'}
    assert {scenario.id for _, scenario, _ in one.sources(Channel.RECEIVES)} == {
        site.surfaces['front'].scenario.id}


@pytest.mark.parametrize(('namespace', 'base'), [('/', ''), ('/lab', '/lab')])
def test_a_node_of_the_site_receives_the_messages_of_every_surface(site, namespace, base):
    one = place(namespace, of_site=True)
    assert one.scenario.id == site.surfaces['front'].scenario.id
    assert listed(one, Fusion.RECEIVES) == [
        (f'{base}/{name}/', of_name.scenario.id, set(Fusion.RECEIVES))
        for name, of_name in site.surfaces.items()]


def test_surfaces_have_seeds_of_their_own():
    seeds = [place(name).seed(seed) for name in ('/front', '/side') for seed in (0, 2**31 - 1)]
    assert len(set(seeds)) == 4
    assert seeds[:2] == [0, 2**31 - 1]
    assert place('/', of_site=True).seed(3) == 3


@pytest.mark.parametrize(('options', 'text'), [
    ({'namespace': '/rear'}, "namespace: '/rear', expected the name of a surface"),
    ({'namespace': '/'}, 'at its end: front, side'),
    ({'namespace': '/side', 'scenario_file': 'a.yaml'}, 'expected only a site file'),
    ({'namespace': '/', 'site_file': '', 'of_site': True}, "site_file: '', "),
    ({'namespace': '/side', 'site_file': 'none.yaml'}, 'site_file: none.yaml')])
def test_a_place_that_does_not_exist_is_named(options, text):
    with pytest.raises(ParameterError) as error:
        place(**options)
    assert text in str(error.value)


def test_only_the_pose_distinguishes_two_surfaces_of_equal_scenarios(site):
    front, side = (one.scenario for one in site.surfaces.values())
    assert dataclasses.replace(side, pose=front.pose).id == front.id
