"""The hosts with their nodes, and the commands that create, disconnect and remove them.

A host is a network namespace. A pair of virtual Ethernet devices connects each host to a bridge in
another namespace, so that the machine's own network is not touched.
"""

import re
from collections.abc import Callable, Iterable

from rhs_isac_ros.protocol.presences import SILENCE_S
from rhs_isac_ros.ros.roster import ROSTER

_OTHERS: dict[str, tuple[str, ...]] = {
    'surface': ('rhs_controller',),
    'channel': ('channel',),
    'positioner': ('positioner', 'transmission'),
    'users': ('user',),
}
HOSTS = {'base_station': tuple(
    name for name in ROSTER if name not in sum(_OTHERS.values(), ())), **_OTHERS}
# Host of the observer, which is never disconnected.
OBSERVER = 'observer'
SWITCH = 'switch'
# Nodes that wait for a node of the disconnected host.
WAITING: dict[str, tuple[str, ...]] = {
    'base_station': ('user',),
    'surface': ('bs',),
    'channel': ('bs', 'user'),
    'positioner': ('bs',),
    'users': (),
}
# Time after which bs misses announcements, and after which Fast DDS removes an unreachable node
# from the graph; users receive no announcements and rely on the graph [s].
_MISSED_AFTER_S = {'bs': SILENCE_S, 'user': 20.0}
# Maximum time from then until a node reports that it is waiting [s].
_REPORT_DELAY_S = 3.0

_PREFIX = 'rhs_isac'
_NAME = re.compile(rf'{_PREFIX}-(\d+)-\w+')
# Reserved for tests of network devices (RFC 2544).
_NETWORK = '198.18.0'

Command = tuple[str, ...]


def host_of(node: str) -> str:
    """Return the host of a node; the nodes of users are ``user_1`` and so on.

    Raises
    ------
    ValueError
        If the node is on none of the hosts.
    """
    kind = 'user' if node.startswith('user_') else node
    for host, nodes in HOSTS.items():
        if kind in nodes:
            return host
    raise ValueError(f'node: {node!r}, expected one of {sum(HOSTS.values(), ())}')


def namespace(pid: int, host: str) -> str:
    """Return the name of the network namespace of a host, unique for each process."""
    return f'{_PREFIX}-{pid}-{host}'


def stale(namespaces: Iterable[str], is_running: Callable[[int], bool]) -> list[str]:
    """Return the namespaces that terminated processes have left behind.

    Parameters
    ----------
    namespaces
        Names of all network namespaces of the machine.
    is_running
        Callable that takes the id of a process and returns whether it is running.
    """
    return [name for name in namespaces
            if (match := _NAME.fullmatch(name)) and not is_running(int(match[1]))]


def create(pid: int) -> list[Command]:
    """Return the commands that create all hosts and connect them.

    All commands but those that create namespaces act inside of them.
    """
    switch = namespace(pid, SWITCH)
    commands: list[Command] = [
        *(('ip', 'netns', 'add', namespace(pid, name)) for name in (SWITCH, *addresses())),
        # Without a multicast querier, a snooping bridge does not forward multicast packets.
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
    """Return the IPv4 addresses of all hosts, including the observer's, in one network."""
    return {host: f'{_NETWORK}.{number}'
            for number, host in enumerate((*HOSTS, OBSERVER), start=1)}


def port(host: str) -> str:
    """Return the name of the device that connects the bridge with a host."""
    # Linux limits names of devices to 15 characters.
    return f'to_{host}'[:15]


def set_link(pid: int, host: str, up: bool) -> Command:
    """Return the command that connects a host with the bridge, or disconnects it."""
    return ('ip', '-n', namespace(pid, SWITCH), 'link', 'set', port(host), 'up' if up else 'down')


def command_prefix(pid: int, node: str) -> list[str]:
    """Return the prefix with which a command runs on the host of a node."""
    return ['ip', 'netns', 'exec', namespace(pid, host_of(node))]


def waiting(host: str, seconds: float) -> tuple[str, ...]:
    """Return the nodes that must report that they wait for a host, in an outage of `seconds`."""
    return tuple(node for node in WAITING[host]
                 if seconds >= _MISSED_AFTER_S[node] + _REPORT_DELAY_S)
