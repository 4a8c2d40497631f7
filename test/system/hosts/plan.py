"""Which node lives on which host, and the commands that make, cut and remove the hosts.

A host is a network namespace. A virtual cable leads from each to a bridge in one more namespace,
so that nothing of the machine's own network is touched.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable
from pathlib import Path

HOSTS: dict[str, tuple[str, ...]] = {
    'base_station': ('bs', 'optimizer'),
    'surface': ('rhs_controller',),
    'channel': ('channel',),
    'positioner': ('positioner', 'transmission'),
    'users': ('user',),
}
# Watches from a host of its own, whose link stays.
OBSERVER = 'observer'
SWITCH = 'switch'
# Who misses whom: the nodes that wait for one of a host whose link is pulled.
WAITERS: dict[str, tuple[str, ...]] = {
    'base_station': ('user',),
    'surface': ('bs',),
    'channel': ('bs', 'user'),
    'positioner': ('bs',),
    'users': (),
}
# What Fast DDS takes if no profile says otherwise [s].
_USUAL_LEASE_S = 20.0

_PREFIX = 'rhs_isac'
_NAME = re.compile(rf'{_PREFIX}-(\d+)-\w+')
# For tests of networks (RFC 2544): in no one's real network.
_NETWORK = '198.18.0'

Command = tuple[str, ...]


def host_of(node: str) -> str:
    """Return the host of a node.

    Parameters
    ----------
    node
        Name of the node; users are ``user_1`` and so on.

    Returns
    -------
    str
        Name of the host.

    Raises
    ------
    ValueError
        If it lives on none.
    """
    kind = 'user' if node.startswith('user_') else node
    for host, nodes in HOSTS.items():
        if kind in nodes:
            return host
    raise ValueError(f'node: {node!r}, expected one of {sum(HOSTS.values(), ())}')


def namespace(pid: int, host: str) -> str:
    """Return the network namespace of a host; runs of other processes have others.

    Parameters
    ----------
    pid
        Process that makes it.
    host
        Name of the host, of the observer's or of the switch.

    Returns
    -------
    str
        Name of the namespace.
    """
    return f'{_PREFIX}-{pid}-{host}'


def stale(namespaces: Iterable[str], runs: Callable[[int], bool]) -> list[str]:
    """Return what runs have left behind that could not clean up.

    Parameters
    ----------
    namespaces
        Names of all network namespaces of the machine.
    runs
        Tells whether there is a process of a number.

    Returns
    -------
    list of str
        Those namespaces of ours whose process is gone.
    """
    return [name for name in namespaces
            if (match := _NAME.fullmatch(name)) and not runs(int(match[1]))]


def make(pid: int) -> list[Command]:
    """Return the commands that make all hosts and connect them.

    Parameters
    ----------
    pid
        Process that makes them.

    Returns
    -------
    list of tuple
        Commands; all but the first few act inside of namespaces.
    """
    switch = namespace(pid, SWITCH)
    commands: list[Command] = [
        *(('ip', 'netns', 'add', namespace(pid, name)) for name in (SWITCH, *addresses())),
        # Without snooping, the bridge floods multicast: nobody on it asks for memberships.
        ('ip', '-n', switch, 'link', 'add', 'bridge', 'type', 'bridge', 'mcast_snooping', '0'),
        ('ip', '-n', switch, 'link', 'set', 'bridge', 'up'),
    ]
    for name, address in addresses().items():
        host = namespace(pid, name)
        commands += [
            ('ip', '-n', switch, 'link', 'add', port(name), 'type', 'veth',
             'peer', 'name', 'eth0', 'netns', host),
            ('ip', '-n', switch, 'link', 'set', port(name), 'master', 'bridge', 'up'),
            ('ip', '-n', host, 'address', 'add', f'{address}/24', 'dev', 'eth0'),
            ('ip', '-n', host, 'link', 'set', 'lo', 'up'),
            ('ip', '-n', host, 'link', 'set', 'eth0', 'up'),
        ]
    return commands


def addresses() -> dict[str, str]:
    """Return the addresses of the hosts, the observer's among them.

    Returns
    -------
    dict
        IPv4 addresses by host, all in one network.
    """
    return {host: f'{_NETWORK}.{number}'
            for number, host in enumerate((*HOSTS, OBSERVER), start=1)}


def port(host: str) -> str:
    """Return the name of the switch's end of a host's cable.

    Parameters
    ----------
    host
        Name of the host.

    Returns
    -------
    str
        Name of the device.
    """
    # Linux takes 15 characters.
    return f'to_{host}'[:15]


def link(pid: int, host: str, up: bool) -> Command:
    """Return the command that pulls a host's cable out of the switch, or puts it back.

    Parameters
    ----------
    pid
        Process that has made it.
    host
        Name of the host.
    up
        Whether it is to be connected.

    Returns
    -------
    tuple
        The command.
    """
    return ('ip', '-n', namespace(pid, SWITCH), 'link', 'set', port(host), 'up' if up else 'down')


def inside(pid: int, node: str) -> list[str]:
    """Return what to put before a command to run it on the host of a node.

    Parameters
    ----------
    pid
        Process that has made the hosts.
    node
        Name of the node.

    Returns
    -------
    list of str
        The beginning of a command.
    """
    return ['ip', 'netns', 'exec', namespace(pid, host_of(node))]


def lease_s(profile: Path | None) -> float:
    """Return after how long without a word Fast DDS takes a participant for gone.

    Parameters
    ----------
    profile
        XML file of its profiles, or None.

    Returns
    -------
    float
        The time [s].
    """
    if profile is None:
        return _USUAL_LEASE_S
    for element in ElementTree.parse(profile).iter():
        if element.tag.rpartition('}')[2] == 'leaseDuration':
            parts = {child.tag.rpartition('}')[2]: float(child.text) for child in element}
            return parts.get('sec', 0.0) + 1e-9 * parts.get('nanosec', 0.0)
    return _USUAL_LEASE_S
