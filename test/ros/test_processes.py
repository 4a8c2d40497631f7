"""Executables as child processes, and their end with their parent."""

import gc
import os
import select
import signal
import subprocess
import sys
import warnings
from multiprocessing.context import ForkProcess
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix
from system.trial_processes import TrialProcesses

from rhs_isac_ros.executables import PARENT_ID
from rhs_isac_ros.ros import processes
from rhs_isac_ros.ros.roster import UNIQUE

TIMEOUT_S = 60.0
# A parent that starts two nodes and prints their process ids.
PARENT = """
import signal, sys
from pathlib import Path
from rhs_isac_ros.ros.processes import Processes
with Processes(Path(sys.argv[1]), {'ROS_LOG_DIR': sys.argv[1]}) as children:
    children.start('visualizer')
    children.start('rhs_controller')
    print(*(child.pid for child in children._running.values()), flush=True)
    signal.pause()
"""
# Forks a node, which it kills, and one that ends by itself; prints their exit codes.
FORKS = """
import os, sys
from pathlib import Path
from rhs_isac_ros.ros.processes import Processes
with Processes(Path(sys.argv[1]), {'ROS_LOG_DIR': sys.argv[1]}, fork=True) as children:
    children.start('visualizer', 'viewer')
    viewer = children._running['viewer']
    while 'serving' not in children.log('viewer'):
        assert viewer.poll() is None, children.log('viewer')
    print(Path(f'/proc/{viewer.pid}/comm').read_text().strip(),
          os.getsid(viewer.pid) == viewer.pid)
    viewer.send_signal(9)
    children.start('bs', rest_s=-1.0)
    children.start('user', unknown=1)
    children.start('channel')
    while len(children.ended()) < 3:
        assert children.ended().get('channel') is None
    print(children.ended())
    channel = children._running['channel']
print(channel.poll())
"""


def until_ended(descriptors):
    """Wait for the end of processes, given as file descriptors that become readable then."""
    for descriptor in descriptors:
        assert select.select([descriptor], [], [], TIMEOUT_S)[0]
        os.close(descriptor)


def test_no_child_survives_a_parent_that_is_killed(tmp_path):
    """The parent dies while its children start."""
    with subprocess.Popen([sys.executable, '-c', PARENT, tmp_path], stdout=subprocess.PIPE,
                          text=True) as parent:
        children = [os.pidfd_open(int(pid)) for pid in parent.stdout.readline().split()]
        assert len(children) == 2
        parent.send_signal(signal.SIGKILL)
        until_ended(children)


def test_no_node_survives_a_demonstration_that_is_killed(tmp_path):
    program = Path(get_package_prefix('rhs_isac_ros')) / 'lib' / 'rhs_isac_ros' / 'demo'
    with subprocess.Popen(
            [program, '--cycles', '1000000'], cwd=tmp_path, stderr=subprocess.PIPE, text=True,
            env={**os.environ, 'TMPDIR': str(tmp_path)}) as demo:
        # The first line follows the start of all nodes.
        assert demo.stderr.readline().startswith('network started')
        folder = f'/proc/{demo.pid}/task/{demo.pid}/children'
        with open(folder, encoding='ascii') as file:
            children = [os.pidfd_open(int(pid)) for pid in file.read().split()]
        assert len(children) == len(UNIQUE) + 2
        demo.send_signal(signal.SIGKILL)
        until_ended(children)


def test_a_fork_is_a_process_with_its_own_name_session_log_and_exit_code(tmp_path):
    done = subprocess.run([sys.executable, '-c', FORKS, tmp_path],
                          capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.stdout.splitlines() == [
        'visualizer True', "{'viewer': -9, 'bs': 2, 'user': 2}", '0'], done.stderr
    assert (tmp_path / 'bs.log').read_text().startswith('bs: error: rest_s: ')
    assert 'argument -p: unknown: unknown parameter' in (tmp_path / 'user.log').read_text()


def test_a_fork_of_a_process_with_threads_causes_no_warning(tmp_path, monkeypatch):
    """Python 3.12 and newer warn; here, a warning is an error."""
    monkeypatch.setattr(ForkProcess, 'start', lambda self: warnings.warn(
        'multi-threaded', DeprecationWarning, stacklevel=2))
    processes._Fork(['bs'], tmp_path / 'bs.log', {})
    gc.unfreeze()


def test_a_child_whose_parent_has_already_died_ends_before_it_starts(tmp_path):
    done = subprocess.run(
        [sys.executable, '-c', 'from rhs_isac_ros import executables; executables.bs()'],
        env={**os.environ, PARENT_ID: '1'}, capture_output=True, timeout=TIMEOUT_S, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b'', b'')


@pytest.mark.parametrize(('cores', 'available_kb', 'discovery', 'expected'), [
    (2, 23_000_000, 'SUBNET', 80), (1, 23_000_000, 'SUBNET', 40), (64, 1_000_000, 'SUBNET', 15),
    (2, 23_000_000, 'LOCALHOST', 31), (2, 23_000_000, None, 31), (1, 1_000_000, None, 15)])
def test_cores_memory_and_discovery_limit_the_number_of_processes(
        cores, available_kb, discovery, expected, monkeypatch, tmp_path):
    (tmp_path / 'meminfo').write_text(
        f'MemTotal:       99999999 kB\nMemAvailable:   {available_kb} kB\n', encoding='ascii')
    monkeypatch.setattr(processes, '_MEMORY_FILE', tmp_path / 'meminfo')
    monkeypatch.setattr(os, 'sched_getaffinity', lambda pid: set(range(cores)))
    if discovery:
        monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', discovery)
    else:
        monkeypatch.delenv('ROS_AUTOMATIC_DISCOVERY_RANGE', raising=False)
    assert processes.max_processes() == expected


def test_cpu_time_and_memory_are_those_of_the_running_processes(tmp_path):
    with TrialProcesses(tmp_path, {'ROS_LOG_DIR': str(tmp_path)}) as children:
        children.start('rhs_controller')
        (child,) = children._running.values()
        while not (before_s := children.cpu_s()['rhs_controller']):
            assert child.poll() is None
        assert 0 < before_s <= children.cpu_s()['rhs_controller']
        assert children.memory_bytes()['rhs_controller'] > 1e6
        children.kill('rhs_controller')
        assert children.cpu_s() == children.memory_bytes() == {}
