"""One line for every error at the start: environment, arguments, names, files, enclaves."""

import contextlib
import gc
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from ament_index_python.packages import get_package_prefix
from parts import param, topic
from rclpy.exceptions import InvalidNodeNameException, InvalidTopicNameException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.utilities import try_shutdown
from std_msgs.msg import Empty

from rhs_isac_ros.ros import run
from rhs_isac_ros.ros.endpoints import EXCHANGE
from rhs_isac_ros.ros.run import StartError

PROGRAMS = Path(get_package_prefix('rhs_isac_ros')) / 'lib' / 'rhs_isac_ros'


def program(name, *arguments, **environment):
    """Run an executable, and return its exit code and the lines of stderr that ROS did not log."""
    done = subprocess.run(
        [PROGRAMS / name, *arguments], env={**os.environ, **environment}, capture_output=True,
        text=True, errors='backslashreplace', timeout=240, check=False)
    return done.returncode, [line for line in done.stderr.splitlines() if line[:1] != '[']


@pytest.mark.parametrize(('error', 'text'), [
    (InvalidNodeNameException('robot-1', 'node name must not contain characters', 5),
     "Invalid node name: node name must not contain characters: 'robot-1'"),
    (InvalidTopicNameException('/robot-1', 'topic name must not end', 1),
     "Invalid topic name: topic name must not end: '/robot-1'"),
    (rclpy_implementation.RCLError(
        "Failed to parse ROS arguments: Couldn't parse remap rule: '-r __node:=a-1'. Error: "
        'Expected lexeme type (1) not found, ended at index 13, at /a/b.c:239, at /a/c.c:380'),
     "invalid ROS arguments: Couldn't parse remap rule: '-r __node:=a-1'"),
    (rclpy_implementation.UnknownROSArgsError("['--a']"), "invalid ROS arguments: ['--a']"),
    (rclpy_implementation.RCLError('error creating node: Unable to resolve peer a.b , at b.c:1'),
     'ROS_STATIC_PEERS: no address of a.b'),
    (rclpy_implementation.RCLError('could not create data writer, at a.cpp:275, at b.c:1'),
     'could not create data writer'),
    (FileNotFoundError(2, 'No such file', '/a'), '/a: No such file'),
    (UnicodeEncodeError('utf-8', '\udcff', 0, 1, 'surrogates'),
     r"argument '\udcff': expected UTF-8")])
def test_an_error_has_one_line_without_the_sources_of_ros(error, text, monkeypatch):
    monkeypatch.delenv('ROS_SECURITY_ENABLE', raising=False)
    with pytest.raises(StartError) as found, run.starting():
        raise error
    assert str(found.value) == text


@pytest.mark.parametrize('error', [RuntimeError('a bug'), BrokenPipeError(32, 'Broken pipe')])
def test_an_error_of_the_program_or_of_the_output_is_not_converted(error):
    with pytest.raises(type(error)) as found, run.starting():
        raise error
    assert found.value is error


@pytest.mark.parametrize(('executable', 'arguments', 'environment', 'expected'), [
    ('watch', [], {'ROS_STATIC_PEERS': 'nohost.invalid'},
     'ROS_STATIC_PEERS: no address of nohost.invalid'),
    ('bs', [b'\xff'], {}, r"argument '\udcff': expected UTF-8")])
def test_a_program_that_cannot_start_ends_with_one_line(
        executable, arguments, environment, expected):
    code, lines = program(executable, *arguments, **environment)
    assert code == 2
    assert [line.startswith(f'{executable}: error: {expected}') for line in lines] == [True]


@pytest.fixture
def secure(tmp_path, monkeypatch):
    """DDS security is enforced, with a keystore that has the enclave ``/bs`` without files."""
    (tmp_path / 'enclaves' / 'bs').mkdir(parents=True)
    for name, value in {
            'ENABLE': 'true', 'STRATEGY': 'Enforce', 'KEYSTORE': str(tmp_path)}.items():
        monkeypatch.setenv(f'ROS_SECURITY_{name}', value)
    monkeypatch.delenv('ROS_SECURITY_ENCLAVE_OVERRIDE', raising=False)
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))


@pytest.fixture
def initialised(monkeypatch):
    """Arguments with which rclpy is initialised."""
    calls = []
    monkeypatch.setattr(run.rclpy, 'init', lambda args, **_: calls.append(args))
    return calls


@pytest.mark.parametrize(('args', 'enclave'), [
    (['bs'], '/bs'),
    (['/opt/ros/lib/bs', '--ros-args', '-p', 'seed:=1'], '/bs'),
    (['user', '--ros-args', '-r', '__node:=user_1', '-r', '__ns:=/lab'], '/lab/user_1'),
    (['user', '--ros-args', '-r', 'user:__name:=user_1'], '/user_1'),
    (['watch', '--once'], '/operator'),
    (['record', 'a', '--ros-args', '-r', '__ns:=/lab', '--remap', '__node:=recorder'],
     '/lab/operator'),
    (['replay'], '/replay'), ([''], '/operator')])
def test_each_process_has_the_enclave_of_its_node(args, enclave, secure, initialised):
    run.init(args)
    assert initialised == [[*args, '--ros-args', '--enclave', enclave]]


@pytest.mark.parametrize(('program', 'strategy', 'is_named'), [
    ('watch', 'Permissive', True), ('watch', 'Enforce', False), ('bs', 'Permissive', False)])
def test_a_process_that_runs_without_security_says_so(
        program, strategy, is_named, secure, initialised, monkeypatch, capsys):
    monkeypatch.setenv('ROS_SECURITY_STRATEGY', strategy)
    run.init([program])
    assert ('WITHOUT security: ' in capsys.readouterr().err) == is_named


def test_a_given_enclave_takes_precedence(secure, initialised):
    args = ['bs', '--ros-args', '--enclave', '/other']
    run.init(args)
    assert initialised == [args]


@pytest.mark.parametrize('value', [None, '', 'false'])
def test_nothing_changes_without_security(value, secure, initialised, monkeypatch):
    monkeypatch.delenv('ROS_SECURITY_ENABLE')
    if value is not None:
        monkeypatch.setenv('ROS_SECURITY_ENABLE', value)
    run.init(['bs'])
    assert initialised == [['bs']]


@pytest.mark.parametrize(('keystore', 'text'), [
    ('', 'ROS_SECURITY_KEYSTORE: empty, expected a keystore'),
    ('/missing', "SECURITY ERROR: directory '/missing/enclaves/bs' does not exist.")])
def test_a_missing_keystore_is_an_error(keystore, text, secure, monkeypatch):
    monkeypatch.setenv('ROS_SECURITY_KEYSTORE', keystore)
    try:
        with pytest.raises(StartError) as error:
            run.init(['bs'])
    finally:
        try_shutdown()
    assert text in str(error.value)


@pytest.mark.parametrize(('error', 'text'), [
    ('__create_participant failed to create participant, at a.cpp:107, at b.c:2',
     'Fast DDS rejects the files of the enclave, which'),
    ('the security libraries are missing', 'Fast DDS was built without security')])
def test_an_error_of_dds_security_is_explained(error, text, secure):
    with pytest.raises(StartError) as found, run.starting():
        raise rclpy_implementation.RCLError(error)
    assert text in str(found.value)


@pytest.mark.parametrize('executable', ['bs', 'optimizer'])
def test_a_program_that_cannot_use_its_keys_ends_with_one_line(executable, secure):
    codebook = Path(__file__).parents[2] / 'config' / 'codebook.yaml'
    arguments = ['--push-file', codebook] if executable == 'optimizer' else []
    code, lines = program(executable, *arguments)
    assert code == 2
    assert len(lines) == 1
    assert lines[0].startswith(f'{executable}: error: ')


@pytest.mark.parametrize(('main', 'arguments'), [
    (topic.main, ('echo', 'ack')), (topic.main, ('hz', 'ack')),
    (param.main, ('get', 'bs', 'rest_s'))])
def test_a_tool_that_is_refused_a_topic_or_a_service_ends_with_one_line(
        monkeypatch, capsys, main, arguments, secure):
    # The exchange of keys delays the discovery of the node.
    def refuse(*_, **__):
        raise rclpy_implementation.RCLError('Failed to create: not allowed\nat a line')
    node = SimpleNamespace(
        create_subscription=refuse, create_client=refuse,
        get_publishers_info_by_topic=lambda name: [SimpleNamespace(qos_profile=EXCHANGE)],
        get_name=lambda: 'tool', get_namespace=lambda: '/',
        get_topic_names_and_types=lambda: [('/ack', ['rhs_isac_msgs/msg/Ack'])],
        get_node_names_and_namespaces=lambda: [('bs', '/')] if clock_s >= 8.0 else [])
    clock_s = 0.0

    def spin_until(condition, timeout_s=8.0):
        nonlocal clock_s
        clock_s += timeout_s or 0.0
        return condition()
    session = SimpleNamespace(node=node, spin_until=spin_until)
    monkeypatch.setattr(
        'parts.verbs.Session', lambda arguments: contextlib.nullcontext(session))
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(': error: Failed to create: not allowed at a line')


def test_an_event_of_a_destroyed_entity_does_not_end_a_node():
    """A request may be in the queue when a node that stands by destroys its service."""
    calls = []

    def make():
        node = Node('brief')
        publisher = node.create_publisher(Empty, 'topic', 1)
        node.destroy_publisher(publisher)

        def publish():
            calls.append(None)
            publisher.publish(Empty())
        node.create_timer(0.001, publish)
        return [node]
    try:
        (node,) = run.spin(make, ['brief'], lambda nodes: len(calls) > 2)
    finally:
        gc.unfreeze()
    assert isinstance(node, Node) and len(calls) > 2
