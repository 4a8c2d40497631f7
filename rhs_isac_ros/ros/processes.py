"""Executables of the package as child processes, which never outlive their parent."""

import atexit
import gc
import importlib
import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from multiprocessing.context import ForkProcess
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_prefix

from rhs_isac_ros import executables
from rhs_isac_ros.executables import PARENT_ID
from rhs_isac_ros.ros.startup import OVERRIDE

# Maximum number of users for which `network`, `demo` and the launch file start one node each. More
# users share one node, because every node takes memory, and CPU time even between cycles.
MAX_USER_NODES = 16
# Memory of the process of a node [bytes], and the number of nodes that a core can run.
_MEMORY_BYTES = 67_000_000
_PROCESSES_PER_CORE = 40
# With the discovery range LOCALHOST, a participant announces itself to this number of ports of the
# machine; further participants are not discovered by all others.
_MAX_LOCAL_PARTICIPANTS = 32
# Above domain 101, the ports may collide with the ephemeral ports of Linux.
_DOMAINS = 101
_MEMORY_FILE = Path('/proc/meminfo')
_RANGE, _LOCALHOST = 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST'
# Signals sent in turn until all processes end, each with the time to wait for the exit [s].
_STOP_SIGNALS = ((signal.SIGINT, 5.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 2.0))
_STOP_POLL_S = 0.01
# Modules that nodes import only after their start; ROS imports the first one for type supports.
_LATE_MODULES = ('rosidl_generator_py', 'scipy.fft', 'scipy.special')


def private_domain() -> dict[str, str]:
    """Return environment variables that isolate a network; existing values are kept."""
    return {'ROS_DOMAIN_ID': os.environ.get('ROS_DOMAIN_ID') or claim_domain(),
            _RANGE: _discovery_range()}


def _discovery_range() -> str:
    return os.environ.get(_RANGE, _LOCALHOST)


def claim_domain() -> str:
    """Return a ROS domain that no other process has claimed; the claim ends with this process."""
    for offset in range(_DOMAINS):
        domain = 1 + (os.getpid() + offset) % _DOMAINS
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            # An abstract name of Linux, which disappears with the socket.
            claim.bind(f'\0rhs_isac_ros.domain.{domain}')
        except OSError:
            claim.close()
        else:
            atexit.register(claim.close)
            return str(domain)
    raise RuntimeError(f'all {_DOMAINS} ROS domains are claimed by other processes')


def max_processes() -> int:
    """Return the number of nodes that this machine can run as separate processes.

    If discovery limits the number, one participant is left for the process that observes them.
    """
    fields = dict(line.split(':') for line in
                  _MEMORY_FILE.read_text(encoding='ascii').splitlines())
    available_bytes = 1024 * int(fields['MemAvailable'].split()[0])
    limits = [available_bytes // _MEMORY_BYTES,
              _PROCESSES_PER_CORE * len(os.sched_getaffinity(0))]
    if _discovery_range() == _LOCALHOST:
        limits.append(_MAX_LOCAL_PARTICIPANTS - 1)
    return min(limits)


def run_executable(
        command: Sequence[str], log: Path, environment: Mapping[str, str]) -> None:
    """Run an executable in this process, a new fork, as its command would, and exit.

    Output is appended to `log`. The caller has blocked SIGINT; this function unblocks it. SIGINT
    results in the exit code 0, even before the executable handles it.
    """
    signal.signal(signal.SIGINT, lambda number, _: sys.exit(0))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    os.setsid()
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666), 1)
    os.dup2(1, 2)
    os.environ.clear()
    os.environ.update(environment)
    name = Path(command[0]).name
    # Set the name that `ps` and `top` show.
    Path('/proc/self/comm').write_text(name, encoding='ascii')
    sys.argv = list(command)
    sys.exit(getattr(executables, name)())


class _Fork(ForkProcess):
    """A copy of this process that runs a node, with the modules that are already imported.

    `Processes` uses it like a `subprocess.Popen`.
    """

    def __init__(
            self, command: Sequence[str], log: Path, environment: Mapping[str, str]) -> None:
        super().__init__(name=Path(command[0]).name, target=run_executable,
                         args=(command, log, environment))
        for module in (f'rhs_isac_ros.nodes.{self.name}', *_LATE_MODULES):
            importlib.import_module(module)
        # The garbage collection of the node then ignores the objects shared with this process.
        gc.freeze()
        with warnings.catch_warnings():
            # Forking is safe: the two threads of the tracing library of ROS wait and hold no lock.
            warnings.simplefilter('ignore', DeprecationWarning)
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
            try:
                self.start()
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])

    def poll(self) -> int | None:
        """Return the exit code, negative after a signal, or None while the process runs."""
        return self.exitcode

    def send_signal(self, number: int) -> None:
        """Send a signal unless the process has ended."""
        if self.pid and self.poll() is None:
            os.kill(self.pid, number)


class Processes:
    """A context manager that runs executables of this package and ends them on exit.

    Their output goes to ``<name>.log`` in the directory `logs`; `environment` adds variables.

    Parameters
    ----------
    fork
        Whether to start executables as copies of this process, which must not have used ROS.
        Copies start in a tenth of the time, because they import nothing.
    """

    def __init__(
            self, logs: Path, environment: Mapping[str, str], fork: bool = False) -> None:
        self._logs, self._fork = logs, fork
        self._environment = {**os.environ, **environment, PARENT_ID: str(os.getpid())}
        # The variable gives the enclave of this process, but each node has its own enclave.
        self._environment.pop(OVERRIDE, None)
        self._running: dict[str, subprocess.Popen[bytes] | _Fork] = {}
        self._commands: dict[str, list[str]] = {}

    def start(
            self, executable: str, name: str = '', process: str = '', **parameters: Any) -> None:
        """Start an executable with ROS parameters.

        By default, the node has the name of the executable, and the process has the name of the
        node. Processes of nodes with the same name need different names.
        """
        program = Path(get_package_prefix('rhs_isac_ros')) / 'lib' / 'rhs_isac_ros' / executable
        command = [str(program), '--ros-args']
        # Only a given name is remapped, because an executable may have several nodes.
        if name:
            command += ['-r', f'__node:={name}']
        name = process or name or executable
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ['-p', f'{key}:={text}']
        self._commands[name] = command
        self._spawn(name)

    def _spawn(self, name: str) -> None:
        command, log = self._commands[name], self._logs / f'{name}.log'
        # The log of a process exists from its start.
        log.touch()
        if self._fork:
            self._running[name] = _Fork(command, log, self._environment)
            return
        with open(log, 'ab') as stream:
            self._running[name] = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream,
                env=self._environment, start_new_session=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all processes that were started."""
        return tuple(self._commands)

    def ended(self) -> dict[str, int]:
        """Return the exit codes, by name, of processes that have ended."""
        codes = {name: process.poll() for name, process in self._running.items()}
        return {name: code for name, code in codes.items() if code is not None}

    def log(self, name: str) -> str:
        """Return the output of a process."""
        return (self._logs / f'{name}.log').read_text(encoding='utf-8', errors='replace')

    def interrupt(self) -> None:
        """Send SIGINT to all processes, without waiting for them to end."""
        for process in self._running.values():
            process.send_signal(signal.SIGINT)

    def stop(self) -> None:
        """End all processes, with signals of increasing severity."""
        for number, timeout_s in _STOP_SIGNALS:
            for process in self._running.values():
                process.send_signal(number)
            end_s = time.monotonic() + timeout_s
            while len(self.ended()) < len(self._running) and time.monotonic() < end_s:
                time.sleep(_STOP_POLL_S)

    def __enter__(self) -> 'Processes':
        """Return `self`."""
        return self

    def __exit__(self, *error: object) -> None:
        """End all processes, even if Ctrl-C is pressed again."""
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self.stop()
        finally:
            signal.signal(signal.SIGINT, before)
