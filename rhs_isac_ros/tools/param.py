"""``scripts/param``: what of ``ros2 param`` the wheels lack, with the same output.

``python -m rhs_isac_ros.tools.param --help`` lists the commands.
"""

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

import yaml
from rcl_interfaces.msg import Parameter, ParameterType
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from rhs_isac_ros.tools.session import Session, ToolError, run_tool, say

# How long a node's services, and their answers, may take [s].
_PATIENCE_S = 5.0
# What stands before a value, and what ``--param-type`` says, by the type of a parameter.
_WORDS = {
    ParameterType.PARAMETER_NOT_SET: ('Parameter not set.', 'not set'),
    ParameterType.PARAMETER_BOOL: ('Boolean value is:', 'boolean'),
    ParameterType.PARAMETER_INTEGER: ('Integer value is:', 'integer'),
    ParameterType.PARAMETER_DOUBLE: ('Double value is:', 'double'),
    ParameterType.PARAMETER_STRING: ('String value is:', 'string'),
    ParameterType.PARAMETER_BYTE_ARRAY: ('Byte values are:', 'byte array'),
    ParameterType.PARAMETER_BOOL_ARRAY: ('Boolean values are:', 'boolean array'),
    ParameterType.PARAMETER_INTEGER_ARRAY: ('Integer values are:', 'integer array'),
    ParameterType.PARAMETER_DOUBLE_ARRAY: ('Double values are:', 'double array'),
    ParameterType.PARAMETER_STRING_ARRAY: ('String values are:', 'string array'),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command on parameters.

    Parameters
    ----------
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code, as of `run_tool`.
    """
    return run_tool(_parser(), arguments)


def get(session: Session, options: argparse.Namespace) -> None:
    """Print a parameter's value.

    Parameters
    ----------
    session
        The session.
    options
        ``node_name``, ``parameter_name``, ``hide_type``, ``timeout``.

    Raises
    ------
    ToolError
        If there is no such node, or it has no such parameter.
    """
    node = _find(session, options)
    values = _values(session, node, [options.parameter_name])
    if not values:
        raise ToolError('Parameter not set')
    label, value = _WORDS[values[0].type][0], parameter_value_to_python(values[0])
    if options.hide_type:
        say(value)
    elif value is None:
        say(label)
    else:
        say(label, value)


def set_one(session: Session, options: argparse.Namespace) -> None:
    """Set a parameter.

    Parameters
    ----------
    session
        The session.
    options
        ``node_name``, ``parameter_name``, ``value`` as YAML, ``timeout``.

    Raises
    ------
    ToolError
        If there is no such node, or it refuses the value.
    """
    node = _find(session, options)
    parameter = Parameter(
        name=options.parameter_name, value=get_parameter_value(string_value=options.value))
    answer = _ask(session, node, lambda client: client.set_parameters([parameter]))
    (result,) = answer.results
    reason = f': {result.reason}' if result.reason else ''
    if not result.successful:
        raise ToolError(f'Setting parameter failed{reason}')
    say(f'Set parameter successful{reason}')


def show_list(session: Session, options: argparse.Namespace) -> None:
    """Print the names of the parameters of a node, or of all.

    Parameters
    ----------
    session
        The session.
    options
        ``node_name``, ``filter``, ``param_prefixes``, ``param_type``, ``include_hidden_nodes``,
        ``timeout``.

    Raises
    ------
    ToolError
        If there is no such node, or one does not answer.
    """
    if options.node_name:
        nodes = [_find(session, options)]
    else:
        session.discover(options.timeout)
        nodes = sorted(_nodes(session, options.include_hidden_nodes))
    for node in nodes:
        listed = _ask(session, node, lambda client: client.list_parameters(options.param_prefixes))
        names = sorted(name for name in listed.result.names
                       if not options.filter or re.match(options.filter, name))
        if names and not options.node_name:
            say(f'{node}:')
        for line in _typed(session, node, names) if options.param_type else names:
            say(f'  {line}')


def _typed(session: Session, node: str, names: list[str]) -> list[str]:
    described = _ask(session, node, lambda client: client.describe_parameters(names))
    return [f'{descriptor.name} (type: {_WORDS[descriptor.type][1]})'
            for descriptor in described.descriptors]


def dump(session: Session, options: argparse.Namespace) -> None:
    """Print a node's parameters as a parameter file.

    Parameters
    ----------
    session
        The session.
    options
        ``node_name``, ``timeout``.

    Raises
    ------
    ToolError
        If there is no such node, or it does not answer.
    """
    node = _find(session, options)
    listed = _ask(session, node, lambda client: client.list_parameters())
    names = sorted(listed.result.names)
    tree: dict[str, Any] = {}
    for name, value in zip(names, _values(session, node, names), strict=True):
        *branches, leaf = name.split('.')
        place = tree
        for branch in branches:
            place = place.setdefault(branch, {})
        place[leaf] = parameter_value_to_python(value)
    say(yaml.dump({node: {'ros__parameters': tree}}, default_flow_style=False))


def _values(session: Session, node: str, names: list[str]) -> Sequence[Any]:
    return _ask(session, node, lambda client: client.get_parameters(names)).values


def _nodes(session: Session, hidden: bool) -> set[str]:
    return {f'{namespace.rstrip("/")}/{name}'
            for name, namespace in session.node.get_node_names_and_namespaces()
            if hidden or not name.startswith('_')}


def _find(session: Session, options: argparse.Namespace) -> str:
    """Wait for a node, and return its full name."""
    name = f'/{options.node_name.removeprefix("/")}'
    if not session.until(
            lambda: name in _nodes(session, options.include_hidden_nodes), options.timeout):
        raise ToolError('Node not found')
    return name


def _ask(session: Session, node: str, request: Callable[[AsyncParameterClient], Future]) -> Any:
    """Return a node's answer."""
    client = AsyncParameterClient(session.node, node)
    if not session.until(client.services_are_ready, _PATIENCE_S):
        raise ToolError('Wait for service timed out waiting for parameter services for node '
                        f'{node}')
    future = request(client)
    if not session.until(future.done, _PATIENCE_S):
        raise ToolError(f'{node}: no answer within {_PATIENCE_S:g} s')
    return future.result()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='param', description='Read and set the parameters of running nodes.')
    verbs = parser.add_subparsers(required=True, metavar='list | get | set | dump')
    subparsers = {}
    for word, verb in (('list', show_list), ('get', get), ('set', set_one), ('dump', dump)):
        add = subparsers[word] = verbs.add_parser(word, help=verb.__doc__.partition('\n')[0])
        add.set_defaults(verb=verb)
        add.add_argument('node_name', nargs='?' if verb is show_list else None)
        if verb in (get, set_one):
            add.add_argument('parameter_name')
        add.add_argument('--include-hidden-nodes', action='store_true', help='also hidden ones')
        add.add_argument('--timeout', type=float, default=3.0, metavar='S',
                         help='how long to wait for the node (default: 3 s)')
    subparsers['set'].add_argument('value', help='as in YAML')
    subparsers['get'].add_argument('--hide-type', action='store_true', help='only the value')
    add = subparsers['list']
    add.add_argument('--filter', metavar='REGEX', help='only names that it matches')
    add.add_argument('--param-prefixes', nargs='+', default=[], metavar='PREFIX',
                     help='only names with one of these prefixes')
    add.add_argument('--param-type', action='store_true', help='also the types')
    return parser


if __name__ == '__main__':
    sys.exit(main())
