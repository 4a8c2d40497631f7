"""``scripts/param`` on a network in another process."""

import threading

import rclpy
import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from rhs_isac_ros.tools.param import main


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


def test_parameters_without_a_value_are_left_out(output_of):
    """Those of this package have values, but not those of every node."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node, executor = Node('foreign', context=context), SingleThreadedExecutor(context=context)
    node.declare_parameter('gain', Parameter.Type.DOUBLE)
    node.declare_parameter('count', 3)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        values = yaml.safe_load(output_of(main, 'dump', 'foreign'))['/foreign']['ros__parameters']
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()
        rclpy.shutdown(context=context)
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


def test_missing_nodes_and_parameters_are_errors(call):
    assert call(main, 'get', 'bs', 'nothing') == ('', 'Parameter not set\n', 1)
    for verb in (['get', 'nobody', 'seed'], ['list', 'nobody'], ['dump', 'nobody'],
                 ['set', 'nobody', 'seed', '1']):
        assert call(main, *verb, '--timeout', '0.1') == ('', 'Node not found\n', 1)
