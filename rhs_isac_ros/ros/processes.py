"""Starting executables of the package as processes, and never leaving one behind."""

import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from ament_index_python.packages import get_package_prefix

_PR_SET_PDEATHSIG = 1
# Looked up here: between fork and exec, no library may be loaded.
_PRCTL = ctypes.CDLL(None).prctl
# Signals to end a process with, each with the time that it gets to obey [s].
_ENDINGS = ((signal.SIGINT, 5.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 2.0))


def private_domain() -> dict[str, str]:
    """Return environment variables that keep a network to itself, unless they are set already.

    Returns
    -------
    dict
        ``ROS_DOMAIN_ID``, different for most processes, and ``ROS_AUTOMATIC_DISCOVERY_RANGE``.
    """
    return {
        # Above 101, the ports of a domain may meet those that Linux gives to clients.
        'ROS_DOMAIN_ID': os.environ.get('ROS_DOMAIN_ID', str(1 + os.getpid() % 101)),
        'ROS_AUTOMATIC_DISCOVERY_RANGE':
            os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST'),
    }


class Processes:
    """Executables of this package, each in a process; a context manager that ends them.

    Parameters
    ----------
    logs
        Directory for what each process prints: one file ``<name>.log`` each.
    environment
        Environment variables to set for all of them.
    within
        Function of a node's name that returns what to put before its command, such as
        ``ip netns exec lab``; by default nothing.
    """

    def __init__(
            self, logs: Path, environment: Mapping[str, str],
            within: Callable[[str], Sequence[str]] = lambda name: ()) -> None:
        self._logs, self._within = logs, within
        self._environment = {**os.environ, **environment}
        self._running: dict[str, subprocess.Popen] = {}
        self._commands: dict[str, list[str]] = {}

    def start(self, executable: str, name: str = '', **parameters: Any) -> None:
        """Start an executable.

        Parameters
        ----------
        executable
            Which one.
        name
            Name of its node, where it differs.
        **parameters
            ROS parameters.
        """
        program = Path(get_package_prefix('rhs_isac_ros')) / 'lib' / 'rhs_isac_ros' / executable
        command = [str(program), '--ros-args']
        # Without a name, none is remapped: an executable may have many nodes.
        if name:
            command += ['-r', f'__node:={name}']
        name = name or executable
        command = [*self._within(name), *command]
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ['-p', f'{key}:={text}']
        self._commands[name] = command
        self._spawn(name, 'wb')

    def kill(self, name: str) -> None:
        """End a process with SIGKILL, as a crash or a pulled plug would.

        Parameters
        ----------
        name
            Name of its node.
        """
        process = self._running.pop(name)
        process.kill()
        process.wait()

    def restart(self, name: str) -> None:
        """Start a process again as it was started before; it goes on in the same log.

        Parameters
        ----------
        name
            Name of its node.
        """
        self._spawn(name, 'ab')

    def memory_bytes(self) -> dict[str, int]:
        """Return the resident memory of the processes.

        Returns
        -------
        dict
            Memory by name [bytes], of those that run.
        """
        page = os.sysconf('SC_PAGE_SIZE')
        result = {}
        for name, process in self._running.items():
            if process.poll() is None:
                pages = Path(f'/proc/{process.pid}/statm').read_text(encoding='ascii').split()[1]
                result[name] = int(pages) * page
        return result

    def _spawn(self, name: str, mode: str) -> None:
        with open(self._logs / f'{name}.log', mode) as log:
            self._running[name] = subprocess.Popen(
                self._commands[name], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                env=self._environment, start_new_session=True, preexec_fn=_end_with_parent)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes that were started."""
        return tuple(self._commands)

    def ended(self) -> dict[str, int]:
        """Return the processes that have ended by themselves.

        Returns
        -------
        dict
            Exit codes by name.
        """
        codes = {name: process.poll() for name, process in self._running.items()}
        return {name: code for name, code in codes.items() if code is not None}

    def log(self, name: str) -> str:
        """Return what a process has printed.

        Parameters
        ----------
        name
            Name of its node.

        Returns
        -------
        str
            The text.
        """
        return (self._logs / f'{name}.log').read_text(encoding='utf-8', errors='replace')

    def stop(self) -> None:
        """End all processes, politely first."""
        for ending, patience_s in _ENDINGS:
            running = [p for p in self._running.values() if p.poll() is None]
            for process in running:
                process.send_signal(ending)
            end_s = time.monotonic() + patience_s
            for process in running:
                try:
                    process.wait(max(end_s - time.monotonic(), 0.0))
                except subprocess.TimeoutExpired:
                    continue

    def __enter__(self) -> 'Processes':
        """Return itself."""
        return self

    def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None,
            traceback: TracebackType | None) -> None:
        """End all processes, even if the user presses Ctrl-C once more."""
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self.stop()
        finally:
            signal.signal(signal.SIGINT, before)


def _end_with_parent() -> None:
    """Have the kernel end this process when its parent dies, however that happens."""
    _PRCTL(_PR_SET_PDEATHSIG, signal.SIGTERM)
