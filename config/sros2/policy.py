"""Prints the permissions of the nodes for topics and services, as a policy for SROS2."""

import argparse
import posixpath
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from rhs_isac_ros.executables import missing_named

with missing_named('policy.py'):
    from rclpy.exceptions import InvalidNamespaceException
    from rclpy.validate_namespace import validate_namespace

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.cycle_log import ANSWERS
from rhs_isac_ros.monitoring.network_state import SCENE_RECEIVES
from rhs_isac_ros.positioning import Site, SiteError
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.node_surface import NodeSurface
from rhs_isac_ros.ros.parameters import TF
from rhs_isac_ros.ros.recording import recorded_topics
from rhs_isac_ros.ros.roster import MEMBERS, ROSTER, networks
from rhs_isac_ros.support.arguments import ArgumentParser, integer
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.exits import exit_code_of

# Topics that every rclpy node publishes, and services that it offers.
_RCLPY_TOPICS = ('/parameter_events', '/rosout')
_PARAMETER_SERVICES = (
    'describe_parameters', 'get_parameter_types', 'get_parameters', 'list_parameters',
    'set_parameters', 'set_parameters_atomically')
_OFFERED_SERVICES = tuple(
    f'~/{service}' for service in (*_PARAMETER_SERVICES, 'get_type_description'))
_CYCLE_SERVICES = (topics.PAUSE, topics.RESUME, topics.STEP)
_LOCATE_TOPICS = tuple(f'{topics.LOCATE}/_action/{name}' for name in ('feedback', 'status'))
_LOCATE_SERVICES = tuple(
    f'{topics.LOCATE}/_action/{name}' for name in ('cancel_goal', 'get_result', 'send_goal'))
# A tf2 buffer offers its frames through this service.
_TF_SERVICE = 'tf2_frames'
_GET_CODEBOOK = f'{topics.OPTIMIZER_NODE}/get_parameters'
_VERSION = '0.2.0'


class Permissions(NamedTuple):
    """Topics and services of a node.

    Names are relative to the namespace of the node or, if they begin with ``~``, to the node.

    Attributes
    ----------
    publish, subscribe
        Topics.
    reply, request
        Services that the node offers, and services that it calls.
    """

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = _OFFERED_SERVICES
    request: tuple[str, ...] = ()


# A network with one surface, whose scenario permissions do not depend on.
_ALONE = NodeSurface(Scenario())


def permissions(
        users: int, robots: Mapping[int, str] | None = None, is_simulated: bool = False,
        surface: NodeSurface = _ALONE, roles: Iterable[str] = ROSTER) -> dict[str, Permissions]:
    """Return the permissions that the nodes of a network may need, and no others.

    Parameters
    ----------
    users
        Number of users; they are numbered from 1.
    robots
        Topic of the odometry, or ``tf``, of each user that is a robot.
    is_simulated
        Whether the nodes follow the clock of a simulation.
    surface, roles
        Surface of the nodes in their site, and their roles; by default, those of a network with
        one surface.

    Returns
    -------
    dict
        Permissions by node. ``users`` is a node with all users, ``network`` the process of all
        nodes of the network or site. ``operator`` stands for all tools, which may read
        every topic, set parameters and pause cycles, except for ``replay``, which may publish
        every topic and replace the optimizer.
    """
    numbers = range(1, users + 1)
    nodes = {
        name if MEMBERS[name].is_unique else f'{name}_{number}': _of_member(
            name, numbers if MEMBERS[name].is_unique else [number], surface)
        for name in sorted(roles)
        for number in ((1,) if MEMBERS[name].is_unique else numbers)}
    if 'user' in roles:
        for user, source in (robots or {}).items():
            nodes[f'user_{user}'] = _with_robot(nodes[f'user_{user}'], source)
        nodes['users'] = _of_member('user', numbers, surface)
    head = {} if surface.name else {'network': Permissions(publish=_RCLPY_TOPICS)}
    nodes['network'] = _together({**nodes, **head})
    optimizer = topics.OPTIMIZER_NODE
    tools = {}
    if optimizer in roles:
        nodes['visualizer'] = Permissions(
            publish=(*sorted((topics.MARKERS, topics.TF, topics.TF_STATIC,
                              *_of_users(numbers, topics.PATH, topics.TRUE_PATH))),
                     *_RCLPY_TOPICS),
            subscribe=tuple(sorted(topics.NAMES[kind] for kind in SCENE_RECEIVES)))
        # It provides the recorded codebook, as an optimizer or to the one that is present, and
        # awaits the answers to the signals.
        tools['replay'] = _together({optimizer: nodes[optimizer], 'replay': Permissions(
            publish=tuple(recorded_topics()), reply=(),
            subscribe=tuple(topics.NAMES[kind] for kind in ANSWERS),
            request=tuple(f'{optimizer}/{service}' for service in _PARAMETER_SERVICES))})
    nodes |= {'operator': _operator(nodes, numbers), **tools}
    if is_simulated:
        return {name: allowed._replace(subscribe=(*allowed.subscribe, topics.CLOCK))
                for name, allowed in nodes.items()}
    return nodes


def _together(nodes: Mapping[str, Permissions]) -> Permissions:
    """Return the permissions of a process with several nodes."""
    return Permissions(*(
        tuple(sorted({name.replace('~', node) for node, allowed in nodes.items()
                      for name in getattr(allowed, right)})) for right in Permissions._fields))


def _of_member(name: str, users: Iterable[int], surface: NodeSurface) -> Permissions:
    """Return the permissions of a node of a role that serves some users."""
    member = MEMBERS[name]
    received = [f'{source.prefix}{topics.NAMES[source.kind]}' for source in surface.sources(
        member.role.RECEIVES if member.role else (), member.from_all)]
    if member.requires_of_site and surface.site:
        received.append(f'{surface.site_prefix}{topics.PRESENCE}')
    sent = {name for topic in member.sent for name in (
        _of_users(users, topic) if '{user}' in topic else (topic,))}
    return Permissions(
        publish=(*sorted(sent), *_RCLPY_TOPICS, *(_LOCATE_TOPICS if name == 'bs' else ())),
        subscribe=tuple(sorted({*member.announced, *received})),
        reply=(*_OFFERED_SERVICES,
               *((*_CYCLE_SERVICES, *_LOCATE_SERVICES) if name == 'bs' else ())),
        request=(_GET_CODEBOOK,) if member.has_codebook else ())


def _with_robot(allowed: Permissions, source: str) -> Permissions:
    """Return the permissions of a user that is a robot."""
    if source != TF:
        return allowed._replace(subscribe=(*allowed.subscribe, source))
    return allowed._replace(subscribe=(*allowed.subscribe, topics.TF, topics.TF_STATIC),
                            reply=(*allowed.reply, _TF_SERVICE))


def _of_users(users: Iterable[int], *names: str) -> tuple[str, ...]:
    """Return the names of topics of each user."""
    return tuple(name.format(user=number) for number in users for name in names)


def _operator(nodes: Iterable[str], users: Iterable[int]) -> Permissions:
    """Return the permissions to subscribe to all topics and to set the parameters of all nodes.

    The nodes of ``ros2``, whose names end in a number or a type, offer services.
    """
    readable = {*recorded_topics(), topics.MARKERS, topics.TF, topics.TF_STATIC,
                *_of_users(users, topics.POSE, topics.ODOMETRY, topics.PATH, topics.TRUE_PATH,
                           topics.TRUE_ODOMETRY)}
    return Permissions(
        publish=_RCLPY_TOPICS, subscribe=(*sorted(readable), *_RCLPY_TOPICS, *_LOCATE_TOPICS),
        reply=tuple(service.replace('~', '/_ros2cli_*') for service in _OFFERED_SERVICES),
        request=(*(f'{node}/{service}' for node in nodes for service in _PARAMETER_SERVICES),
                 *(service.replace('~', 'bs') for service in _CYCLE_SERVICES),
                 *_LOCATE_SERVICES))


def _of_site(
        base: str, site: Site | None, users: int, robots: Mapping[int, str] | None,
        is_simulated: bool) -> dict[tuple[str, str], Permissions]:
    """Return the permissions of a site, or of a single network, by namespace and node.

    The operator of the whole site has the permissions of those of the surfaces, too, and the
    process of all nodes has those of all nodes.
    """
    found, parts = {}, {}
    for name, roles in networks(site.surfaces if site else ()):
        surface = NodeSurface(
            site.surfaces[name or site.leader].scenario, site=site, base=base, name=name
        ) if site else _ALONE
        parts[name] = permissions(users, robots, is_simulated, surface, roles)
        found |= {(f'{base}/{name}'.rstrip('/'), node): allowed
                  for node, allowed in parts[name].items() if node != 'network'}
    for node in ('network', 'operator'):
        found[base, node] = Permissions(*(
            tuple(dict.fromkeys(posixpath.join(name, one) for name, nodes in parts.items()
                                for one in getattr(nodes[node], right)))
            for right in Permissions._fields))
    return found


def policy(
        namespace: str = '/', users: int = 2, robots: Mapping[int, str] | None = None,
        is_simulated: bool = False, site: Site | None = None) -> str:
    """Return the policy of a network in the XML format of SROS2, with one enclave for each node.

    Parameters
    ----------
    namespace
        Namespace of the network and of its enclaves.
    users, robots, is_simulated
        As for `permissions`.
    site
        Site, whose surfaces have namespaces of their own in the given one; by default, there is a
        single network.
    """
    add = ElementTree.SubElement
    root = ElementTree.Element('policy', version=_VERSION)
    enclaves = ElementTree.SubElement(root, 'enclaves')
    for (space, node), allowed in _of_site(
            namespace.rstrip('/'), site, users, robots, is_simulated).items():
        enclave = ElementTree.SubElement(enclaves, 'enclave', path=f'{space}/{node}')
        profiles = ElementTree.SubElement(enclave, 'profiles')
        profile = ElementTree.SubElement(profiles, 'profile', ns=space or '/', node=node)
        for right, names in allowed._asdict().items():
            kind = 'topic' if right in ('publish', 'subscribe') else 'service'
            if names:
                rules = add(profile, f'{kind}s', {right: 'ALLOW'})
                for name in names:
                    add(rules, kind).text = name
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding='unicode')
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the policy, and return the exit code 0."""
    parser = ArgumentParser(
        prog='policy.py',
        description='Print the SROS2 policy of a network or of a site.',
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--namespace', type=_namespace, default='/',
                        help='namespace of the network')
    parser.add_argument('--site', type=_site, metavar='FILE',
                        help='site file, whose surfaces have namespaces of their own')
    parser.add_argument('--users', type=integer(0, 1000), default=2, help='number of users')
    parser.add_argument('--robot', type=_robot, action='append', default=[], metavar='USER=TOPIC',
                        help='number of a user that is a robot, and its odometry topic or tf')
    parser.add_argument('--use-sim-time', action='store_true', help='permit /clock')
    options = parser.parse_args(arguments)
    robots = dict(options.robot)
    if beyond := [user for user in robots if not 1 <= user <= options.users]:
        parser.error(f'argument --robot: user {beyond[0]}, expected one of {options.users} users')
    print(policy(options.namespace, options.users, robots, options.use_sim_time, options.site),
          end='')
    return 0


def _robot(text: str) -> tuple[int, str]:
    user, _, source = text.partition('=')
    if not (user.isascii() and user.isdecimal() and source):
        raise argparse.ArgumentTypeError(f'{text!r}, expected USER=TOPIC or USER=tf')
    return int(user), source


def _site(text: str) -> Site:
    with translated(SiteError, argparse.ArgumentTypeError):
        return Site.from_yaml(text)


def _namespace(text: str) -> str:
    try:
        validate_namespace(text)
    except InvalidNamespaceException as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
