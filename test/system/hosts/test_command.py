"""Real network namespaces, where they are allowed: a link is pulled, and nothing is left."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from system.hosts.command import SKIPPED, main

ROOT = Path(__file__).parents[3]
# Where Python finds the package `system`.
FOLDER = ROOT / 'test'
# Makes hosts, says so, and waits.
HOLD = '''
import signal
from system.hosts.namespaces import Hosts, guarded

def hold():
    with Hosts():
        print('made', flush=True)
        signal.pause()

try:
    guarded(hold)
except KeyboardInterrupt:
    print('cleaned')
'''


def namespaces_of(pid):
    return [path.name for path in Path('/run/netns').glob(f'rhs_isac-{pid}-*')]


@pytest.fixture
def hold():
    """Function that starts a process which holds hosts; skips where that is not allowed."""
    started = []

    def start():
        process = subprocess.Popen(
            [sys.executable, '-c', HOLD], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, cwd=FOLDER)
        started.append(process)
        if process.stdout.readline() != 'made\n':
            _, err = process.communicate(timeout=60)
            if 'NamespacesRefused' in err:
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
def test_a_signal_leaves_nothing_behind(hold, number):
    process = hold()
    assert len(namespaces_of(process.pid)) == 7
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert (out, err) == ('cleaned\n', '')
    assert not namespaces_of(process.pid)


def test_a_pulled_link_and_what_a_killed_run_left(hold, files, tmp_path):
    killed = hold()
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert namespaces_of(killed.pid)
    done = subprocess.Popen(
        [sys.executable, '-m', 'system.hosts', '--pull', 'channel', '--seconds', '1',
         '--json', str(tmp_path / 'figures.json'), *files],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=FOLDER)
    out, err = done.communicate(timeout=120)
    told = json.loads((tmp_path / 'figures.json').read_text(encoding='utf-8'))
    (pull,) = told['pulls']
    assert done.returncode == 0, out + err
    assert told['passed']
    assert pull['host'] == 'channel'
    assert pull['recovered_s'] <= 3.0
    assert pull['before'] > 0
    assert told['wrong_publications'] == 0
    # Every host has spoken through its cable.
    assert min(told['packets'].values()) > 100
    assert not namespaces_of(killed.pid)
    assert not namespaces_of(done.pid)


def test_where_there_is_no_ip_it_says_skipped(files, monkeypatch, capsys):
    monkeypatch.setenv('PATH', '/nonexistent')
    for name in ('ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'RMW_IMPLEMENTATION',
                 'FASTDDS_BUILTIN_TRANSPORTS', 'FASTRTPS_DEFAULT_PROFILES_FILE'):
        # Put back afterwards, whatever the command sets.
        monkeypatch.setenv(name, os.environ.get(name, ''))
    assert main(files) == SKIPPED
    assert 'skipped' in capsys.readouterr().err


def test_wrong_arguments_are_refused(capsys):
    for arguments in (['--pull', 'radio'], ['--seconds', '0'], ['--users', '0'],
                      ['--json', '/nonexistent/figures.json']):
        with pytest.raises(SystemExit):
            main(arguments)
        assert 'error: argument' in capsys.readouterr().err
    assert main(['--config', '/nonexistent.yaml']) == 2
