"""Parameters that change while a node runs."""

import math

import pytest
from rclpy.parameter import Parameter

from rhs_isac_ros.nodes.bs import BsNode
from rhs_isac_ros.nodes.channel import ChannelNode
from rhs_isac_ros.nodes.positioner import PositionerNode
from rhs_isac_ros.nodes.transmission import TransmissionNode
from rhs_isac_ros.protocol.events import SettingsOffered
from rhs_isac_ros.ros.parameters import NODES

KINDS = {'bs': BsNode, 'channel': ChannelNode, 'positioner': PositionerNode,
         'transmission': TransmissionNode}
HOT = [(executable, p) for executable, group in NODES.items() for p in group if p.dynamic]


@pytest.fixture
def make(bench, small_files, tmp_path, monkeypatch):
    """Function that makes a node, whose role only notes what it is offered in `offers`."""
    def make(executable):
        values = {'scenario_file': str(small_files / 'scenario.yaml')}
        if executable == 'positioner':
            values['table_folder'] = str(tmp_path)
        node = bench.add(KINDS[executable], parameter_overrides=[
            Parameter(name, value=value) for name, value in values.items()])
        node.offers = []

        def note(event):
            assert isinstance(event, SettingsOffered)
            node.offers.append(event.settings)
        monkeypatch.setattr(node, 'dispatch', note)
        return node
    return make


def put(node, **values):
    return node.set_parameters_atomically(
        [Parameter(name, value=value) for name, value in values.items()])


def wrong_values(p):
    """Values that a parameter may not have: of another type, out of range, no choice."""
    yield {bool: 'yes', int: 2.5, float: 3, str: 17}[type(p.default)]
    if p.low is not None:
        yield type(p.default)(p.high + 1)
        yield type(p.default)(p.low - 1)
    if isinstance(p.default, float):
        yield math.nan
    if p.choices:
        yield 'nonsense'


@pytest.mark.parametrize(('executable', 'parameter'), HOT,
                         ids=[f'{executable}-{p.name}' for executable, p in HOT])
def test_what_was_not_declared_is_refused_with_a_reason(make, executable, parameter):
    node = make(executable)
    before = node.get_parameter(parameter.name).value
    for wrong in wrong_values(parameter):
        result = put(node, **{parameter.name: wrong})
        assert not result.successful
        assert result.reason.startswith(
            f'{parameter.name}: {wrong!r}, expected {parameter.expected}')
        # The other way to set one, from within the process.
        (result,) = node.set_parameters([Parameter(parameter.name, value=wrong)])
        assert not result.successful
    assert not put(node, **{parameter.name: None}).successful
    assert node.get_parameter(parameter.name).value == before
    assert node.offers == []


@pytest.mark.parametrize(('executable', 'values', 'reason'), [
    ('bs', {'allowed_users': '3-1'}, "allowed_users: '3-1', expected numbers from 1 to"),
    ('transmission', {'band': 2}, 'band: 2, expected 0 to 0 of the scenario, or -1'),
    ('positioner', {'estimator': 'neural'}, "model_file: '', expected a trained model"),
    ('positioner', {'estimator': 'neural', 'model_file': '/no/model.npz'},
     'model_file: /no/model.npz: '),
])
def test_what_contradicts_scenario_files_or_other_parameters_is_refused(
        make, executable, values, reason):
    node = make(executable)
    result = put(node, **values)
    assert not result.successful
    assert result.reason.startswith(reason)
    assert node.offers == []


def test_what_is_set_together_is_offered_together(make):
    node = make('channel')
    assert put(node, delay_s=0.5, jitter_s=0.25).successful
    assert put(node, loss_probability=0.125).successful
    assert [(s.delay_s, s.jitter_s, s.loss_probability) for s in node.offers] == [
        (0.5, 0.25, 0.0), (0.5, 0.25, 0.125)]


def test_of_what_is_set_together_all_is_refused_or_nothing(make):
    node = make('bs')
    result = put(node, policy='first', rest_s=-1.0)
    assert not result.successful
    assert result.reason.startswith('rest_s: -1.0, expected ')
    assert node.get_parameter('policy').value == 'round_robin'
    result = put(node, policy='first', seed=3)
    assert not result.successful
    assert 'read-only parameter: seed' in result.reason
    assert put(node, rest_s=0.5).successful
    assert [(s.policy, s.rest_s) for s in node.offers] == [('round_robin', 0.5)]


def test_other_parameters_of_a_node_are_none_of_its_business(make):
    node = make('bs')
    node.declare_parameter('extra', 1)
    assert put(node, extra=2).successful
    assert node.offers == []


def test_what_is_in_use_can_be_restored_even_if_it_would_be_refused(make):
    node = make('positioner')
    in_use = node.settings(node.values)
    assert put(node, estimator='ml').successful
    node.restore(in_use)
    assert node.get_parameter('estimator').value == 'bayes'
    assert [s.estimator for s in node.offers] == ['ml']
    # The next change is of what was restored; a model that nothing needs changes nothing.
    assert put(node, model_file='somewhere').successful
    assert node.offers[1:] == [in_use]
    assert node.get_parameter('model_file').value == 'somewhere'
