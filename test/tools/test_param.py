"""``scripts/param`` on a network in another process."""

import math
import re
import threading

import pytest
import rclpy
import yaml
from parts import param
from parts.param import main
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future


def test_get_prints_the_type(output_of):
    assert output_of(main, 'get', '/optimizer', 'codebook.shape') == (
        'Integer values are: [2, 4, 3, 2, 36]\n')
    assert output_of(main, 'get', 'bs', 'policy') == 'String value is: round_robin\n'
    assert output_of(main, 'get', 'bs', 'receiver_noise') == 'Boolean value is: True\n'


def test_list_of_one_node_and_of_all_nodes(output_of):
    names = output_of(main, 'list', '/transmission').splitlines()
    assert names == sorted(names) and '  band' in names
    lines = output_of(main, 'list').splitlines()
    nodes = [line for line in lines if line.startswith('/')]
    assert nodes == sorted(nodes)
    assert {'/bs:', '/user_1:', '/user_2:'} <= set(nodes)
    assert not any('_rhs_isac_cli' in line for line in nodes)


def test_dump_is_a_parameter_file(output_of):
    content = yaml.safe_load(output_of(main, 'dump', 'optimizer'))
    codebook = content['/optimizer']['ros__parameters']['codebook']
    assert codebook['shape'] == [2, 4, 3, 2, 36]
    assert len(codebook['analog']) == 216
    values = yaml.safe_load(output_of(main, 'dump', 'user_1'))['/user_1']['ros__parameters']
    assert values['user_id'] == 1 and values['position_m'] == []


def test_parameters_without_a_value_are_left_out(foreign, output_of):
    """Those of this package have values, but not those of every node."""
    foreign.declare_parameter('gain', Parameter.Type.DOUBLE)
    foreign.declare_parameter('count', 3)
    values = yaml.safe_load(output_of(main, 'dump', 'foreign'))['/foreign']['ros__parameters']
    assert values['count'] == 3 and 'gain' not in values


def test_set_changes_the_parameter_or_prints_the_reason(output_of, call):
    out, err, code = call(main, 'set', 'optimizer', 'codebook.provenance', 'by hand')
    assert (out, code) == ('', 1)
    assert 'codebook.provenance: set without codebook.id' in err
    out, err, code = call(main, 'set', 'bs', 'seed', '1')
    assert (out, code) == ('', 1)
    assert err.startswith('Setting parameter failed: ')
    assert 'read-only' in err
    assert output_of(main, 'set', '/bs', 'policy', 'random') == 'Set parameter successful\n'
    assert output_of(main, 'get', '/bs', 'policy') == 'String value is: random\n'
    out, err, code = call(main, 'set', '/bs', 'policy', 'nonsense')
    assert (out, code) == ('', 1)
    assert err == ("Setting parameter failed: policy: 'nonsense', expected one of round_robin, "
                   'first, random\n')
    assert output_of(main, 'get', '/bs', 'policy') == 'String value is: random\n'
    output_of(main, 'set', '/bs', 'policy', 'round_robin')


TEXTS = ['1e3', 'nan', 'y', 'on', '~', '010', '.5', '0x1F', 'a: b', '', '- 1', 'é', '[1]']


@pytest.fixture
def foreign():
    """A node of another package, which is spun in a thread."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node, executor = Node('foreign', context=context), SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    yield node
    executor.shutdown()
    thread.join()
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_a_node_without_parameter_services_does_not_end_the_list(
        shared_session, foreign, call, monkeypatch):
    """The recorder is such a node."""
    silent = Node('a_silent_node', context=foreign.context, start_parameter_services=False)
    # On a busy machine, discovery pauses for longer than the tool waits for other nodes.
    assert shared_session.spin_until(lambda: {'bs', 'foreign', 'a_silent_node'} <= {
        *shared_session.node.get_node_names()}, 60.0)
    names_of = param._names

    def names(session, node):
        with monkeypatch.context() as patch:
            if node == '/a_silent_node':
                patch.setattr(param, '_SERVICE_TIMEOUT_S', 0.1)
            return names_of(session, node)
    monkeypatch.setattr(param, '_names', names)
    out, err, code = call(main, 'list')
    assert code == 0
    assert '/bs:' in out.splitlines() and '/foreign:' in out.splitlines()
    assert 'parameter services for node /a_silent_node' in err
    assert call(main, 'list', 'a_silent_node')[2] == 1
    silent.destroy_node()


def test_a_dump_has_the_same_values_and_types_for_load_and_for_a_start(
        foreign, output_of, call, tmp_path):
    values = {**{f'text.{n}': text for n, text in enumerate(TEXTS)}, 'texts': TEXTS,
              'small': 1e-5, 'large': 1e20, 'infinite': math.inf, 'numbers': [1e-5, 2.0, -1e300],
              'count': 3, 'counts': [1, 2], 'yes': True, 'flags': [True, False]}
    for name, value in values.items():
        foreign.declare_parameter(name, value)
    path = tmp_path / 'dump.yaml'
    path.write_text(output_of(main, 'dump', 'foreign'), encoding='utf-8')
    # Every node of rclpy has one that is read-only.
    _, err, _ = call(main, 'load', 'foreign', str(path))
    assert re.findall('parameter (.*) failed', err) == ['start_type_description_service']
    for name, value in values.items():
        found = foreign.get_parameter(name).value
        assert (list(found) if isinstance(value, list) else found) == value, name
    context = rclpy.Context()
    rclpy.init(args=['--ros-args', '--params-file', str(path)], context=context)
    other = Node('foreign', context=context, automatically_declare_parameters_from_overrides=True)
    found = {name: other.get_parameter(name).value for name in values}
    other.destroy_node()
    rclpy.shutdown(context=context)
    assert {name: list(value) if isinstance(values[name], list) else value
            for name, value in found.items()} == values


def test_values_are_set_with_the_declared_type(foreign, output_of, call):
    for name, value in (('text', 'a'), ('gain', 0.5), ('gains', [0.5]), ('count', 1)):
        foreign.declare_parameter(name, value)
    for name, text, expected in (
            ('text', '1e3', '1e3'), ('text', 'on', 'on'), ('text', '12', '12'),
            ('gain', '1e-5', 1e-5), ('gain', '3', 3.0), ('gain', '.inf', math.inf),
            ('gains', '[1, 1e-5]', [1.0, 1e-5]), ('count', '7', 7)):
        output_of(main, 'set', 'foreign', name, text)
        value = foreign.get_parameter(name).value
        assert (type(value)(expected) if name != 'gains' else expected) == (
            value if name != 'gains' else list(value)), name
    for name, text in (('gain', 'much'), ('gain', 'true'), ('count', '1.5'), ('count', 'true')):
        assert call(main, 'set', 'foreign', name, text)[2] == 1


def test_load_sets_the_parameters_of_a_dump(output_of, call, tmp_path):
    path = tmp_path / 'dump.yaml'
    path.write_text(output_of(main, 'dump', 'optimizer'), encoding='utf-8')
    out = output_of(main, 'load', 'optimizer', str(path))
    assert 'Set parameter codebook.analog successful\n' in out
    assert 'Set parameter scenario_file successful\n' in out
    path.write_text('/**: {ros__parameters: {policy: round_robin, seed: 9}}', encoding='utf-8')
    out, err, code = call(main, 'load', 'bs', str(path))
    assert (out, code) == ('Set parameter policy successful\n', 1)
    assert 'Set parameter seed failed: ' in err and '1 of 2 parameters not set' in err
    path.write_text('[]', encoding='utf-8')
    out, err, code = call(main, 'load', 'bs', str(path))
    assert (out, code) == ('', 1)
    assert 'expected a parameter file' in err


def test_a_request_is_repeated_until_a_response_arrives(output_of, monkeypatch):
    """DDS may lose a response to a client that it has just discovered."""
    send, lost = AsyncParameterClient.list_parameters, [Future(), Future()]
    monkeypatch.setattr(AsyncParameterClient, 'list_parameters',
                        lambda client: lost.pop() if lost else send(client))
    assert '  policy' in output_of(main, 'list', 'bs').splitlines()


def test_missing_nodes_and_parameters_are_errors(call):
    assert call(main, 'get', 'bs', 'nothing') == ('', 'Parameter not set\n', 1)
    for verb in (['get', 'nobody', 'seed'], ['list', 'nobody'], ['dump', 'nobody'],
                 ['set', 'nobody', 'seed', '1']):
        assert call(main, *verb, '--timeout', '0.1') == ('', 'Node not found\n', 1)
