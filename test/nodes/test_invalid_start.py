"""An error at the start ends an executable with one clear line and exit code 2."""

import gc
import importlib
from pathlib import Path

import pytest
import yaml
from rclpy.node import Node

from rhs_isac_ros.ros import run
from rhs_isac_ros.ros.parameters import NODES

CONFIG = Path(__file__).parents[2] / 'config'

CASES = {
    'type': ('bs', {'seed': 'abc'}, ['seed', "'abc'", 'expected an integer']),
    'no decimal point': ('bs', {'rest_s': 1}, ['rest_s', "'1'", 'a decimal point']),
    'NaN': ('bs', {'step_timeout_s': '.nan'}, ['step_timeout_s', 'nan', '0.01 to 60 s']),
    'estimator': ('positioner', {'estimator': 'magic'}, ['estimator', "'magic'", 'bayes']),
    'no model file': ('positioner', {'estimator': 'neural', 'model_file': 'short.yaml'},
                      ['model_file', 'short.yaml: cannot be read']),
    'no scenario file': ('channel', {'scenario_file': '/no/such.yaml'}, ['/no/such.yaml']),
    'unknown key': ('rhs_controller', {'scenario_file': 'unknown_key.yaml'},
                    ['unknown_key.yaml', 'n_feed:', 'n_feeds']),
    'no YAML': ('optimizer', {'scenario_file': 'broken.yaml'}, ['broken.yaml', 'cannot be read']),
    'library in a site': (
        'bs', ['-r', '__ns:=/front', '-p', f'site_file:={CONFIG}/site.yaml',
               '-p', f'library_file:={CONFIG}/library_bandplan.npz'],
        ['library_file: ', 'library_bandplan.npz', 'expected none in a site']),
    'band': ('transmission', {'band': 2}, ['band', '2', '0 to 1']),
    'position': ('user', {'position_m': [-2.0, 0.0, 0.0]},
                 ['position_m', '[-2.0, 0.0, 0.0]', 'in front of the surface']),
    'list of integers': ('user', {'position_m': [10, 0, 0]}, ['position_m', 'decimal point']),
    'mixed list': ('user', {'position_m': '[10, 0.0, 0.0]'}, ['position_m']),
    'codebook file': ('optimizer', {'codebook_file': 'short.yaml'},
                      ['short.yaml', 'codebook.analog', '799 values', '800']),
    'library': ('bs', {'library_file': 'short.yaml'}, ['library_file', 'short.yaml', 'cannot be']),
    'library of another scenario': (
        'positioner', {'library_file': str(CONFIG / 'library_bandplan.npz')},
        ['library_file: scenario: sc043027b08ab600bf, expected sc']),
    'another scenario': ('optimizer', {'scenario_file': 'one_feed.yaml'},
                         ['config/codebook.yaml', 'one_feed.yaml', 'digital', '(2, 8, 4, 3)',
                          '(2, 8, 4, 1)', 'set codebook_file (codebook:= of a launch)']),
    'codebook parameter': ('optimizer', {'codebook.id': 'deadbeefdeadbeef'},
                           ['codebook.id', "'deadbeefdeadbeef'"]),
    'allowed users': ('bs', {'allowed_users': '7, 5-3'}, ['allowed_users', "'5-3'", '10-20']),
    'unknown parameter': ('user', {'user_di': 2}, [
        'user_di: unknown parameter (the closest is user_id); see user --help']),
    'unknown to a composed node': ('network', {'rest': 2.0}, ['rest: unknown', 'rest_s']),
    'of another node': ('user', {'policy': 'random'},
                        ['argument -p: policy is a parameter of bs, expected one of user']),
    'of the optimizer': ('bs', ['--param', 'codebook.id:=x'], ['codebook.id']),
    'of several nodes': ('optimizer', {'seed': 1}, [
        'seed is a parameter of bs, channel, fusion, receiver, user,']),
    'topic': ('user', {'mobility': 'odometry', 'odometry_topic': '/robot-1/odom'},
              ['odometry_topic: ', "'/robot-1/odom'"]),
    'empty topic': ('user', {'mobility': 'odometry', 'odometry_topic': "''"},
                    ["odometry_topic: ''"]),
    'topic with an unknown substitution': (
        'user', {'mobility': 'odometry', 'odometry_topic': '"{robot}/odom"'},
        ['odometry_topic: ', '{robot}']),
    'frame': ('positioner', {'frame_id': '/map'}, ["frame_id: '/map', expected the name"]),
    'node name': ('user', ['-r', '__node:=robot-1'], ['__node:=robot-1']),
    'one name for all nodes': ('network', ['-r', '__node:=rhs'],
                               ['argument -r: 9 nodes are renamed to /rhs', 'NAME:__node:=']),
    'one name in another notation': ('network', ['--remap', '__name:=rhs'],
                                     ['argument -r: 9 nodes are renamed']),
    'one name for two nodes': ('network', ['-r', 'bs:__node:=channel'],
                               ['-r: 2 nodes', '/channel']),
    'relative namespace': ('user', ['-r', '__ns:=robot'], ['__ns:=robot']),
    'log level': ('bs', ['--log-level', 'loud'], ['--log-level loud']),
    'enclave': ('bs', ['--enclave', 'robot-1'], ['nclave name']),
    'not UTF-8': ('bs', ['-p', 'scenario_file:=\udcff.yaml'], ["\\udcff.yaml'", 'expected UTF-8']),
    'file not in UTF-8': ('bs', ['--params-file', 'latin.yaml'], ['latin.yaml']),
    'scenario not in UTF-8': ('bs', {'scenario_file': 'latin.yaml'}, ['latin.yaml: cannot be']),
    'override of reliability': (
        'positioner', {'qos_overrides./position.publisher.reliability': 'best_efort'},
        ['qos_overrides./position.publisher.reliability', "'best_efort'", 'best_effort']),
    'override of depth': ('visualizer', {'qos_overrides./markers.publisher.depth': -1},
                          ['qos_overrides./markers.publisher.depth: -1', '0 to 2147483647']),
    # Such a topic is created when its user appears.
    'override of a later topic': (
        'network', {'qos_overrides./users/user_1/pose.publisher.history': 'keep_lats'},
        ['user_1/pose.publisher.history', "'keep_lats'", 'keep_last']),
    'override without a topic': (
        'user', {'qos_overrides.odom.subscription.depth': 3}, ['qos_overrides./TOPIC.']),
    'override of an unknown policy': (
        'user', {'qos_overrides./odom.subscription.dept': 3}, ['subscription.dept: invalid name']),
    'no parameter file': ('bs', ['--params-file', '/no/parameters.yaml'],
                          ['/no/parameters.yaml']),
}


@pytest.fixture(scope='module')
def files(shipped, tmp_path_factory):
    folder = tmp_path_factory.mktemp('files')
    (folder / 'unknown_key.yaml').write_text('n_feed: 3')
    (folder / 'one_feed.yaml').write_text('n_feeds: 1')
    (folder / 'unknown.yaml').write_text('/**/bs:\n  ros__parameters: {polcy: random}\n')
    # Parameters of other nodes, of rclpy, and of nodes with another name.
    (folder / 'shared.yaml').write_text(
        '/**:\n  ros__parameters: {seed: 3, policy: random, use_sim_time: false,\n'
        '    start_type_description_service: true,\n'
        '    qos_overrides: {/beacon: {publisher: {depth: 3, reliability: BEST_EFFORT}},\n'
        '      /tf: {publisher: {durability: volatile}}}}\n'
        'another_node:\n  ros__parameters: {anything: 1}\n')
    (folder / 'latin.yaml').write_bytes(b'/**:\n  ros__parameters: {frame_id: "caf\xe9"}\n')
    (folder / 'broken.yaml').write_text('n_feeds: [\nn_frames: }\n')
    shipped.save(folder / 'good.yaml')
    first = repr(float(shipped.analog.flat[0]))
    text = (folder / 'good.yaml').read_text()
    assert text.count(f'[{first},') == 1
    (folder / 'short.yaml').write_text(text.replace(f'[{first},', '['))
    return folder


def arguments(name, files):
    given = CASES[name][1]
    if isinstance(given, list):
        return [str(files / word) if (files / word).is_file() else word for word in given]
    words = []
    for key, value in given.items():
        in_folder = str(value).endswith('.yaml') and not str(value).startswith('/')
        words += ['-p', f'{key}:={files / value if in_folder else value}']
    return words


def existing_nodes():
    gc.collect()
    return {id(node) for node in gc.get_objects() if isinstance(node, Node)}


@pytest.fixture(scope='module', autouse=True)
def no_node_is_left():
    """Collect the nodes that were created before an error.

    The end of the process would destroy them. Here they would take part in later tests.
    """
    before = existing_nodes()
    yield
    assert existing_nodes() <= before


@pytest.fixture
def never_spins(monkeypatch):
    """Raise where a start succeeds."""
    def refuse():
        raise AssertionError('the executable starts')
    monkeypatch.setattr(run, 'EventsExecutor', refuse)


@pytest.mark.parametrize('name', CASES)
def test_an_invalid_start_prints_one_line_and_exits_with_code_2(
        name, files, never_spins, crashed, capfd):
    executable = importlib.import_module(f'rhs_isac_ros.nodes.{CASES[name][0]}')
    try:
        code = executable.main(['--ros-args', *arguments(name, files)])
    except SystemExit as exit:
        code = exit.code
    log = capfd.readouterr().err
    assert code == 2, log
    assert not crashed(log), log
    # The log lines of ROS begin with a severity.
    (line,) = [line for line in log.splitlines() if not line.startswith('[')]
    assert line.startswith(f'{CASES[name][0]}: error: ')
    for word in CASES[name][2]:
        assert word in line


@pytest.mark.parametrize('executable', ['user', 'bs', 'optimizer'])
def test_a_file_with_the_parameters_of_several_nodes_is_valid(executable, files, never_spins):
    with pytest.raises(AssertionError, match='the executable starts'):
        importlib.import_module(f'rhs_isac_ros.nodes.{executable}').main(
            ['--ros-args', '--params-file', str(files / 'shared.yaml')])


# With the name of the node, which selects a section of the file.
@pytest.mark.parametrize(('executable', 'name'), [
    *((name, name) for name in ('bs', 'positioner', 'channel', 'visualizer', 'network')),
    ('user', 'user_1'), ('user', 'user_2')])
def test_the_file_to_copy_is_valid(executable, name, never_spins, capfd):
    with pytest.raises(AssertionError, match='the executable starts'):
        importlib.import_module(f'rhs_isac_ros.nodes.{executable}').main(
            ['--ros-args', '--params-file', str(CONFIG / 'parameters.yaml'),
             *(['-r', f'__node:={name}'] if executable == 'user' else [])])
    assert 'WARN' not in capfd.readouterr().err


def test_the_file_to_copy_contains_known_parameters_at_their_defaults():
    sections = yaml.safe_load((CONFIG / 'parameters.yaml').read_text(encoding='utf-8'))
    for section, content in sections.items():
        # Users have the names user_<n>.
        owner = section.removeprefix('/**').lstrip('/').partition('_')[0] or 'positioner'
        declared = {parameter.name: parameter.default for parameter in NODES[owner]}
        for name, value in content['ros__parameters'].items():
            # The users of the file move.
            assert value == declared[name] or name == 'mobility'


def test_a_foreign_entry_of_a_file_is_ignored_with_a_warning(files, never_spins, capfd):
    with pytest.raises(AssertionError, match='the executable starts'):
        importlib.import_module('rhs_isac_ros.nodes.bs').main(
            ['--ros-args', '--params-file', str(files / 'unknown.yaml')])
    warning, = (line for line in capfd.readouterr().err.splitlines() if 'WARN' in line)
    assert 'unknown parameters are ignored: polcy (the closest is policy)' in warning
