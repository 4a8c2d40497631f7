"""The executable ``network``: runs all nodes of a network or a site in one process."""

import importlib
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from rhs_isac_ros.positioning.site import Site, SiteError
from rhs_isac_ros.ros import parameters
from rhs_isac_ros.ros.processes import MAX_USER_NODES
from rhs_isac_ros.ros.roster import MEMBERS, networks
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import ParameterError


def _make(role: str, **options: Any) -> Node:
    """Create a node of a role; its class is named after the role."""
    module = importlib.import_module(f'rhs_isac_ros.nodes.{role}')
    node: Node = getattr(module, f'{role.title().replace("_", "")}Node')(**options)
    return node


def make_network() -> list[Node]:
    """Create all nodes of a network or a site, with users numbered from 1.

    More than `MAX_USER_NODES` users run in the node ``users``.
    """
    head = Node('network')
    values = parameters.declare(head, 'network')
    together = [('users', 1, values.users)] if values.users > MAX_USER_NODES else [
        (f'user_{n}', n, 1) for n in range(1, values.users + 1)]
    users = [{'name': name, 'parameter_overrides': [
        Parameter('user_id', value=first), Parameter('user_count', value=count)]}
        for name, first, count in together]
    nodes = [head]
    with translated(SiteError, ParameterError, 'site_file'):
        surfaces = Site.from_yaml(values.site_file).surfaces if values.site_file else ()
    for name, roles in networks(surfaces):
        # A rule of its own, because a rule of the process for the namespace applies to all nodes.
        space = f'{head.get_namespace().rstrip("/")}/{name}'
        options_of_space = {'cli_args': ['--ros-args', '-r', f'__ns:={space}']} if name else {}
        nodes += [_make(role, **options_of_space, **options) for role in roles
                  for options in ([{}] if MEMBERS[role].is_unique else users)]
    return nodes


main = entry('network', make_network)
