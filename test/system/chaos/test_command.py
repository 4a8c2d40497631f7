"""``scripts/chaos`` on a small network: a short run of each test."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.environment import claim_domain
from rhs_isac_ros.ros.roster import UNIQUE
from system.chaos.command import main

# The parent directory of the package `system`.
FOLDER = Path(__file__).parents[2]


def chaos(small_files, tmp_path, *arguments):
    """Run the command; return its figures and its output."""
    file = tmp_path / 'figures.json'
    environment = {**os.environ, 'ROS_DOMAIN_ID': claim_domain()}
    done = subprocess.run(
        [sys.executable, '-m', 'system.chaos', '--config',
         small_files / 'scenario.yaml', '--codebook', small_files / 'first.yaml',
         '--json', file, *arguments],
        capture_output=True, text=True, timeout=150, env=environment, cwd=FOLDER)
    assert file.exists(), done.stdout + done.stderr
    figures = json.loads(file.read_text(encoding='utf-8'))
    assert done.returncode == (0 if figures['passed'] else 1), done.stdout + done.stderr
    return figures, done.stdout + done.stderr


def test_cycles_are_served_after_a_crash_and_a_second_base_station(small_files, tmp_path):
    """The older of two base stations resumes when the newer has gone."""
    figures, output = chaos(
        small_files, tmp_path, '--nodes', 'rhs_controller', '--phases', 'positioning',
        '--intruders', 'bs', '--seconds', '1')
    assert figures['trials'] == 2
    assert figures['wrong_publications'] == 0, output
    assert figures['checked_publications'] > figures['unverified_publications']
    crash, intrusion = figures['table']
    assert (crash['node'], crash['phase']) == ('rhs_controller', 'positioning')
    assert intrusion['intruder'] == 'bs'
    # The time to recover depends on the load of the machine; recovery itself does not.
    for trial in figures['table']:
        assert trial['others_running']
        assert trial['recovery_s'] is not None, output
    assert crash['logged'] and 'bs' in crash['diagnosed']
    assert figures['trials_reported'] == 2, output


def test_mutations_crash_no_node_and_are_counted(small_files, tmp_path):
    figures, output = chaos(small_files, tmp_path, '--fuzz', '1500')
    assert figures['passed'], output
    assert figures['mutations'] == sum(figures['sent'].values()) == 1500
    assert figures['sent'].keys() == {
        *topics.NAMES.values(), topics.CODEBOOK, topics.PRESENCE, topics.POSITION,
        topics.DIAGNOSTICS, topics.MARKERS}
    # Which mutations are malformed depends on the messages of the running network: about a third,
    # 498 to 535 in several runs. Every node receives some of them.
    assert sum(figures['counted'].values()) > 300
    assert min(figures['counted'].values()) > 0
    assert figures['dropped']['malformed'] == sum(figures['malformed'].values())


def test_cycles_are_served_over_an_impaired_channel(small_files, tmp_path):
    figures, output = chaos(small_files, tmp_path, '--soak', '0.1')
    assert figures['wrong_publications'] == 0, output
    assert figures['cycles'] > 5
    assert figures['estimate_share'] >= 0.9, output
    assert not figures['ended']
    assert figures['memory_growth'].keys() == {*UNIQUE, 'user_1', 'user_2'}


@pytest.mark.parametrize('arguments', [
    ['--soak', '0'], ['--soak', 'inf'], ['--fuzz', '-3'], ['--soak', '1', '--fuzz', '1'],
    ['--nodes', 'unknown'], ['--intruders', 'unknown'], ['--phases', 'unknown']])
def test_invalid_arguments_are_rejected(arguments, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert 'error: argument' in capsys.readouterr().err


def test_an_invalid_file_is_named(capsys):
    with pytest.raises(SystemExit, match='2'):
        main(['--config', '/nonexistent.yaml'])
    assert '/nonexistent.yaml' in capsys.readouterr().err
