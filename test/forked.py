"""Executables as copies of a process that has imported them and never used ROS."""

import contextlib
import ctypes
import gc
import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

from rhs_isac_ros.executables import EXECUTABLES
from rhs_isac_ros.support.exits import exit_code_of, on_end_signals

# Option of prctl: the kernel ends a process with a signal when its parent dies.
PR_SET_PDEATHSIG = 1

FORKS = multiprocessing.get_context('forkserver')
# Nodes import parts of SciPy when they first need them, which takes longer than most cycles.
FORKS.set_forkserver_preload([
    'scipy.optimize', 'scipy.spatial', 'scipy.special', *(
        f'rhs_isac_ros.nodes.{name}' for name, package in EXECUTABLES.items()
        if package == 'nodes')])


def run_executable(command, log, environment, attributes):
    """Run an executable in this process, a new fork, as its command would, and exit.

    Output is appended to `log`. The module of the executable gets `attributes`. A signal results
    in the exit code 0, even before the executable handles it.
    """
    # Collections then leave the memory alone that the process shares with its parent.
    gc.freeze()
    on_end_signals(lambda number, _: sys.exit(0))
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    os.setsid()
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666), 1)
    os.dup2(1, 2)
    os.environ.clear()
    os.environ.update(environment)
    name = Path(command[0]).name
    # Set the name that `ps` and `top` show.
    Path('/proc/self/comm').write_text(name, encoding='ascii')
    sys.argv = list(command)
    module = importlib.import_module(f'rhs_isac_ros.nodes.{name}')
    vars(module).update(attributes)
    sys.exit(exit_code_of(module.main, program=name))


class Forked:
    """The process of a command, which starts in a tenth of the time that a program needs.

    It has the interface of `subprocess.Popen`.
    """

    def __init__(self, command, log, environment, attributes=None):
        self._command = command
        self._process = FORKS.Process(
            target=run_executable, args=(command, log, environment, attributes or {}))
        self._process.start()

    @property
    def pid(self):
        return self._process.pid

    def poll(self):
        return self._process.exitcode

    def wait(self, timeout=None):
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired(self._command, timeout)
        return self.poll()

    def send_signal(self, number):
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)
