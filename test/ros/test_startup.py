"""Enclaves by name, and one line for every error of the environment of SROS 2."""

import contextlib
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from ament_index_python.packages import get_package_prefix
from rclpy.impl.implementation_singleton import rclpy_implementation

from rhs_isac_ros.ros import startup
from rhs_isac_ros.ros.startup import SecurityError, prepare
from rhs_isac_ros.tools import param, topic

EVERY = ('bs', 'lab/user_1', 'operator', 'lab/operator', 'replay', 'other')


@pytest.fixture(autouse=True)
def keystore(tmp_path, monkeypatch):
    """Security is enabled, with keys without content for domain 7."""
    for name in EVERY:
        folder = tmp_path / 'enclaves' / name
        folder.mkdir(parents=True)
        for file in startup._FILES:
            (folder / file).touch()
        (folder / 'permissions.p7s').write_text('<domains><id>7</id></domains>', encoding='utf-8')
    for name, value in {
            'ENABLE': 'true', 'STRATEGY': 'Enforce', 'KEYSTORE': str(tmp_path)}.items():
        monkeypatch.setenv(f'ROS_SECURITY_{name}', value)
    monkeypatch.delenv('ROS_SECURITY_ENCLAVE_OVERRIDE', raising=False)
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    return tmp_path


@pytest.mark.parametrize(('args', 'enclave'), [
    (['bs'], '/bs'),
    (['/opt/ros/lib/bs', '--ros-args', '-p', 'seed:=1'], '/bs'),
    (['user', '--ros-args', '-r', '__node:=user_1', '-r', '__ns:=/lab'], '/lab/user_1'),
    (['watch', '--once'], '/operator'),
    (['record', 'a', '--ros-args', '-r', '__ns:=/lab', '--remap', '__node:=recorder'],
     '/lab/operator'),
    (['replay'], '/replay'), ([''], '/operator')])
def test_each_process_has_the_enclave_of_its_node(args, enclave):
    assert prepare(args) == [*args, '--ros-args', '--enclave', enclave]


def test_a_given_enclave_takes_precedence(monkeypatch):
    args = ['bs', '--ros-args', '--enclave', '/other']
    assert prepare(args) == args
    monkeypatch.setenv('ROS_SECURITY_ENCLAVE_OVERRIDE', '/other')
    assert prepare(['unknown'])[0] == 'unknown'


@pytest.mark.parametrize('value', [None, '', 'false'])
def test_nothing_changes_without_security(monkeypatch, value):
    monkeypatch.delenv('ROS_SECURITY_ENABLE')
    if value is not None:
        monkeypatch.setenv('ROS_SECURITY_ENABLE', value)
    assert prepare(['unknown']) == ['unknown']


@pytest.mark.parametrize(('name', 'value', 'text'), [
    ('ROS_SECURITY_ENABLE', 'True', "ROS_SECURITY_ENABLE: 'True', expected true or false"),
    ('ROS_SECURITY_STRATEGY', 'enforce',
     "ROS_SECURITY_STRATEGY: 'enforce', expected Enforce or Permissive"),
    ('ROS_SECURITY_KEYSTORE', '', "ROS_SECURITY_KEYSTORE: '', expected a keystore"),
    ('ROS_SECURITY_KEYSTORE', '/missing', "ROS_SECURITY_KEYSTORE: '/missing', expected a keystor"),
    ('ROS_SECURITY_ENCLAVE_OVERRIDE', '/lab/bs', 'enclave /lab/bs: no identity_ca.cert.pem in '),
    ('ROS_DOMAIN_ID', '8', 'ROS_DOMAIN_ID: 8, expected 7, for which the permissions of /bs are'),
    ('ROS_DOMAIN_ID', '', 'ROS_DOMAIN_ID: 0, expected 7, for which')])
def test_an_error_has_one_line_that_names_the_variable(monkeypatch, capsys, name, value, text):
    monkeypatch.setenv(name, value)
    with pytest.raises(SecurityError) as error:
        prepare(['bs'])
    assert str(error.value).startswith(text)
    assert '\n' not in str(error.value)
    # ROS continues without security then.
    if not name.endswith(('ENABLE', 'STRATEGY')):
        monkeypatch.setenv('ROS_SECURITY_STRATEGY', 'Permissive')
        prepare(['bs'])
        assert capsys.readouterr().err == (
            f'WITHOUT security, because ROS_SECURITY_STRATEGY is not Enforce: {error.value}\n')


@pytest.mark.parametrize(('error', 'text'), [
    ('__create_participant failed to create participant, at a.cpp:107, at b.c:2',
     'DDS security: Fast DDS rejects the files of the enclave, which'),
    ('could not create data writer, at a.cpp:275, at b.c:1',
     'DDS security: could not create data writer')])
def test_an_error_omits_the_sources_of_ros(error, text):
    with pytest.raises(SecurityError) as found, startup.one_line():
        raise rclpy_implementation.RCLError(error)
    assert str(found.value).startswith(text)
    assert ', at ' not in str(found.value)


@pytest.mark.parametrize('executable', ['bs', 'optimizer'])
def test_a_program_that_cannot_use_its_keys_ends_with_one_line(keystore, executable):
    program = Path(get_package_prefix('rhs_isac_ros')) / 'lib' / 'rhs_isac_ros' / executable
    codebook = Path(__file__).parents[2] / 'config' / 'codebook.yaml'
    arguments = ['--push-file', codebook] if executable == 'optimizer' else []
    done = subprocess.run([program, *arguments], env=os.environ, capture_output=True, text=True,
                          timeout=60, check=False)
    assert done.returncode == (1 if arguments else 2)
    lines = [line for line in done.stderr.splitlines() if '[INFO]' not in line]
    assert len(lines) == 1
    assert lines[0].startswith(f'{executable}: error: DDS security: ')


@pytest.mark.parametrize(('main', 'arguments'), [
    (topic.main, ('echo', 'ack')), (topic.main, ('hz', 'ack')),
    (param.main, ('get', 'bs', 'rest_s'))])
def test_a_tool_that_is_refused_a_topic_or_a_service_ends_with_one_line(
        monkeypatch, capsys, main, arguments):
    # The exchange of keys delays the discovery of the node.
    def refuse(*_, **__):
        raise rclpy_implementation.RCLError('Failed to create: not allowed\nat a line')
    node = SimpleNamespace(
        create_subscription=refuse, create_client=refuse,
        get_publishers_info_by_topic=lambda name: [],
        get_topic_names_and_types=lambda: [('/ack', ['rhs_isac_msgs/msg/Ack'])],
        get_node_names_and_namespaces=lambda: [('bs', '/')] if clock_s >= 8.0 else [])
    clock_s = 0.0

    def spin_until(condition, timeout_s=8.0):
        nonlocal clock_s
        clock_s += timeout_s
        return condition()
    session = SimpleNamespace(node=node, full_name='/{}'.format, spin_until=spin_until)
    monkeypatch.setattr(
        'rhs_isac_ros.tools.command.Session', lambda arguments: contextlib.nullcontext(session))
    assert main(arguments) == 1
    assert capsys.readouterr().err == 'DDS security: Failed to create: not allowed\n'
