"""Changes of the parameters of a running node."""

import dataclasses
import math

import pytest
import yaml
from rclpy.parameter import Parameter
from ros_messages import parameters

from rhs_isac_ros.calibration import calibrate
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol.events import SettingsOffered
from rhs_isac_ros.ros.parameters import NODES


@pytest.fixture
def make(bench, bench_files, tmp_path, monkeypatch):
    """Return a function that creates a node which only records new settings, in `offered`."""
    def make(executable):
        values = {'scenario_file': str(bench_files / 'scenario.yaml')}
        if executable == 'positioner':
            values['table_folder'] = str(tmp_path)
        if executable == 'fusion':
            values = {'site_file': str(tmp_path / 'site.yaml')}
            scenario = Scenario.from_yaml(bench_files / 'scenario.yaml')
            (tmp_path / 'site.yaml').write_text(yaml.safe_dump({
                'roi_center_m': list(scenario.roi_center_m),
                'roi_size_m': list(scenario.roi_size_m),
                'surfaces': {'front': {'scenario': str(bench_files / 'scenario.yaml'),
                                       'codebook': str(bench_files / 'first.yaml')}}}),
                encoding='utf-8')
        node = bench.add_role(executable, values=values)
        node.offered = []

        def record(event):
            assert isinstance(event, SettingsOffered)
            node.offered.append(event.settings)
        monkeypatch.setattr(node, 'dispatch', record)
        return node
    return make


def set_together(node, **values):
    return node.set_parameters_atomically(parameters(values))


def wrong_values(p):
    """Yield invalid values of a parameter: of another type, out of range, not a choice.

    Each comes with what the error says is expected.
    """
    yield {bool: 'yes', int: 2.5, float: 3, str: 17}[p.kind], p.expected
    if p.kind in (int, float):
        yield p.kind(p.high + 1), p.range
        yield p.kind(p.low - 1), p.range
    if p.kind is float:
        yield math.nan, p.range
    if p.choices:
        yield 'nonsense', p.expected


def test_the_reason_for_a_rejection_contains_the_names_of_unknown_parameters(make):
    node = make('bs')
    before = node.get_parameter('rest_s').value
    result = set_together(node, rest_s=before + 1, reset_s=2.0)
    assert (result.successful, result.reason) == (False, 'reset_s: not a parameter of this node')
    assert node.get_parameter('rest_s').value == before


@pytest.mark.parametrize('executable', [
    name for name, group in NODES.items()
    if name != 'network' and any(parameter.dynamic for parameter in group)])
def test_an_invalid_value_is_rejected_with_a_reason(make, executable):
    node = make(executable)
    for parameter in NODES[executable]:
        if not parameter.dynamic:
            continue
        before = node.get_parameter(parameter.name).value
        for wrong, expected in wrong_values(parameter):
            result = set_together(node, **{parameter.name: wrong})
            assert not result.successful
            assert result.reason.startswith(f'{parameter.name}: {wrong!r}, expected {expected}')
            # The node itself may also set parameters one by one.
            (result,) = node.set_parameters([Parameter(parameter.name, value=wrong)])
            assert not result.successful
        assert not set_together(node, **{parameter.name: None}).successful
        assert node.get_parameter(parameter.name).value == before
    assert node.offered == []


@pytest.mark.parametrize(('executable', 'values', 'reason'), [
    ('bs', {'allowed_users': '3-1'}, "allowed_users: '3-1', expected numbers from 1 to"),
    ('transmission', {'band': 2}, 'band: 2, expected 0 to 0 of the scenario, or -1'),
    ('positioner', {'estimator': 'ml', 'prior': 'track'}, "prior: 'track', expected 'region'"),
    ('positioner', {'estimator': 'neural'}, "model_file: '', expected a trained model"),
    ('positioner', {'estimator_options': 'n=1'},
     "estimator_options: 'n', expected an option of bayes: lazy, "),
    ('positioner', {'estimator': 'neural', 'model_file': '/no/model.npz'},
     'model_file: /no/model.npz: '),
    ('positioner', {'estimator': 'neural', 'estimator_options': 'model_file=/no/model.npz'},
     'model_file: /no/model.npz: '),
    ('positioner', {'calibration_file': '/no/file.npz'}, 'calibration_file: /no/file.npz: '),
    ('transmission', {'calibration_file': '/no/file.npz'}, 'calibration_file: /no/file.npz: '),
])
def test_a_value_that_contradicts_other_parameters_scenario_or_files_is_rejected(
        make, executable, values, reason):
    node = make(executable)
    result = set_together(node, **values)
    assert not result.successful
    assert result.reason.startswith(reason)
    assert node.offered == []


def test_a_calibration_must_belong_to_the_scenario_and_suit_the_estimator(make, tmp_path):
    positioner, transmission = make('positioner'), make('transmission')
    mine, other = str(tmp_path / 'mine.npz'), str(tmp_path / 'other.npz')
    calibrate(positioner.scenario, []).save(mine)
    calibrate(dataclasses.replace(positioner.scenario, refractive_index=2.0), []).save(other)
    for node in (positioner, transmission):
        result = set_together(node, calibration_file=other)
        assert not result.successful
        assert result.reason.startswith(f'calibration_file: {other}: scenario_id: ')
        assert set_together(node, calibration_file=mine).successful
        assert [s.calibration_file for s in node.offered] == [mine]
    result = set_together(positioner, estimator='neural')
    assert not result.successful
    assert result.reason.startswith(f"calibration_file: '{mine}', expected none")


def test_parameters_that_are_set_together_are_offered_together(make):
    node = make('channel')
    assert set_together(node, delay_s=0.5, jitter_s=0.25).successful
    assert set_together(node, loss_probability=0.125).successful
    assert [(s.delay_s, s.jitter_s, s.loss_probability) for s in node.offered] == [
        (0.5, 0.25, 0.0), (0.5, 0.25, 0.125)]


def test_parameters_that_are_set_together_are_accepted_or_rejected_together(make):
    node = make('bs')
    result = set_together(node, policy='first', rest_s=-1.0)
    assert not result.successful
    assert result.reason.startswith('rest_s: -1.0, expected ')
    assert node.get_parameter('policy').value == 'round_robin'
    result = set_together(node, policy='first', seed=3)
    assert not result.successful
    assert 'read-only parameter: seed' in result.reason
    assert set_together(node, rest_s=0.5).successful
    assert [(s.policy, s.rest_s) for s in node.offered] == [('round_robin', 0.5)]


def test_other_parameters_of_a_node_are_ignored(make):
    node = make('bs')
    node.declare_parameter('extra', 1)
    assert set_together(node, extra=2).successful
    assert node.offered == []


def test_parameters_can_be_reverted_to_the_settings_in_use(make):
    node = make('positioner')
    in_use = node.make_settings(node.values)
    assert set_together(node, estimator='ml').successful
    node.revert_parameters(in_use)
    assert node.get_parameter('estimator').value == 'bayes'
    assert [s.estimator for s in node.offered] == ['ml']
    # The next change starts from there; a model file has no effect on this estimator.
    assert set_together(node, model_file='somewhere').successful
    assert node.offered[1:] == [in_use]
    assert node.get_parameter('model_file').value == 'somewhere'
