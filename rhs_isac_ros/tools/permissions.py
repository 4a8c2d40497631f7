"""Which node may use which topic and service, as a policy for SROS2.

``python -m rhs_isac_ros.tools.permissions`` prints the policy. ``config/sros2`` has it for two
users.
"""

import argparse
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from rclpy.exceptions import InvalidNamespaceException
from rclpy.validate_namespace import validate_namespace

from rhs_isac_ros.monitoring.scene_state import RECEIVES as SCENE_RECEIVES
from rhs_isac_ros.nodes.optimizer import PUSHER_NODE
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.protocol.user import User
from rhs_isac_ros.ros import topics

# What every node of rclpy publishes, and the services that it offers.
_ALWAYS_PUBLISHED = ('/parameter_events', '/rosout')
_PARAMETER_SERVICES = (
    'describe_parameters', 'get_parameter_types', 'get_parameters', 'list_parameters',
    'set_parameters', 'set_parameters_atomically')
_OFFERED = tuple(f'~/{service}' for service in (*_PARAMETER_SERVICES, 'get_type_description'))
_GET_CODEBOOK = f'{topics.OPTIMIZER_NODE}/get_parameters'
_VERSION = '0.2.0'


class Permissions(NamedTuple):
    """What a node may do; names are relative to its namespace, or to itself with a ``~``.

    Attributes
    ----------
    publish, subscribe
        Topics.
    reply, request
        Services that it offers, and that it calls.
    """

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = _OFFERED
    request: tuple[str, ...] = ()


def permissions(users: int) -> dict[str, Permissions]:
    """Return what the nodes of a network may do: what they do, and nothing else.

    Parameters
    ----------
    users
        How many users, numbered from 1.

    Returns
    -------
    dict
        By node; ``operator`` is for who looks on from a terminal and sets parameters.
    """
    told = (topics.DIAGNOSTICS,)
    codebook = {'takes': (topics.CODEBOOK,), 'request': (_GET_CODEBOOK,)}
    nodes = {
        'bs': _access(BaseStation.SENDS, BaseStation.RECEIVES, told, **codebook),
        'channel': _access(Channel.SENDS, Channel.RECEIVES, told),
        'optimizer': _access((), (), (*told, topics.CODEBOOK)),
        'positioner': _access(
            Positioner.SENDS, Positioner.RECEIVES, (*told, topics.POSITION), **codebook),
        'rhs_controller': _access(
            RhsController.SENDS, RhsController.RECEIVES, told, **codebook),
        'transmission': _access(Transmission.SENDS, Transmission.RECEIVES, told, **codebook),
        'visualizer': _access((), SCENE_RECEIVES, (topics.MARKERS, *_paths(users))),
        **{f'user_{number}': _access(User.SENDS, User.RECEIVES, told)
           for number in range(1, users + 1)},
    }
    return {**nodes, 'operator': _operator(nodes, users)}


def _access(
        sends: Iterable[type[m.Message]], receives: Iterable[type[m.Message]],
        gives: tuple[str, ...] = (), takes: tuple[str, ...] = (),
        request: tuple[str, ...] = ()) -> Permissions:
    """Permissions to the topics of messages, and to some others by name."""
    return Permissions(
        publish=(*sorted([*(topics.NAMES[kind] for kind in sends), *gives]), *_ALWAYS_PUBLISHED),
        subscribe=tuple(sorted([*(topics.NAMES[kind] for kind in receives), *takes])),
        request=request)


def _paths(users: int) -> tuple[str, ...]:
    """Names of the topics of the users' paths."""
    return tuple(name.format(user=number) for number in range(1, users + 1)
                 for name in (topics.PATH, topics.TRUE_PATH))


def _operator(nodes: Iterable[str], users: int) -> Permissions:
    """Hear everything, say nothing, and set the parameters of all.

    Nodes of the terminal have names of their own, those of ``ros2`` with numbers.
    """
    heard = {*topics.NAMES.values(), topics.CODEBOOK, topics.DIAGNOSTICS, topics.MARKERS,
             topics.POSITION, *_paths(users)}
    return Permissions(
        publish=_ALWAYS_PUBLISHED, subscribe=(*sorted(heard), *_ALWAYS_PUBLISHED),
        reply=(*(service.replace('~', PUSHER_NODE) for service in _OFFERED),
               '/_ros2cli_*/get_type_description'),
        request=tuple(f'{node}/{service}' for node in nodes for service in _PARAMETER_SERVICES))


def policy(namespace: str = '/', users: int = 2) -> str:
    """Return the policy of a network, every node in an enclave of its own.

    Parameters
    ----------
    namespace
        Namespace of the network, which is also that of its enclaves.
    users
        How many users.

    Returns
    -------
    str
        XML as SROS2 takes it; what it does not allow is denied.
    """
    root = ElementTree.Element('policy', version=_VERSION)
    enclaves = ElementTree.SubElement(root, 'enclaves')
    for node, access in permissions(users).items():
        enclave = ElementTree.SubElement(
            enclaves, 'enclave', path=f'{namespace.rstrip("/")}/{node}')
        profiles = ElementTree.SubElement(enclave, 'profiles')
        profile = ElementTree.SubElement(profiles, 'profile', ns=namespace, node=node)
        for right, names in access._asdict().items():
            kind = 'topic' if right in ('publish', 'subscribe') else 'service'
            if names:
                rules = ElementTree.SubElement(profile, f'{kind}s', {right: 'ALLOW'})
                for name in names:
                    ElementTree.SubElement(rules, kind).text = name
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding='unicode')
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the policy.

    Parameters
    ----------
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code.
    """
    parser = argparse.ArgumentParser(
        prog='python -m rhs_isac_ros.tools.permissions', description='Print the SROS2 policy of a '
        'network.', formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--namespace', type=_namespace, default='/', help='of the network')
    parser.add_argument('--users', type=_number, default=2, help='how many, numbered from 1')
    options = parser.parse_args(arguments)
    print(policy(options.namespace, options.users), end='')
    return 0


def _namespace(text: str) -> str:
    try:
        validate_namespace(text)
    except InvalidNamespaceException as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _number(text: str) -> int:
    if not 0 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f'{text}, expected 0 to 1000')
    return int(text)


if __name__ == '__main__':
    sys.exit(main())
