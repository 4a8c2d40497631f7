"""The executable ``network``: runs all nodes in one process."""

import importlib

from rclpy.node import Node
from rclpy.parameter import Parameter

from rhs_isac_ros.nodes.user import UserNode
from rhs_isac_ros.ros import parameters
from rhs_isac_ros.ros.processes import MAX_USER_NODES
from rhs_isac_ros.ros.roster import UNIQUE
from rhs_isac_ros.ros.run import entry


def _make(role: str) -> Node:
    """Create the node of a role; its class is named after the role."""
    module = importlib.import_module(f'rhs_isac_ros.nodes.{role}')
    node: Node = getattr(module, f'{role.title().replace("_", "")}Node')()
    return node


def make_network() -> list[Node]:
    """Create all nodes, with users numbered from 1.

    More than `MAX_USER_NODES` users share the node ``users``.
    """
    head = Node('network')
    users = parameters.declare(head, 'network').users
    nodes = [head, *map(_make, UNIQUE)]
    together = [('users', 1, users)] if users > MAX_USER_NODES else [
        (f'user_{n}', n, 1) for n in range(1, users + 1)]
    return [*nodes, *(UserNode(name, parameter_overrides=[
        Parameter('user_id', value=first), Parameter('user_count', value=count)])
        for name, first, count in together)]


main = entry('network', make_network)
