"""The launch files: their arguments, the service of all users, and a clean end."""

import ast
import contextlib
import functools
import importlib.util
import itertools
import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.ros.roster import FOLLOWING, UNIQUE

ROOT = Path(__file__).parents[1]
FILES = ('network.launch.py', 'network.launch.xml', 'site.launch.py')
TIMEOUT_S = 120.0
# mcap has no rosdep key.
RECORDS = importlib.util.find_spec('mcap') is not None
# A short form of `ros2 launch --noninteractive`, which passes SIGINT on to the processes.
LAUNCH = '''
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource

arguments = [tuple(argument.split(':=')) for argument in sys.argv[2:]]
service = LaunchService(argv=sys.argv[2:], noninteractive=True)
service.include_launch_description(LaunchDescription([
    IncludeLaunchDescription(AnyLaunchDescriptionSource(sys.argv[1]),
                             launch_arguments=arguments)]))
sys.exit(service.run())
'''
# The parsers of launch and of type supports use deprecated modules.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")
needs_launch = pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ('launch', 'launch_ros', 'launch_xml'))),
    reason='launch_ros is not installed: it is part of a full ROS 2, not a wheel')


def load_python_file():
    spec = importlib.util.spec_from_file_location(
        'network_launch', ROOT / 'launch' / 'network.launch.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def started(**values):
    """Entities that the Python file starts, by executable or class, for values of arguments."""
    from launch_ros.actions import Node

    from launch import LaunchContext
    module, context = load_python_file(), LaunchContext()
    context.launch_configurations.update(
        {name: default for name, (default, _) in module.ARGUMENTS.items()} | values)
    return [(entity.node_executable if isinstance(entity, Node) else type(entity).__name__, entity)
            for entity in module.start_nodes(context)]


def test_the_files_are_installed_and_their_dependencies_declared():
    packages = pytest.importorskip('ament_index_python.packages')
    share = Path(packages.get_package_share_directory('rhs_isac_ros'))
    assert {path.name for path in (share / 'launch').iterdir()} >= set(FILES)
    depends = {element.text for element in
               ElementTree.parse(ROOT / 'package.xml').getroot().iter('exec_depend')}
    assert {'launch', 'launch_ros', 'launch_xml'} <= depends


def test_the_python_file_uses_all_arguments():
    text = (ROOT / 'launch' / 'network.launch.py').read_text(encoding='utf-8')
    (arguments,) = [node.value for node in ast.parse(text).body if isinstance(node, ast.Assign)
                    and getattr(node.targets[0], 'id', '') == 'ARGUMENTS']
    unused = [name for name in ast.literal_eval(arguments)
              if f"given['{name}']" not in text and f"('{name}', given" not in text]
    assert not unused


def test_the_xml_file_includes_the_python_file():
    (include,) = ElementTree.parse(ROOT / 'launch' / 'network.launch.xml').getroot()
    assert include.attrib == {
        'file': '$(find-pkg-share rhs_isac_ros)/launch/network.launch.py'}


@needs_launch
def test_both_files_list_the_same_arguments():
    from launch.launch_description_sources import (
        get_launch_description_from_any_launch_file as load,
    )
    module = load_python_file()
    assert f'more than {module.MAX_USER_NODES} share' in module.ARGUMENTS['users'][1]
    python, xml = ({argument.name: argument.description for argument in load(
        str(ROOT / 'launch' / file)).get_launch_arguments()} for file in FILES[:2])
    assert python == xml and python.keys() == module.ARGUMENTS.keys()


ONE_EACH = [name for name in UNIQUE if name != 'bs']


SITE = str(ROOT / 'config' / 'site.yaml')


@needs_launch
@pytest.mark.parametrize(('values', 'expected'), [
    ({'composed': 'False'}, [*ONE_EACH, 'user', 'user', 'bs']),
    ({'composed': '0', 'users': '1', 'record': 'run.mcap'}, ['record', *ONE_EACH, 'user', 'bs']),
    # The name of this argument in launch files of Nav2.
    ({'use_composition': 'False', 'users': '1'}, [*ONE_EACH, 'user', 'bs']),
    ({'use_composition': 'True', 'composed': 'false', 'users': '1'}, [*ONE_EACH, 'user', 'bs']),
    ({'composed': 'false', 'users': '16'}, [*ONE_EACH, *['user'] * 16, 'bs']),
    ({'composed': ' FALSE ', 'users': '1000'}, ['LogInfo', *ONE_EACH, 'user', 'bs']),
    ({}, ['network']), ({'users': '1000'}, ['network']), ({'site': SITE}, ['network']),
    ({'visualizer': 'True'}, ['network', 'visualizer']),
    ({'site': SITE, 'visualizer': '1'}, ['network', 'visualizer', 'visualizer'])])
def test_the_started_executables(values, expected):
    assert [name for name, _ in started(**values)] == expected


@needs_launch
def test_a_site_has_a_network_for_each_surface_and_their_fusion():
    nodes = started(site=SITE, composed='false', namespace='lab', users='1', visualizer='true',
                    record='a.mcap')
    assert [(node._Node__node_namespace, name) for name, node in nodes] == [
        ('lab', 'record'), *(('lab/front', name) for name in [*ONE_EACH, 'user', 'bs']),
        *(('lab/side', name) for name in FOLLOWING), ('lab', 'fusion'),
        ('lab/front', 'visualizer'), ('lab/side', 'visualizer')]


@needs_launch
@pytest.mark.parametrize(('values', 'file'), [
    ({}, 'network.rviz'), ({'site': SITE}, 'site.rviz')])
def test_rviz_opens_the_layout_of_the_network_in_its_namespace(values, file, monkeypatch):
    module = load_python_file()
    # RViz need not be installed.
    monkeypatch.setattr(module, 'get_package_prefix', lambda name: '')
    given = {name: default for name, (default, _) in module.ARGUMENTS.items()}
    (rviz,) = module._rviz(given | {'rviz': 'true', 'namespace': 'lab'} | values)
    words = [''.join(part.text for part in word if hasattr(part, 'text')) for word in rviz.cmd]
    (path,) = [Path(word) for word in words if word.endswith('.rviz')]
    assert (path.name, rviz._Node__node_namespace) == (file, 'lab')
    assert path.is_file()


@needs_launch
@pytest.mark.parametrize('other', ['config', 'system', 'codebook'])
def test_a_site_excludes_arguments_of_a_single_surface(other):
    with pytest.raises(ValueError, match=f"^site: 'site.yaml', expected none with {other}"):
        started(site='site.yaml', **{other: 'true'})


@needs_launch
@pytest.mark.parametrize('composed', ['false', 'true'])
def test_parameters_are_declared(composed):
    parameters = pytest.importorskip('rhs_isac_ros.ros.parameters')
    everything = {parameter.name for own in parameters.NODES.values() for parameter in own}
    from launch import LaunchContext
    for executable, node in started(composed=composed):
        declared = everything if executable == 'network' else {
            parameter.name for parameter in parameters.NODES[executable]}
        node._perform_substitutions(LaunchContext())
        words = [''.join(part.text for part in word if hasattr(part, 'text')) for word in node.cmd]
        names = {word.partition(':=')[0] for flag, word in itertools.pairwise(words)
                 if flag == '-p'}
        assert {'scenario_file', 'site_file'} <= names <= declared


@needs_launch
@pytest.mark.parametrize(('pushed', 'passed', 'expected'), [
    ('/robot', 'robot', ''), ('/robot', '/robot', ''), ('', 'robot', 'robot'),
    ('/fleet', 'robot', 'robot'), ('/robot', '', '')])
def test_a_namespace_that_a_parent_pushes_and_passes_counts_once(pushed, passed, expected):
    ((_, node),) = started(namespace=passed, ros_namespace=pushed)
    assert node._Node__node_namespace == expected


@needs_launch
@pytest.mark.parametrize(('value', 'given'), [
    ('True', True), ('1', True), (' true', True), ('False', False), ('0', False)])
def test_simulated_time_is_set_only_if_it_is_true_because_a_parent_may_set_it(value, given):
    from launch import LaunchContext
    ((_, node),) = started(use_sim_time=value)
    node._perform_substitutions(LaunchContext())
    words = [''.join(part.text for part in word if hasattr(part, 'text')) for word in node.cmd]
    assert ('use_sim_time:=true' in words) == given
    assert not given or words[words.index('use_sim_time:=true') - 1] == '-p'


@needs_launch
@pytest.mark.parametrize(('name', 'value'), [
    ('users', '0'), ('users', 'x'), ('users', '-1'), ('seed', 'abc'), ('seed', '1.5'),
    ('params_file', '/no/such.yaml'), ('composed', 'yes'), ('use_sim_time', ''),
    ('visualizer', 'on'), ('rviz', '2'), ('respawn', 'None'), ('log_level', 'loud')])
def test_an_invalid_argument_is_named(name, value):
    with pytest.raises(ValueError, match=f"^{name}: '{value}', expected "):
        started(**{name: value})


@needs_launch
@pytest.mark.parametrize(('respawn', 'is_optional', 'code', 'ends'), [
    (False, False, 0, False), (False, False, 1, True), (False, False, -9, True),
    (True, False, -9, False), (True, False, 2, True), (False, True, 1, False)])
def test_a_failure_ends_the_launch_unless_the_process_is_restarted_or_optional(
        respawn, is_optional, code, ends):
    from launch.events.process import ProcessExited

    from launch import LaunchContext
    event = ProcessExited(action=None, name='bs-8', cmd=[], cwd=None, env=None, pid=1,
                          returncode=code)
    check = functools.partial(
        load_python_file()._end_if_failed, respawn, is_optional, event, LaunchContext())
    if ends:
        with pytest.raises(RuntimeError, match=f'^bs-8 ended with exit code {code}$'):
            check()
    else:
        check()


@needs_launch
@pytest.mark.parametrize(('file', 'arguments', 'expected'), [
    ('network.launch.py', ['users:=none'], ["users: 'none', expected an integer"]),
    ('network.launch.xml', ['log_level:=loud'], ["log_level: 'loud', expected debug"]),
    ('network.launch.py', ['user:=3'], ['user: unknown argument (the closest is users)']),
    ('network.launch.xml', ['user:=3'], ['user: unknown argument (the closest is users)']),
    ('site.launch.py', [f'site:={SITE}', 'mode:=x'], ['mode: unknown argument']),
    ('network.launch.py', [f'config:={ROOT}/config/quick.yaml', 'composed:=false'],
     ['config/codebook.yaml', 'config/quick.yaml', 'codebook:=', 'optimizer-4 ended']),
    ('network.launch.xml', [f'config:={ROOT}/config/quick.yaml'],
     ['config/codebook.yaml', 'config/quick.yaml', 'codebook:=', 'network-1 ended'])])
def test_an_error_ends_the_launch_and_is_named(file, arguments, expected, monkeypatch, tmp_path):
    from rhs_isac_ros.ros.environment import claim_domain
    monkeypatch.setenv('ROS_DOMAIN_ID', claim_domain())
    done = subprocess.run(
        [sys.executable, '-c', LAUNCH, ROOT / 'launch' / file, *arguments], check=False,
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=TIMEOUT_S,
        env={**os.environ, 'ROS_LOG_DIR': str(tmp_path)})
    text = done.stdout + done.stderr
    assert done.returncode == 1 and 'Traceback' not in text, text
    assert all(part in text for part in expected), text


def exists(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture
def observer(monkeypatch):
    """Return an observer of the cycles in the namespace /launched, and its executor."""
    from rhs_isac_ros.ros.environment import claim_domain
    monkeypatch.setenv('ROS_DOMAIN_ID', claim_domain())
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from rhs_isac_ros.ros.observer import CycleObserver
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node, executor = CycleObserver(context=context, namespace='/launched'), (
        SingleThreadedExecutor(context=context))
    executor.add_node(node)
    yield node, executor
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)


ALL = ('users:=3', 'seed:=4', f'config:={ROOT}/config/quick.yaml',
       f'codebook:={ROOT}/config/codebook_quick.yaml', 'visualizer:=True', 'composed:=False',
       *(['record:={}/run.mcap'] if RECORDS else []))
# All arguments except the file have their default values.
DEFAULT = ('params_file:={}/parameters.yaml',)
PARAMETERS = f'''
/**:
  ros__parameters:
    users: 3
    scenario_file: {ROOT}/config/quick.yaml
    codebook_file: {ROOT}/config/codebook_quick.yaml
'''


@needs_launch
@pytest.mark.parametrize(('file', 'arguments', 'number'), [
    ('network.launch.py', ALL, signal.SIGINT), ('network.launch.xml', DEFAULT, signal.SIGTERM)])
def test_all_users_are_served_and_no_process_remains(
        file, arguments, number, observer, tmp_path):
    node, executor = observer
    (tmp_path / 'parameters.yaml').write_text(PARAMETERS, encoding='utf-8')
    log = tmp_path / 'log'
    with open(log, 'wb') as stream, subprocess.Popen(
            [sys.executable, '-c', LAUNCH, ROOT / 'launch' / file, 'namespace:=launched',
             *(argument.format(tmp_path) for argument in arguments)],
            stdout=stream, stderr=stream, stdin=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, 'ROS_LOG_DIR': str(tmp_path)}) as process:
        try:
            end_s = time.monotonic() + TIMEOUT_S
            while ({record.user for record in node.log.complete} != {1, 2, 3}
                   or 'visualizer:=True' in arguments
                   and not node.count_publishers('/launched/markers')):
                executor.spin_once(timeout_sec=0.1)
                assert process.poll() is None and time.monotonic() < end_s, (
                    log.read_text(encoding='utf-8'))
            process.send_signal(number)
            assert process.wait(TIMEOUT_S) in (0, 1, -number)
            end_s = time.monotonic() + TIMEOUT_S
            while exists(process.pid):
                assert time.monotonic() < end_s, 'processes remain'
        finally:
            if exists(process.pid):
                os.killpg(process.pid, signal.SIGKILL)
    text = log.read_text(encoding='utf-8')
    assert 'Traceback' not in text, text
    assert 'process has died' not in text, text
    assert ('[record-' in text) == (RECORDS and arguments is ALL)
    if RECORDS and arguments is ALL:
        assert_complete(tmp_path / 'run.mcap', node.log.complete)


def assert_complete(path, cycles):
    """Assert that a recording is closed and contains the cycles that the observer logged."""
    from rhs_isac_ros.ros.recording import read, read_networks
    assert read_networks(path).scenario == Scenario.from_yaml(ROOT / 'config' / 'quick.yaml')
    topics = [topic for topic, _, _ in read(path)]
    assert topics.count('/launched/capacity') >= len(cycles) - 2
    assert '/launched/codebook' in topics
    assert not list(path.parent.glob('*.part'))


@needs_launch
def test_without_rviz_the_launch_logs_that_and_starts_the_nodes(monkeypatch):
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(
        path for path in os.environ['AMENT_PREFIX_PATH'].split(os.pathsep)
        if not (Path(path) / 'share' / 'rviz2').exists()))
    names = [name for name, _ in started(rviz='true')]
    assert names[-2:] == ['visualizer', 'LogInfo']
    assert 'LogInfo' not in [name for name, _ in started()]


EXAMPLE = ROOT / 'docs' / 'examples' / 'robot.launch.py'


def test_the_example_of_an_include_uses_arguments_of_the_network_in_a_scope():
    text = EXAMPLE.read_text(encoding='utf-8')
    (group,) = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)
                and getattr(node.func, 'id', '') == 'GroupAction']
    options = {option.arg: option.value for option in group.keywords}
    assert options['forwarding'].value is False
    names = {key.value for key in options['launch_configurations'].keys}
    declared = (ROOT / 'launch' / 'network.launch.py').read_text(encoding='utf-8')
    assert names and all(f"\n    '{name}': (" in declared for name in names)



@needs_launch
def test_a_parent_with_arguments_of_its_own_includes_the_network(monkeypatch, tmp_path):
    from rhs_isac_ros.ros.environment import claim_domain
    monkeypatch.setenv('ROS_DOMAIN_ID', claim_domain())
    arguments = ('use_sim_time:=False', 'params_file:=of_robot.yaml', 'slam:=True')
    with subprocess.Popen(
            [sys.executable, '-c', LAUNCH, EXAMPLE, *arguments], text=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env={**os.environ, 'ROS_LOG_DIR': str(tmp_path)}) as process:
        # The output ends if the launch fails.
        with contextlib.closing(process.stdout) as output:
            lines = list(itertools.takewhile(lambda line: 'serving: codebook' not in line or (
                '[positioning.bs]' not in line), output))
        assert process.poll() is None, ''.join(lines)
        process.send_signal(signal.SIGINT)
        process.wait(TIMEOUT_S)
    assert not [line for line in lines if '[WARN]' in line or 'ERROR' in line]
