"""Executables as child processes, and their end with their parent."""

import os
import select
import signal
import subprocess
import sys

from system.trial_processes import TrialProcesses

TIMEOUT_S = 120.0
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
