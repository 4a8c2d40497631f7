"""Executables of the package as child processes, which never outlive their parent."""

import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_prefix

# Signals sent in this order until all processes end, and the time to wait for the exit [s].
_STOP_SIGNALS = ((signal.SIGINT, 5.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 2.0))
_STOP_POLL_S = 0.01


def with_parent(command: Sequence[str]) -> list[str]:
    """Return a command that runs another one, which ends with SIGTERM if this process dies."""
    # The shell ends if this process died before the kernel was asked for the signal.
    return ['setpriv', '--pdeathsig', 'TERM', 'sh', '-c', '[ $PPID = "$0" ] && exec "$@"',
            str(os.getpid()), *command]


class Processes:
    """A context manager that runs executables of this package and ends them on exit.

    Their output goes to ``<name>.log`` in the directory `logs`; `environment` adds variables.
    """

    def __init__(self, logs: Path, environment: Mapping[str, str]) -> None:
        self._logs = logs
        self._environment = {**os.environ, **environment}
        # The variable gives the enclave of this process, but each node has its own enclave.
        self._environment.pop('ROS_SECURITY_ENCLAVE_OVERRIDE', None)
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._commands: dict[str, list[str]] = {}

    def start(
            self, executable: str, name: str = '', process: str = '', namespace: str = '',
            **parameters: Any) -> None:
        """Start an executable with ROS parameters.

        By default, the node has the name of the executable, and the process has the name of the
        node, after that of a namespace. Processes of nodes with the same name need different
        names.
        """
        program = Path(get_package_prefix('rhs_isac_ros')) / 'lib' / 'rhs_isac_ros' / executable
        command = [str(program), '--ros-args']
        # Only a given name is remapped, because an executable may have several nodes.
        if name:
            command += ['-r', f'__node:={name}']
        if namespace:
            command += ['-r', f'__ns:=/{namespace}']
        name = process or f'{namespace}_{name or executable}'.lstrip('_')
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ['-p', f'{key}:={text}']
        self._commands[name] = command
        self._spawn(name)

    def _spawn(self, name: str) -> None:
        command, log = self._commands[name], self._logs / f'{name}.log'
        with open(log, 'ab') as stream:
            self._running[name] = subprocess.Popen(
                with_parent(command), stdin=subprocess.DEVNULL, stdout=stream, stderr=stream,
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
