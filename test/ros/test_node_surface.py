"""The surface and the site of a node, from its parameters and namespace."""

import types
from pathlib import Path

import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Site
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.node_surface import NodeSurface
from rhs_isac_ros.ros.parameters import calibrated_surface
from rhs_isac_ros.ros.roster import MEMBERS
from rhs_isac_ros.support.fields import ParameterError

FILE, LAB = (str(Path(__file__).parents[2] / 'config' / f'{name}.yaml')
             for name in ('site', 'lab_system'))


@pytest.fixture(scope='module')
def site():
    return Site.from_yaml(FILE)


def surface_of(namespace, site_file=FILE, scenario_file='', system_file='', of_site=False):
    values = types.SimpleNamespace(
        site_file=site_file, scenario_file=scenario_file, system_file=system_file)
    return NodeSurface.of(values, namespace, of_site)


def listed(one, role):
    """The classes of messages that a role receives, by prefix and scenario."""
    found = {}
    for kind, prefix, scenario in one.sources(MEMBERS[role].role.RECEIVES, MEMBERS[role].from_all):
        found.setdefault((prefix, scenario.id), set()).add(kind)
    return found


def test_without_a_site_every_message_is_of_the_own_scenario():
    one = surface_of('/lab', '')
    assert one.scenario.id == Scenario().id
    assert one.system is None
    assert one.seed(5) == 5
    assert one.site_prefix == ''
    for role in ('bs', 'channel'):
        assert listed(one, role) == {('', Scenario().id): set(MEMBERS[role].role.RECEIVES)}


def test_a_system_file_names_scenario_codebook_and_calibration():
    one = surface_of('/lab', '', system_file=LAB)
    assert one.scenario == one.system.scenario == Scenario.from_yaml(LAB.replace('_system', ''))
    for name in ('calibration_file', 'states_file'):
        values = types.SimpleNamespace(calibration_file='', states_file='')
        assert calibrated_surface(values, one, name) is one.system.surface
        assert calibrated_surface(values, surface_of('/side'), name) is None


@pytest.mark.parametrize(('namespace', 'base'), [('/side', ''), ('/lab/two/side', '/lab/two')])
def test_a_surface_receives_shared_messages_from_the_leader(site, namespace, base):
    one, (front, side) = surface_of(namespace), site.surfaces.values()
    assert one.scenario.id == side.scenario.id != front.scenario.id
    assert one.system.codebook.id == side.codebook.id
    assert listed(one, 'channel') == {
        ('', side.scenario.id): {m.RhsConfiguration, m.Beam},
        (f'{base}/front/', front.scenario.id): {m.GroundTruth, m.Pilot},
        # All data are on one topic, and name the surface that carries them.
        (f'{base}/front/', side.scenario.id): {m.Data}}
    assert listed(one, 'transmission') == {
        ('', side.scenario.id): {m.RhsConfiguration},
        (f'{base}/', front.scenario.id): {m.PositionEstimate},
        (f'{base}/front/', front.scenario.id): {m.GroundTruth}}


def test_the_base_station_receives_from_the_fusion_and_from_every_surface(site):
    one, (front, side) = surface_of('/lab/front'), site.surfaces.values()
    every = {m.Beam, m.RhsConfiguration, m.Data}
    assert listed(one, 'bs') == {
        ('', front.scenario.id): {m.Ack, m.FeedSignals},
        ('/lab/', front.scenario.id): {m.PositionEstimate, m.NoFix},
        ('/lab/front/', front.scenario.id): {*every, m.Pilot},
        ('/lab/side/', side.scenario.id): every}
    assert one.site_prefix == '/lab/'


def test_data_of_a_surface_of_the_site_are_not_foreign(site, example):
    one, (front, side) = surface_of('/front'), site.surfaces.values()
    assert one.is_carried(example(m.Data, scenario_id=side.scenario.id))
    assert not one.is_carried(example(m.Data, scenario_id='other'))
    assert not one.is_carried(example(m.Beam, scenario_id=side.scenario.id))
    assert not surface_of('/', '').is_carried(example(m.Data, scenario_id=front.scenario.id))


@pytest.mark.parametrize(('namespace', 'base'), [('/', ''), ('/lab', '/lab')])
def test_a_node_of_the_site_receives_the_messages_of_every_surface(site, namespace, base):
    one = surface_of(namespace, of_site=True)
    assert one.scenario.id == site.surfaces['front'].scenario.id
    assert listed(one, 'fusion') == {
        (f'{base}/{name}/', of_name.scenario.id): {m.Posterior, m.NoFix}
        for name, of_name in site.surfaces.items()}


def test_surfaces_have_seeds_of_their_own():
    seeds = [surface_of(name).seed(seed)
             for name in ('/front', '/side') for seed in (0, 2**31 - 1)]
    assert len(set(seeds)) == 4
    assert seeds[:2] == [0, 2**31 - 1]
    assert surface_of('/', of_site=True).seed(3) == 3


@pytest.mark.parametrize(('options', 'text'), [
    ({'namespace': '/rear'}, "namespace: '/rear', expected the name of a surface"),
    ({'namespace': '/'}, 'at its end: front, side'),
    ({'namespace': '/side', 'scenario_file': 'a.yaml'}, 'expected only one of these'),
    ({'namespace': '/', 'site_file': '', 'of_site': True}, 'site_file: none, expected'),
    ({'namespace': '/', 'site_file': '', 'system_file': 'none.yaml'}, 'system_file: none.yaml'),
    ({'namespace': '/side', 'site_file': 'none.yaml'}, 'site_file: none.yaml')])
def test_a_place_that_does_not_exist_is_named(options, text):
    with pytest.raises(ParameterError) as error:
        surface_of(**options)
    assert text in str(error.value)
