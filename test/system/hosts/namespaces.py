"""Network namespaces on this machine: made, entered, cut and always removed."""

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


class NamespacesRefused(RuntimeError):
    """The caller may make no network namespaces on this machine."""


class Hosts:
    """All hosts of a run; a context manager that makes and removes them.

    Whatever runs on a host when it is removed is killed.

    Raises
    ------
    NamespacesRefused
        On entering, if they cannot be made.
    """

    def __init__(self) -> None:
        self._pid = os.getpid()

    def __enter__(self) -> 'Hosts':
        """Clean up after runs that were killed, then make the hosts."""
        if shutil.which('ip') is None:
            raise NamespacesRefused('there is no ip (Debian: apt install iproute2)')
        for name in plan.stale(_names(), _runs):
            _remove(name)
        try:
            for command in plan.make(self._pid):
                _run(command)
        except subprocess.CalledProcessError as error:
            self._remove_all()
            raise NamespacesRefused(
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
        """Move this thread, and those that it starts from now on, to a host.

        Parameters
        ----------
        host
            Name of the host.

        Raises
        ------
        OSError
            If that is not allowed.
        """
        libc = ctypes.CDLL(None, use_errno=True)
        with open(_FOLDER / plan.namespace(self._pid, host), 'rb') as file:
            if libc.setns(file.fileno(), _CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), f'setns to the host {host}')

    def inside(self, node: str) -> list[str]:
        """Return what to put before a command to run it on the host of a node.

        Parameters
        ----------
        node
            Name of the node.

        Returns
        -------
        list of str
            The beginning of a command.
        """
        return plan.inside(self._pid, node)

    def pull(self, host: str) -> None:
        """Pull the cable of a host.

        Parameters
        ----------
        host
            Name of the host.
        """
        _run(plan.link(self._pid, host, up=False))

    def put_back(self, host: str) -> None:
        """Put the cable of a host back.

        Parameters
        ----------
        host
            Name of the host.
        """
        _run(plan.link(self._pid, host, up=True))

    def packets(self) -> dict[str, int]:
        """Count what has come from each host to the switch.

        Returns
        -------
        dict
            Number of packets by host.
        """
        text = _run(('ip', '-n', plan.namespace(self._pid, plan.SWITCH), '-s', '-j', 'link'))
        received = {port['ifname']: port['stats64']['rx']['packets']
                    for port in json.loads(text)}
        return {host: received[plan.port(host)] for host in plan.HOSTS}


def _runs(pid: int) -> bool:
    return Path(f'/proc/{pid}').exists()


def _names() -> list[str]:
    return sorted(path.name for path in _FOLDER.glob('*'))


def _remove(name: str) -> None:
    """Remove a namespace with all that runs in it; one that goes at the same time is fine."""
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
        # Ctrl-C is for this process alone: half a command would be half a cable.
        start_new_session=True).stdout


def guarded(callback: Callable[[], int]) -> int:
    """Call a function that SIGTERM and SIGHUP interrupt like Ctrl-C, once, so that it cleans up.

    Parameters
    ----------
    callback
        The function.

    Returns
    -------
    int
        What it returns.
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
