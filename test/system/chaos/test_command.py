"""``scripts/chaos`` on a small network: each of its trials, in brief."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from system.chaos.command import main

# Where Python finds the package `system`.
FOLDER = Path(__file__).parents[2]


def chaos(small_files, tmp_path, *arguments):
    """Run the command; return its figures, and what it has said."""
    file = tmp_path / 'figures.json'
    environment = {**os.environ, 'ROS_DOMAIN_ID': str(101 - os.getpid() % 100)}
    done = subprocess.run(
        [sys.executable, '-m', 'system.chaos', '--config',
         small_files / 'scenario.yaml', '--codebook', small_files / 'first.yaml',
         '--json', file, *arguments],
        capture_output=True, text=True, timeout=150, env=environment, cwd=FOLDER)
    assert file.exists(), done.stdout + done.stderr
    figures = json.loads(file.read_text(encoding='utf-8'))
    assert done.returncode == (0 if figures['passed'] else 1), done.stdout + done.stderr
    return figures, done.stdout + done.stderr


def test_a_node_is_killed_and_served_again(small_files, tmp_path):
    figures, said = chaos(
        small_files, tmp_path, '--nodes', 'rhs_controller', '--phases', 'positioning')
    assert figures['cells'] == 1
    assert figures['wrong_publications'] == 0, said
    assert figures['checked_publications'] > figures['unverified_publications']
    (cell,) = figures['table']
    assert (cell['node'], cell['phase'], cell['others_alive']) == (
        'rhs_controller', 'positioning', True)
    # How fast depends on what else the machine does; that it comes back does not.
    assert cell['recovered_s'] is not None, said
    assert cell['told_log'] and 'bs' in cell['told_diagnostics']


def test_lies_crash_nobody_and_are_counted(small_files, tmp_path):
    figures, said = chaos(small_files, tmp_path, '--fuzz', '1500')
    assert figures['passed'], said
    assert figures['lies'] == sum(figures['sent'].values()) == 1500
    assert len(figures['sent']) == 21
    assert sum(figures['counted'].values()) > 500
    assert figures['dropped']['malformed'] == sum(figures['malformed'].values())


def test_a_bad_air_is_survived(small_files, tmp_path):
    figures, said = chaos(small_files, tmp_path, '--soak', '0.1')
    assert figures['wrong_publications'] == 0, said
    assert figures['cycles'] > 5
    assert figures['estimate_share'] >= 0.9, said
    assert not figures['ended']
    assert figures['memory_growth'].keys() == {
        'bs', 'rhs_controller', 'channel', 'positioner', 'transmission', 'optimizer', 'user_1',
        'user_2'}


@pytest.mark.parametrize('arguments', [
    ['--soak', '0'], ['--soak', 'inf'], ['--fuzz', '-3'], ['--soak', '1', '--fuzz', '1'],
    ['--nodes', 'sun'], ['--phases', 'waxing']])
def test_wrong_arguments_are_refused(arguments, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert 'error: argument' in capsys.readouterr().err


def test_a_wrong_file_is_named(capsys):
    assert main(['--config', '/nonexistent.yaml']) == 2
    assert '/nonexistent.yaml' in capsys.readouterr().err
