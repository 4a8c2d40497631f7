"""The hosts of a trial: network namespaces that a bridge connects, and that are always removed.

A pair of virtual Ethernet devices connects each host to a bridge in a namespace of its own, so
that the machine's own network is not touched.
"""

import contextlib
import ctypes
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
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
    if shutil.which('ip') is None:
        raise NamespacesUnavailable('the command ip is missing (Debian: apt install iproute2)')
    _remove(lambda pid: not Path(f'/proc/{pid}').exists())
    try:
        try:
            _create()
        except subprocess.CalledProcessError as error:
            raise NamespacesUnavailable(
                f'{" ".join(error.cmd)}: {error.stderr.strip()}') from None
        yield
    finally:
        _remove(lambda pid: pid == os.getpid())


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


def _remove(is_chosen: Callable[[int], bool]) -> None:
    """Remove the hosts of runs with chosen process ids, and kill the processes on these hosts."""
    for name in sorted(path.name for path in _FOLDER.glob('*')):
        match = re.fullmatch(r'rhs_isac-(\d+)-\w+', name)
        if not match or not is_chosen(int(match[1])):
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


def packets() -> dict[str, int]:
    """Return the number of packets that the bridge has received from each host."""
    received = {port['ifname']: int(port['stats64']['rx']['packets'])
                for port in json.loads(_ip('-s', '-j', 'link', host=_SWITCH))}
    return {host: received[_port(host)] for host in HOSTS}


def _namespace(host: str) -> str:
    return f'rhs_isac-{os.getpid()}-{host}'


def _port(host: str) -> str:
    # Linux limits names of devices to 15 characters.
    return f'to_{host}'[:15]


def _ip(*arguments: str, host: str = '') -> str:
    """Run the command ip, on a host if one is given, and return its output."""
    place = ('-n', _namespace(host)) if host else ()
    return subprocess.run(
        ('ip', *place, *arguments), stdin=subprocess.DEVNULL, capture_output=True, text=True,
        # Ctrl-C must not interrupt a command halfway.
        check=True, start_new_session=True).stdout
