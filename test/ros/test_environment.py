"""Environment variables that ROS reads: their checks and defaults."""

import argparse
import os

import pytest

from rhs_isac_ros.ros import environment


@pytest.mark.parametrize(('name', 'value', 'expected'), [
    # rcl would read 8, 16 and 5.
    ('ROS_DOMAIN_ID', '010', 'an integer from 0 to 232'),
    ('ROS_DOMAIN_ID', '0x10', 'an integer from 0 to 232'),
    ('ROS_DOMAIN_ID', ' 5', 'an integer from 0 to 232'),
    ('ROS_DOMAIN_ID', '233', 'an integer from 0 to 232'),
    ('ROS_DOMAIN_ID', '٣', 'an integer from 0 to 232'),
    ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'localhost', 'OFF, LOCALHOST, SUBNET or SYSTEM_DEFAULT'),
    ('ROS_STATIC_PEERS', '127.0.0.1,127.0.0.2', 'addresses or host names with ; between them'),
    ('ROS_STATIC_PEERS', '127.0.0.1 127.0.0.2', 'addresses or host names with ; between them'),
    ('ROS_SECURITY_ENABLE', 'True', 'true or false'),
    ('ROS_SECURITY_STRATEGY', 'enforce', 'Enforce or Permissive')])
def test_an_invalid_environment_variable_is_named(name, value, expected, monkeypatch, capsys):
    monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit, match='2'):
        environment.check_environment(argparse.ArgumentParser(prog='bs'))
    assert (f'bs: error: environment variable {name}: {value!r}, expected {expected}'
            in capsys.readouterr().err)


@pytest.mark.parametrize(('content', 'reason'), [
    (None, 'No such file'), ('<dds>', 'no element found'), ('', 'no element found')])
def test_a_missing_or_damaged_profile_is_named(content, reason, monkeypatch, capsys, tmp_path):
    file = tmp_path / 'profile.xml'
    if content is not None:
        file.write_text(content, encoding='utf-8')
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(file))
    with pytest.raises(SystemExit, match='2'):
        environment.check_environment(argparse.ArgumentParser(prog='bs'))
    assert f"FILE: '{file}', expected an XML file: {reason}" in capsys.readouterr().err


@pytest.mark.parametrize('name', ['rmw_cyclonedds_cpp', 'rmw_implementation', 'nonsense'])
def test_a_middleware_that_is_not_installed_is_named(name, monkeypatch, capsys):
    monkeypatch.setattr('ament_index_python.get_resources', lambda kind: {
        'rmw_implementation': '/', 'rmw_fastrtps_cpp': '/'})
    monkeypatch.setenv('RMW_IMPLEMENTATION', name)
    with pytest.raises(SystemExit, match='2'):
        environment.check_middleware()
    assert (f'error: environment variable RMW_IMPLEMENTATION: {name!r}, expected '
            'rmw_fastrtps_cpp\n') in capsys.readouterr().err
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp')
    environment.check_middleware()


@pytest.mark.parametrize(('name', 'value'), [
    *(('ROS_DOMAIN_ID', value) for value in ('', '0', '10', '232')),
    ('ROS_STATIC_PEERS', '127.0.0.1;localhost'), ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'OFF'),
    ('ROS_SECURITY_ENABLE', 'false')])
def test_a_valid_environment_variable_is_accepted(name, value, monkeypatch):
    monkeypatch.setenv(name, value)
    environment.check_environment(argparse.ArgumentParser())


@pytest.mark.parametrize(('only', 'given', 'expected'), [
    (None, None, 'LOCALHOST'), (None, 'SUBNET', 'SUBNET'), ('0', 'SUBNET', 'SUBNET'),
    ('1', 'SUBNET', 'LOCALHOST')])
def test_the_older_variable_for_the_discovery_range_takes_precedence(
        only, given, expected, monkeypatch):
    for name, value in (('ROS_LOCALHOST_ONLY', only), ('ROS_AUTOMATIC_DISCOVERY_RANGE', given)):
        monkeypatch.delenv(name, raising=False)
        if value:
            monkeypatch.setenv(name, value)
    assert environment.discovery_range() == expected


def test_claimed_domains_differ_and_have_ports_below_the_ephemeral_ones(monkeypatch):
    monkeypatch.setattr(os, 'getpid', lambda: 101)
    domains = {int(environment.claim_domain()) for _ in range(3)}
    assert len(domains) == 3
    assert min(domains) >= 1 and max(domains) <= 101


WITHOUT_LOG_FILES = ['--ros-args', '--disable-external-lib-logs']


@pytest.mark.parametrize(('variable', 'value', 'expected'), [
    ('HOME', '{folder}', []), ('HOME', '{folder}/file', WITHOUT_LOG_FILES),
    ('HOME', '', WITHOUT_LOG_FILES), ('HOME', None, WITHOUT_LOG_FILES),
    # rcl reports an error for a folder that the user chose.
    ('ROS_LOG_DIR', '/proc/none', []), ('ROS_HOME', '/proc/none', [])])
def test_a_user_without_a_home_directory_has_no_log_files(
        variable, value, expected, monkeypatch, tmp_path, capsys):
    (tmp_path / 'file').touch()
    for name in ('HOME', 'ROS_LOG_DIR', 'ROS_HOME'):
        monkeypatch.delenv(name, raising=False)
    if value is not None:
        monkeypatch.setenv(variable, value.format(folder=tmp_path))
    assert environment.log_arguments() == expected
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == bool(expected)
    assert all(line.startswith('no log files: ') and 'ROS_LOG_DIR' in line for line in lines)
