"""The executable ``network``: runs all nodes of a network or a site in one process."""

import importlib
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from rhs_isac_ros.positioning.site import Site, SiteError
from rhs_isac_ros.ros import parameters
from rhs_isac_ros.ros.roster import MAX_USER_NODES, nodes_of
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import ParameterError


def make_network() -> list[Node]:
    """Create all nodes of a network or a site, with users numbered from 1.

    More than `MAX_USER_NODES` users run in the node ``users``.
    """
    head = Node('network')
    values = parameters.declare(head, 'network')
    nodes = [head]
    with translated(SiteError, ParameterError, 'site_file'):
        surfaces = Site.from_yaml(values.site_file).surfaces if values.site_file else ()
    for namespace, role, name, users in nodes_of(
            values.users, surfaces, values.users > MAX_USER_NODES):
        options: dict[str, Any] = {'name': name, 'parameter_overrides': [
            Parameter(key, value=value) for key, value in users.items()]} if users else {}
        if namespace:
            # A rule of its own, because one of the process for the namespace applies to all nodes.
            space = f'{head.get_namespace().rstrip("/")}/{namespace}'
            options['cli_args'] = ['--ros-args', '-r', f'__ns:={space}']
        # The class of a node is named after its role.
        module = importlib.import_module(f'rhs_isac_ros.nodes.{role}')
        nodes.append(getattr(module, f'{role.title().replace("_", "")}Node')(**options))
    return nodes


main = entry('network', make_network)
