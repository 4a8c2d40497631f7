"""The launch files: their arguments, the service of all users, and a clean end."""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from rhs_isac_ros.model import Scenario

ROOT = Path(__file__).parents[1]
FILES = ('network.launch.py', 'network.launch.xml')
TIMEOUT_S = 60.0
# A short form of `ros2 launch`.
LAUNCH = '''
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource

arguments = [tuple(argument.split(':=')) for argument in sys.argv[2:]]
service = LaunchService()
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


def arguments_of_xml():
    root = ElementTree.parse(ROOT / 'launch' / 'network.launch.xml').getroot()
    return {arg.get('name'): (arg.get('default'), arg.get('description'))
            for arg in root.iter('arg')}


def test_the_files_are_installed_and_their_dependencies_declared():
    packages = pytest.importorskip('ament_index_python.packages')
    share = Path(packages.get_package_share_directory('rhs_isac_ros'))
    assert {path.name for path in (share / 'launch').iterdir()} >= set(FILES)
    depends = {element.text for element in
               ElementTree.parse(ROOT / 'package.xml').getroot().iter('exec_depend')}
    assert {'launch', 'launch_ros', 'launch_xml'} <= depends


def test_the_xml_file_sets_declared_parameters_and_uses_all_arguments():
    parameters = pytest.importorskip('rhs_isac_ros.ros.parameters')
    declared = {parameter.name for own in parameters.NODES.values() for parameter in own}
    root = ElementTree.parse(ROOT / 'launch' / 'network.launch.xml').getroot()
    values = {param.get('name'): param.get('value') for param in root.iter('param')}
    assert values.keys() <= declared
    used = {name for node in root.iter() for text in node.attrib.values()
            for name in re.findall(r'\$\(var (\w+)\)', text)}
    assert used == arguments_of_xml().keys()
    assert {node.get('namespace') for node in root.iter('node')} == {'$(var namespace)'}


@needs_launch
def test_both_files_have_the_same_arguments():
    from launch.launch_description_sources import (
        get_launch_description_from_python_launch_file as load,
    )
    description = load(str(ROOT / 'launch' / 'network.launch.py'))
    assert arguments_of_xml() == {
        argument.name: (argument.default_value[0].text, argument.description)
        if argument.default_value else ('', argument.description)
        for argument in description.get_launch_arguments()}


def exists(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture
def observer(monkeypatch):
    """Return an observer of the cycles in the namespace /launched, and its executor."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
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


@needs_launch
@pytest.mark.parametrize('file, number', zip(FILES, (signal.SIGINT, signal.SIGTERM), strict=True))
def test_all_users_are_served_and_no_process_remains(file, number, observer, tmp_path):
    node, executor = observer
    with open(tmp_path / 'log', 'w+', encoding='utf-8') as log, subprocess.Popen(
            [sys.executable, '-c', LAUNCH, ROOT / 'launch' / file, 'users:=3', 'seed:=4',
             f'config:={ROOT}/config/quick.yaml', f'codebook:={ROOT}/config/codebook_quick.yaml',
             'namespace:=launched', 'visualizer:=true', f'record:={tmp_path}/run.mcap'],
            stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, 'ROS_LOG_DIR': str(tmp_path)}) as process:
        try:
            end_s = time.monotonic() + TIMEOUT_S
            while ({record.user for record in node.log.complete} != {1, 2, 3}
                   or not node.count_publishers('/launched/markers')):
                executor.spin_once(timeout_sec=0.1)
                assert process.poll() is None and time.monotonic() < end_s, (
                    tmp_path / 'log').read_text(encoding='utf-8')
            process.send_signal(number)
            assert process.wait(TIMEOUT_S) in (0, 1, -number)
            end_s = time.monotonic() + TIMEOUT_S
            while exists(process.pid):
                assert time.monotonic() < end_s, 'processes remain'
        finally:
            if exists(process.pid):
                os.killpg(process.pid, signal.SIGKILL)
    text = (tmp_path / 'log').read_text(encoding='utf-8')
    assert 'Traceback' not in text, text
    assert 'process has died' not in text, text
    assert_complete(tmp_path / 'run.mcap', node.log.complete)


def assert_complete(path, cycles):
    """Assert that a recording is closed and contains the cycles that the observer logged."""
    from rhs_isac_ros.ros.recording import read, read_scenario
    assert read_scenario(path) == Scenario.from_yaml(ROOT / 'config' / 'quick.yaml')
    topics = [topic for topic, _, _ in read(path)]
    assert topics.count('/launched/capacity') >= len(cycles) - 2
    assert '/launched/codebook' in topics
    assert not list(path.parent.glob('*.part'))


@needs_launch
def test_without_rviz_the_launch_logs_that_and_starts_the_nodes(monkeypatch):
    from launch.actions import LogInfo
    from launch_ros.actions import Node

    from launch import LaunchContext
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(
        path for path in os.environ['AMENT_PREFIX_PATH'].split(os.pathsep)
        if not (Path(path) / 'share' / 'rviz2').exists()))
    spec = importlib.util.spec_from_file_location(
        'network_launch', ROOT / 'launch' / 'network.launch.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    context = LaunchContext()
    context.launch_configurations.update(
        {name: default for name, (default, _) in module.ARGUMENTS.items()} | {'rviz': 'true'})
    *nodes, log = module.start_nodes(context)
    assert all(isinstance(node, Node) for node in nodes)
    assert isinstance(log, LogInfo) and log.condition.evaluate(context)
    assert nodes[-1].condition.evaluate(context)
    context.launch_configurations['rviz'] = 'false'
    assert not log.condition.evaluate(context) and not nodes[-1].condition.evaluate(context)
