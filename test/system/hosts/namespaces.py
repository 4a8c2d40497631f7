"""The hosts of a trial: network namespaces that a bridge connects, and that are always removed.

A pair of virtual Ethernet devices connects each host to a bridge in a namespace of its own, so
that the machine's own network is not touched.
"""

import contextlib
import ctypes
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

from rhs_isac_ros.ros.roster import ROSTER

_OTHERS: dict[str, tuple[str, ...]] = {
    'surface': ('rhs_controller',), 'channel': ('channel',),
    'positioner': ('positioner', 'transmission'), 'users': ('user',)}
# Nodes by host; the base station's host runs all nodes without another one.
HOSTS = {'base_station': tuple(
    name for name in ROSTER if name not in sum(_OTHERS.values(), ())), **_OTHERS}
# Host of the observer, which is never disconnected.
OBSERVER = 'observer'
_SWITCH = 'switch'
# In a network that is reserved for tests of network devices (RFC 2544).
ADDRESSES = {host: f'198.18.0.{number}' for number, host in enumerate((*HOSTS, OBSERVER), start=1)}
_FOLDER = Path('/run/netns')
_CLONE_NEWNET = 0x40000000


class NamespacesUnavailable(RuntimeError):
    """The process may not create network namespaces on this machine."""


@contextlib.contextmanager
def connected_hosts() -> Iterator[None]:
    """Create the hosts of this process, and remove them with all processes on them.

    First removes the hosts that killed runs have left behind.
    """
    _remove()
    try:
        try:
            _create()
        except (OSError, subprocess.CalledProcessError) as error:
            raise NamespacesUnavailable(getattr(error, 'stderr', error)) from None
        yield
    finally:
        _remove()


def _create() -> None:
    for name in (_SWITCH, *ADDRESSES):
        _ip('netns', 'add', _namespace(name))
    # Without a multicast querier, a snooping bridge does not forward multicast packets.
    _ip('link', 'add', 'bridge', 'type', 'bridge', 'mcast_snooping', '0', host=_SWITCH)
    _ip('link', 'set', 'bridge', 'up', host=_SWITCH)
    for name, address in ADDRESSES.items():
        _ip('link', 'add', _port(name), 'type', 'veth', 'peer', 'name', 'eth0',
            'netns', _namespace(name), host=_SWITCH)
        _ip('link', 'set', _port(name), 'master', 'bridge', 'up', host=_SWITCH)
        _ip('address', 'add', f'{address}/24', 'dev', 'eth0', host=name)
        for device in ('lo', 'eth0'):
            _ip('link', 'set', device, 'up', host=name)


def _remove() -> None:
    """Remove the hosts of this run and of those that have ended, with the processes on them."""
    for name in sorted(path.name for path in _FOLDER.glob('rhs_isac-*-*')):
        owner = name.split('-')[1]
        if owner != str(os.getpid()) and Path(f'/proc/{owner}').exists():
            continue
        # Another run may be removing the namespace already.
        with contextlib.suppress(subprocess.CalledProcessError):
            for pid in map(int, _ip('netns', 'pids', name).split()):
                # This process itself may have moved there.
                if pid != os.getpid():
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.kill(pid, signal.SIGKILL)
            _ip('netns', 'del', name)


def enter(host: str) -> None:
    """Move this thread, and the threads that it starts later, to a host."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open(_FOLDER / _namespace(host), 'rb') as file:
        if libc.setns(file.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f'setns to the host {host}')


def command_prefix(node: str) -> list[str]:
    """Return the prefix with which a command runs on the host of a node, such as user_1."""
    (host,) = (host for host, nodes in HOSTS.items() if re.sub(r'_\d+$', '', node) in nodes)
    return ['ip', 'netns', 'exec', _namespace(host)]


def connect(host: str, up: bool) -> None:
    """Restore the link of a host, or take it down."""
    _ip('link', 'set', _port(host), 'up' if up else 'down', host=_SWITCH)


def _namespace(host: str) -> str:
    return f'rhs_isac-{os.getpid()}-{host}'


def _port(host: str) -> str:
    # Linux limits names of devices to 15 characters.
    return f'to_{host}'[:15]


def _ip(*arguments: str, host: str = '') -> str:
    """Run the command ip, on a host if one is given, and return its output."""
    place = ('-n', _namespace(host)) if host else ()
    # Ctrl-C must not interrupt a command halfway.
    return subprocess.run(
        ('ip', *place, *arguments), stdin=subprocess.DEVNULL, capture_output=True, text=True,
        check=True, start_new_session=True).stdout
