"""The node that holds the codebook as its parameters."""

import dataclasses
import math
import re

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from ros_messages import codebook_from_ros, parameters

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.optimizer import OptimizerNode
from rhs_isac_ros.ros.endpoints import LATCHED

TYPES = {
    'codebook.id': Parameter.Type.STRING,
    'codebook.shape': Parameter.Type.INTEGER_ARRAY,
    'codebook.analog': Parameter.Type.DOUBLE_ARRAY,
    'codebook.digital_re': Parameter.Type.DOUBLE_ARRAY,
    'codebook.digital_im': Parameter.Type.DOUBLE_ARRAY,
    'codebook.average_crlb': Parameter.Type.DOUBLE,
}


@pytest.fixture
def optimizer(bench):
    return bench.add(OptimizerNode)


@pytest.fixture
def client(bench, probe, optimizer):
    client = AsyncParameterClient(probe, 'optimizer')
    bench.until(client.services_are_ready, 'the parameter services')
    return client


@pytest.fixture(scope='session')
def other(random_beams):
    """Another codebook for Table I."""
    return random_beams(Scenario(), np.random.default_rng(5))


def latched(bench, node):
    received = []
    node.create_subscription(ros.Codebook, 'codebook', received.append, LATCHED)
    bench.until(lambda: received, 'the latched codebook')
    return received


def as_parameters(codebook, **changes):
    return parameters(
        codebook.to_parameters() | {f'codebook.{k}': v for k, v in changes.items()})


def held(optimizer):
    return Codebook.from_parameters(
        {p.name: p.value for p in optimizer.get_parameters_by_prefix('').values()})


def test_the_codebook_is_in_the_parameter_services(bench, client, shipped):
    listed = bench.result(client.list_parameters(['codebook'], 1)).result.names
    assert {*TYPES, 'codebook.provenance'} == set(listed)
    answer = bench.result(client.get_parameters(list(TYPES))).values
    assert [value.type for value in answer] == [kind.value for kind in TYPES.values()]
    values = {name: Parameter.from_parameter_msg(ParameterMessage(name=name, value=value)).value
              for name, value in zip(TYPES, answer, strict=True)}
    codebook = Codebook.from_parameters(values)
    assert values['codebook.id'] == codebook.id == shipped.id
    assert tuple(values['codebook.shape']) == (2, 8, 4, 3, 100)
    assert codebook.average_crlb_m2 == shipped.average_crlb_m2 > 0
    for descriptor in bench.result(client.describe_parameters(list(TYPES))).descriptors:
        assert descriptor.description
        assert not descriptor.read_only


# A client that sets the arrays need not compute the hash.
@pytest.mark.parametrize('changes', [{}, {'id': ''}], ids=['complete', 'without an id'])
def test_a_change_is_accepted_and_published(bench, optimizer, client, probe, other, changes):
    received = latched(bench, probe)
    answer = bench.result(client.set_parameters_atomically(as_parameters(other, **changes)))
    assert answer.result.successful, answer.result.reason
    assert optimizer.get_parameter('codebook.id').value == held(optimizer).id == other.id
    bench.until(lambda: len(received) == 2, 'the new codebook')
    assert codebook_from_ros(received[1]).id == other.id
    assert math.isnan(received[1].average_crlb_m2)
    late, = latched(bench, bench.add(Node, 'late'))
    assert late.codebook_id == other.id


# `Codebook` finds further errors, which test/codebook covers.
WRONG_SETS = {
    'no values': ({'digital_im': Parameter.Type.DOUBLE_ARRAY}, 'codebook.digital_im'),
    'wrong id': ({'id': 'deadbeefdeadbeef'}, "codebook.id: 'deadbeefdeadbeef', expected"),
    'another scenario': (
        {'shape': [1, 8, 4, 3, 100], 'analog': [0.5] * 400, 'digital_re': [0.001] * 96,
         'digital_im': [0.0] * 96, 'id': ''},
        r'analog: shape \(1, 4, 100\), expected \[N_B, F, N_E\] = \(2, 4, 100\)')}


@pytest.mark.parametrize('name', WRONG_SETS)
def test_a_change_to_an_invalid_codebook_is_rejected_as_a_whole(
        bench, optimizer, client, probe, shipped, other, name):
    received = latched(bench, probe)
    changes, text = WRONG_SETS[name]
    wrong = [Parameter(f'codebook.{k}', value=v) if isinstance(v, list | str) else
             Parameter(f'codebook.{k}', v, []) for k, v in changes.items()]
    whole = [p for p in as_parameters(shipped) if p.name not in {p.name for p in wrong}] + wrong
    result = bench.result(client.set_parameters_atomically(whole)).result
    assert not result.successful
    assert re.search(text, result.reason), result.reason
    assert bench.result(client.set_parameters(whole)).results == [result] * 7
    # No parameter is accepted alone either: the node keeps its codebook.
    for parameter in wrong:
        result, = bench.result(client.set_parameters([parameter])).results
        assert not result.successful
        assert result.reason
    assert held(optimizer).id == shipped.id
    bench.result(client.set_parameters_atomically(as_parameters(other)))
    bench.until(lambda: received[-1].codebook_id == other.id, 'the next good codebook')
    assert {message.codebook_id for message in received} == {shipped.id, other.id}


def test_a_value_of_another_type_is_rejected(bench, optimizer, client, shipped):
    for name, value in shipped.to_parameters().items():
        for wrong in (Parameter(name, value=True), Parameter(name, Parameter.Type.NOT_SET)):
            result, = bench.result(client.set_parameters([wrong])).results
            assert not result.successful
            assert result.reason
        assert optimizer.get_parameter(name).value == pytest.approx(value, nan_ok=True)


@pytest.mark.parametrize('namespace', ['/', '/hall/east'])
def test_a_codebook_file_is_a_parameter_file(bench, other, tmp_path, shipped, namespace):
    path = tmp_path / 'other.yaml'
    other.save(path)
    for file, codebook in ((path, other), (default_codebook_file(), shipped)):
        node = bench.add(
            OptimizerNode, namespace=namespace,
            cli_args=['--ros-args', '--params-file', str(file)], use_global_arguments=False)
        assert held(node).id == codebook.id
        assert node.get_parameter('codebook.id').value == codebook.id
        bench.remove(node)


@pytest.mark.parametrize('changes', [
    {'average_crlb_m2': 0.2, 'provenance': 'a test'}, {'provenance': 'a: {test}'}])
def test_a_codebook_file_can_be_loaded_at_run_time(
        bench, optimizer, client, other, tmp_path, changes):
    """``ros2 param load`` sends the values as text, where NaN and 1e-05 become strings."""
    path = tmp_path / 'other.yaml'
    analog = other.analog.copy()
    analog[0, 0, :2] = 1e-5, 1.0
    new = dataclasses.replace(other, analog=analog, **changes)
    new.save(path)
    response = bench.result(client.load_parameter_file(str(path), use_wildcard=True))
    assert [result.successful for result in response.results] == [True] * 7, response
    assert held(optimizer).id == new.id
    assert held(optimizer).average_crlb_m2 == pytest.approx(new.average_crlb_m2, nan_ok=True)
    assert held(optimizer).provenance == new.provenance


def test_a_part_of_a_codebook_is_refused_with_the_names_of_what_is_missing(
        bench, optimizer, client, shipped):
    average, provenance = (Parameter('codebook.average_crlb', value=1.0),
                           Parameter('codebook.provenance', value='by hand'))
    alone, = bench.result(client.set_parameters([average])).results
    assert not alone.successful
    assert alone.reason == (
        'codebook.average_crlb: set without codebook.id, codebook.shape, codebook.provenance, '
        'codebook.analog, codebook.digital_re, codebook.digital_im, expected the whole codebook '
        'in one request')
    two = bench.result(client.set_parameters([average, provenance])).results
    assert 'codebook.average_crlb, codebook.provenance: set without' in two[0].reason
    assert two[0] == two[1]
    assert held(optimizer).average_crlb_m2 == shipped.average_crlb_m2


def test_the_other_parameters_of_a_request_are_set_one_by_one(bench, optimizer, client, other):
    request = [Parameter('scenario_file', value='/x'), *as_parameters(other),
               Parameter('codebook_file', value=''), Parameter('nothing', value=1)]
    results = bench.result(client.set_parameters(request)).results
    assert [result.successful for result in results] == [False, *[True] * 8, False]
    assert held(optimizer).id == other.id
    undeclared = [*as_parameters(other), Parameter('codebook.name', value='x')]
    results = bench.result(client.set_parameters(undeclared)).results
    assert not any(result.successful for result in results)


def test_a_file_of_an_earlier_version_is_converted_at_the_start(bench, other, tmp_path):
    path = tmp_path / 'other.yaml'
    dataclasses.replace(other, provenance='old').save(path)
    text = path.read_text(encoding='utf-8').replace('provenance: old', "provenance: '{seed: 0}'")
    path.write_text(re.sub('^ *id: .*\n', '', text, flags=re.MULTILINE), encoding='utf-8')
    node = bench.add(
        OptimizerNode, use_global_arguments=False,
        cli_args=['--ros-args', '--params-file', str(path), '-p', 'codebook.id:=""'])
    assert node.get_parameter('codebook.provenance').value == 'seed=0'
    assert node.get_parameter('codebook.id').value == other.id
