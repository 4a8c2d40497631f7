"""Declaration, checks and documentation of the parameters."""

import argparse
import dataclasses
import math
import types

import pytest
from rcl_interfaces.msg import ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.user import UserNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.settings import (
    BaseStationSettings,
    FusionSettings,
    Impairments,
    PositionerSettings,
    ReceiverSettings,
    TransmissionSettings,
)
from rhs_isac_ros.ros import parameters
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.fields import ParameterError

PAIRS = [(executable, p) for executable, group in parameters.NODES.items() for p in group]
# Nodes share the declarations of equal names, of which one is tested.
DECLARED = {p.name: (executable, p) for executable, p in PAIRS}
each_parameter = pytest.mark.parametrize(
    ('executable', 'parameter'), DECLARED.values(), ids=DECLARED)
TYPES = {bool: ParameterType.PARAMETER_BOOL, int: ParameterType.PARAMETER_INTEGER,
         float: ParameterType.PARAMETER_DOUBLE, str: ParameterType.PARAMETER_STRING,
         list: ParameterType.PARAMETER_DOUBLE_ARRAY}


@pytest.fixture
def make(module_bench):
    """Return a function that creates a node with initial parameter values."""
    nodes = []

    def make(**values):
        nodes.append(module_bench.add(
            Node, f'probe_{len(nodes)}', values=values, enable_rosout=False,
            start_parameter_services=False))
        return nodes[-1]
    yield make
    for node in nodes:
        module_bench.remove(node)


def value_of(parameter, number):
    return [0.0, float(number)] if isinstance(parameter.default, list) else type(
        parameter.default)(number)


@pytest.mark.parametrize('executable', parameters.NODES)
def test_the_defaults_apply_with_their_types(make, executable):
    values = vars(parameters.declare(make(), executable))
    assert values == {p.name: p.default for p in parameters.NODES[executable]}
    assert [type(values[p.name]) for p in parameters.NODES[executable]] == [
        type(p.default) for p in parameters.NODES[executable]]


@pytest.mark.parametrize('executable', parameters.NODES)
def test_descriptors_match_the_declarations(make, executable):
    node = make()
    parameters.declare(node, executable)
    for p in parameters.NODES[executable]:
        descriptor = node.describe_parameter(p.name)
        assert descriptor.read_only == (not p.dynamic)
        assert descriptor.type == TYPES[type(p.default)]
        assert descriptor.description.startswith(p.text)
        assert f'[{p.unit}]' in descriptor.description or not p.unit
        assert descriptor.additional_constraints == p.expected
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        assert [(r.from_value, r.to_value) for r in ranges] == (
            [(p.low, p.high)] if type(p.default) in (int, float) else [])


def wrong_values(p):
    """Yield invalid values of a parameter, each with what the error says is expected."""
    # `ros2 param set` sends 28e9 as a string.
    others = {bool: ['yes'], str: [17], list: [['1', '2']], int: [2.5, '28e9'],
              float: [3, '28e9']}[type(p.default)]
    yield from ((other, p.expected) for other in (*others, *(('best', '') if p.choices else ())))
    if p.kind in (int, float, list):
        outside = [end + sign * max(1, abs(end) * 1e-6)
                   for end, sign in ((p.low, -1), (p.high, 1))]
        special = [] if p.kind is int else [math.nan, math.inf, -math.inf]
        yield from ((value_of(p, number), p.range) for number in (*outside, *special))


@each_parameter
def test_an_invalid_value_is_rejected(make, executable, parameter):
    for wrong, expected in wrong_values(parameter):
        with pytest.raises(ParameterError) as caught:
            parameters.declare(make(**{parameter.name: wrong}), executable)
        text = str(caught.value)
        assert text.startswith(f'{parameter.name}: ')
        assert str(wrong) in text
        assert 'expected ' in text and expected in text


@each_parameter
def test_the_ends_of_a_range_and_all_choices_are_valid(make, executable, parameter):
    ends = (parameter.low, parameter.high) if parameter.kind in (int, float, list) else ()
    for value in (*(value_of(parameter, end) for end in ends), *parameter.choices):
        values = parameters.declare(make(**{parameter.name: value}), executable)
        assert getattr(values, parameter.name) == value


@pytest.mark.parametrize(('executable', 'parameter'), [
    pair for pair in DECLARED.values() if not pair[1].dynamic])
def test_a_parameter_that_is_not_dynamic_is_read_only(make, executable, parameter):
    node = make()
    parameters.declare(node, executable)
    # A value that would be valid at the start.
    valid = parameter.choices[-1] if parameter.choices else {
        bool: not parameter.default, int: 1, float: parameter.low, str: 'a', list: [1.0]}[
            type(parameter.default)]
    result, = node.set_parameters([Parameter(parameter.name, value=valid)])
    assert not result.successful
    assert 'read-only' in result.reason
    assert node.get_parameter(parameter.name).value == parameter.default


SETTINGS = {'bs': BaseStationSettings, 'channel': Impairments, 'positioner': PositionerSettings,
            'transmission': TransmissionSettings, 'receiver': ReceiverSettings,
            'fusion': FusionSettings}


def test_the_dynamic_parameters_are_the_settings_of_the_roles():
    assert {(executable, p.name) for executable, p in PAIRS if p.dynamic} == {
        (executable, field.name) for executable, settings in SETTINGS.items()
        for field in dataclasses.fields(settings)} - {('bs', 'step_timeout_s')}
    # The node passes all of them on, with the same values.
    for executable, settings in SETTINGS.items():
        values = types.SimpleNamespace(**{p.name: p.default for p in parameters.NODES[executable]})
        assert parameters.settings_of(settings, values) == settings()


def test_nodes_share_declarations_of_equal_names():
    shared = {}
    for _, p in PAIRS:
        assert shared.setdefault(p.name, p) == p


@pytest.mark.parametrize(('values', 'text'), [
    ({'position_m': [10.0, 0.0]}, r'position_m: 2 numbers, expected three'),
    ({'position_m': [10.0, 0.0, 0.0] * 2}, r'position_m: 2 points, expected one'),
    ({'position_m': [-4.9, 0.0, 0.0]}, r'position_m: \[\[-4.9, 0.0, 0.0\]\], expected .* front'),
    ({'mobility': 'waypoints'}, r'waypoints_m: empty, expected x, y, z'),
    ({'mobility': 'waypoints', 'waypoints_m': [10.0]}, r'waypoints_m: 1 numbers'),
    ({'mobility': 'waypoints', 'waypoints_m': [10.0, 0.0, 0.0, 0.0, 6.0, 0.0]},
     r'waypoints_m: .* x > 0'),
    ({'user_id': 4096, 'user_count': 2}, 'user_count: 2, expected at most 1 with user_id 4096'),
    ({'user_count': 2, 'position_m': [9.0, 1.0, -0.5]},
     'position_m: 1 points, expected 2, one for each user, or none'),
    ({'user_count': 2, 'mobility': 'waypoints', 'waypoints_m': [9.0, 1.0, -0.5]},
     'user_count: 2, expected 1 with mobility waypoints'),
    ({'mobility': 'random_walk', 'speed_mps': 5.6},
     r'speed_mps: 5.6, expected at most max_user_speed_mps = 5.55'),
])
def test_values_of_a_user_that_contradict_the_scenario_are_rejected(bench, values, text):
    with pytest.raises(ParameterError, match=text):
        bench.add(UserNode, values=values)


@pytest.mark.parametrize(('values', 'position'), [
    ({'position_m': [9.0, 1.0, -0.5]}, (9.0, 1.0, -0.5)),
    ({'mobility': 'random_walk', 'position_m': [9.0, 1.0, -0.5], 'speed_mps': 0.0},
     (9.0, 1.0, -0.5)),
    ({'mobility': 'waypoints', 'waypoints_m': [5.0, 5.0, 1.0]}, (5.0, 5.0, 1.0)),
    # Outside of the region of interest.
    ({'position_m': [20.0, -6.0, 1.1]}, (20.0, -6.0, 1.1)),
])
def test_the_parameters_of_a_user_set_its_initial_position(bench, values, position):
    bench.add(UserNode, values=values)
    truths = bench.collect(bench.add(Node, 'probe'), m.GroundTruth)
    bench.until(lambda: truths, 'the true position')
    assert truths[0].position == pytest.approx(position, abs=1e-12)
    assert truths[0].user == 1


def test_the_users_of_a_node_have_consecutive_ids_and_one_message_for_all_positions(bench):
    places = [[9.0, 1.0, -0.5], [8.0, 0.0, 0.5]]
    bench.add(UserNode, values={
        'user_id': 7, 'user_count': 2, 'position_m': [*places[0], *places[1]]})
    probe = bench.add(Node, 'probe')
    each, several = bench.collect(probe, m.GroundTruth), bench.collect(probe, m.GroundTruths)
    bench.until(lambda: several, 'the true positions')
    assert [(truth.user, truth.position.tolist()) for truth in several[0].each()] == [
        (7, places[0]), (8, places[1])]
    assert not each


def test_the_users_of_a_node_walk_as_they_would_alone(bench):
    walk = {'mobility': 'random_walk', 'speed_mps': 0.0, 'seed': 3}
    bench.add(UserNode, 'users', values=walk | {'user_count': 2})
    bench.add(UserNode, 'alone', values=walk | {'user_id': 2})
    probe = bench.add(Node, 'probe')
    alone, several = bench.collect(probe, m.GroundTruth), bench.collect(probe, m.GroundTruths)
    bench.until(lambda: several and alone, 'the true positions')
    assert several[0].position[1].tolist() == alone[0].position.tolist()


def test_a_user_without_a_position_starts_in_the_region(bench):
    bench.add(UserNode)
    bench.add(UserNode, 'second', values={'user_id': 2})
    truths = bench.collect(bench.add(Node, 'probe'), m.GroundTruth)
    bench.until(lambda: {truth.user for truth in truths} == {1, 2}, 'both true positions')
    low, high = Scenario().roi_bounds_m
    assert all(((low <= truth.position) & (truth.position <= high)).all() for truth in truths)
    first, second = ({tuple(t.position) for t in truths if t.user == user} for user in (1, 2))
    assert len(first) == len(second) == 1
    assert first != second


MOBILITIES = '''
import numpy as np

class Climb:
    def __init__(self, scenario, speed_mps, rng, start):
        self._velocity = np.array([0.0, 0.0, speed_mps])
        self._start = np.array(scenario.roi_center_m) if start is None else np.array(start)

    def state(self, now_s):
        return self._start, self._velocity

def nothing(scenario, speed_mps, rng, start):
    return None
'''


@pytest.mark.parametrize(('position', 'place'), [
    ({}, (10, 0, 0)), ({'position_m': [9.0, 1.0, -0.5]}, (9.0, 1.0, -0.5))])
def test_a_plug_in_moves_the_user(bench, install, position, place):
    install('moves', MOBILITIES, {plugins.MOBILITIES: {'climb': 'Climb'}})
    bench.add(UserNode, values={'mobility': 'climb', 'speed_mps': 0.5, **position})
    truths = bench.collect(bench.add(Node, 'probe'), m.GroundTruth)
    bench.until(lambda: truths, 'the true position')
    assert tuple(truths[0].position) == tuple(place)
    assert tuple(truths[0].velocity) == (0.0, 0.0, 0.5)


@pytest.mark.parametrize(('name', 'words'), [
    ('fly', "mobility: 'fly', expected one of static, waypoints, random_walk, odometry, tf or a "
            'plug-in of '
            'rhs_isac_ros.mobilities; installed: (.*, )?climb, (.*, )?nothing'),
    ('nothing', 'mobility: entry point .*: nothing = moves:nothing of moves: returned None'),
])
def test_an_invalid_mobility_is_rejected(bench, install, name, words):
    install('moves', MOBILITIES, {plugins.MOBILITIES: {'climb': 'Climb', 'nothing': 'nothing'}})
    with pytest.raises(ParameterError, match=words):
        bench.add(UserNode, values={'mobility': name})


@pytest.mark.parametrize('words', [
    ['--ros-args', '-p', 'policy:=random', '-p', 'use_sim_time:=true'],
    ['--ros-args', '-p', 'bs_2:polcy:=random'],
    ['-p', 'polcy:=random', '--ros-args', '-r', 'polcy:=b', '--', '-p', 'polcy:=random'],
], ids=['own parameters', 'of a single node', 'outside of the ROS arguments'])
def test_other_arguments_are_accepted(words):
    parameters.check_arguments(argparse.ArgumentParser(), 'bs', words)


def test_only_the_optimizer_describes_the_parameters_of_a_codebook():
    lines = {name: parameters.parameter_help(name).splitlines()
             for name in ('optimizer', 'bs', 'network')}
    for parameter in parameters.CODEBOOK:
        assert f'  {parameter}' in lines['optimizer']
        assert f'  {parameter}' not in lines['bs'] + lines['network']
