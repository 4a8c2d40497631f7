"""Network namespaces on this machine: created, entered, disconnected and always removed."""

import contextlib
import ctypes
import json
import os
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from system.hosts import plan

_FOLDER = Path('/run/netns')
_CLONE_NEWNET = 0x40000000


class NamespacesUnavailable(RuntimeError):
    """The process may not create network namespaces on this machine."""


class Hosts:
    """All hosts of a run: a context manager that creates and removes them.

    Processes that still run on a host when it is removed are killed.

    Raises
    ------
    NamespacesUnavailable
        On entering, if the hosts cannot be created.
    """

    def __init__(self) -> None:
        self._pid = os.getpid()

    def __enter__(self) -> 'Hosts':
        """Remove the hosts of killed runs, then create those of this run."""
        if shutil.which('ip') is None:
            raise NamespacesUnavailable(
                'the command ip is missing (Debian: apt install iproute2)')
        for name in plan.stale(_names(), _is_running):
            _remove(name)
        try:
            for command in plan.create(self._pid):
                _run(command)
        except subprocess.CalledProcessError as error:
            self._remove_all()
            raise NamespacesUnavailable(
                f'{" ".join(error.cmd)}: {error.stderr.strip()}') from None
        except BaseException:
            self._remove_all()
            raise
        return self

    def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None,
            traceback: TracebackType | None) -> None:
        """Remove the hosts."""
        self._remove_all()

    def _remove_all(self) -> None:
        for name in _names():
            if name.startswith(plan.namespace(self._pid, '')):
                _remove(name)

    def enter(self, host: str) -> None:
        """Move this thread, and the threads that it starts later, to a host.

        Raises
        ------
        OSError
            If this process may not enter the namespace.
        """
        libc = ctypes.CDLL(None, use_errno=True)
        with open(_FOLDER / plan.namespace(self._pid, host), 'rb') as file:
            if libc.setns(file.fileno(), _CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), f'setns to the host {host}')

    def command_prefix(self, node: str) -> list[str]:
        """Return the prefix with which a command runs on the host of a node."""
        return plan.command_prefix(self._pid, node)

    def disconnect(self, host: str) -> None:
        """Take the link of a host down."""
        _run(plan.set_link(self._pid, host, up=False))

    def reconnect(self, host: str) -> None:
        """Restore the link of a host."""
        _run(plan.set_link(self._pid, host, up=True))

    def packets(self) -> dict[str, int]:
        """Return the number of packets that the bridge has received from each host."""
        text = _run(('ip', '-n', plan.namespace(self._pid, plan.SWITCH), '-s', '-j', 'link'))
        received = {port['ifname']: port['stats64']['rx']['packets']
                    for port in json.loads(text)}
        return {host: received[plan.port(host)] for host in plan.HOSTS}


def _is_running(pid: int) -> bool:
    return Path(f'/proc/{pid}').exists()


def _names() -> list[str]:
    return sorted(path.name for path in _FOLDER.glob('*'))


def _remove(name: str) -> None:
    """Kill the processes in a namespace and remove it, unless it is being removed already."""
    with contextlib.suppress(subprocess.CalledProcessError):
        for pid in _run(('ip', 'netns', 'pids', name)).split():
            # This process itself may have moved there.
            if int(pid) != os.getpid():
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(int(pid), signal.SIGKILL)
        _run(('ip', 'netns', 'del', name))


def _run(command: plan.Command) -> str:
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True,
        # Ctrl-C must not interrupt a command halfway.
        start_new_session=True).stdout


def interruptible(callback: Callable[[], int]) -> int:
    """Call a function and return its result; SIGTERM and SIGHUP interrupt it like Ctrl-C.

    Signals after the first are ignored, so that the function can clean up.
    """
    def interrupt(number: int, frame: object) -> None:
        for other in before:
            signal.signal(other, signal.SIG_IGN)
        raise KeyboardInterrupt

    before: dict[int, Any] = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        before[number] = signal.signal(number, interrupt)
    try:
        return callback()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
