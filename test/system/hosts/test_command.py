"""``scripts/hosts`` with real network namespaces, where they are available."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from system.hosts.command import SKIPPED, main

ROOT = Path(__file__).parents[3]
# The parent directory of the package `system`.
FOLDER = ROOT / 'test'
# Creates hosts, prints a line, and waits for a signal.
HOLD = '''
import signal
from system.hosts.namespaces import Hosts, interruptible

def hold():
    with Hosts():
        print('created', flush=True)
        signal.pause()

try:
    interruptible(hold)
except KeyboardInterrupt:
    print('removed')
'''


def namespaces_of(pid):
    return [path.name for path in Path('/run/netns').glob(f'rhs_isac-{pid}-*')]


@pytest.fixture
def hold():
    """Function that starts a process with hosts; skips the test where they are unavailable."""
    started = []

    def start():
        process = subprocess.Popen(
            [sys.executable, '-c', HOLD], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, cwd=FOLDER)
        started.append(process)
        if process.stdout.readline() != 'created\n':
            _, err = process.communicate(timeout=60)
            if 'NamespacesUnavailable' in err:
                pytest.skip(f'no network namespaces here: {err.splitlines()[-1]}')
            raise AssertionError(err)
        return process
    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()


@pytest.fixture
def files(small_files):
    return ['--config', str(small_files / 'scenario.yaml'),
            '--codebook', str(small_files / 'first.yaml')]


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_removes_all_namespaces(hold, number):
    process = hold()
    assert len(namespaces_of(process.pid)) == 7
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert (out, err) == ('removed\n', '')
    assert not namespaces_of(process.pid)


def test_an_outage_passes_and_namespaces_of_a_killed_run_are_removed(hold, files, tmp_path):
    killed = hold()
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert namespaces_of(killed.pid)
    done = subprocess.Popen(
        [sys.executable, '-m', 'system.hosts', '--pull', 'channel', '--seconds', '1',
         '--json', str(tmp_path / 'figures.json'), *files],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=FOLDER)
    out, err = done.communicate(timeout=120)
    figures = json.loads((tmp_path / 'figures.json').read_text(encoding='utf-8'))
    (outage,) = figures['outages']
    assert done.returncode == 0, out + err
    assert figures['passed']
    assert outage['host'] == 'channel'
    assert outage['recovery_s'] <= 3.0
    assert outage['before'] > 0
    assert figures['wrong_publications'] == 0
    # Every host has used its link.
    assert min(figures['packets'].values()) > 100
    assert not namespaces_of(killed.pid)
    assert not namespaces_of(done.pid)


def test_the_trial_is_skipped_without_the_command_ip(files, monkeypatch, capsys):
    monkeypatch.setenv('PATH', '/nonexistent')
    for name in ('ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'RMW_IMPLEMENTATION',
                 'FASTDDS_BUILTIN_TRANSPORTS', 'FASTRTPS_DEFAULT_PROFILES_FILE'):
        # monkeypatch restores what the command sets.
        monkeypatch.setenv(name, os.environ.get(name, ''))
    assert main(files) == SKIPPED
    assert 'skipped' in capsys.readouterr().err


def test_invalid_arguments_are_rejected(capsys):
    for arguments in (['--pull', 'radio'], ['--seconds', '0'], ['--users', '0'],
                      ['--json', '/nonexistent/figures.json'], ['--config', '/none.yaml']):
        with pytest.raises(SystemExit):
            main(arguments)
        assert 'error: argument' in capsys.readouterr().err
