"""``scripts/param``: ``ros2 param``, which the wheels lack, with the same output.

``python3 -m rhs_isac_ros.tools.param --help`` lists the commands.
"""

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

import yaml
from rcl_interfaces.msg import Parameter, ParameterType
from rclpy.parameter import (
    get_parameter_value,
    parameter_dict_from_yaml_file,
    parameter_value_to_python,
)
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.support.arguments import ArgumentParser, nonnegative_float
from rhs_isac_ros.tools.command import Session, ToolError, print_now, run_tool

# Maximum time to discover a node [s]. With DDS security, keys are exchanged first.
_DISCOVERY_TIMEOUT_S = 10.0
# Maximum time to discover a node's services, and for a response [s].
_SERVICE_TIMEOUT_S = 5.0
# Label of a value, and name of the type for ``--param-type``.
_LABELS = {
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
    """Run a command on parameters and return the exit code of `run_tool`."""
    return run_tool(_parser(), arguments)


def get(session: Session, options: argparse.Namespace) -> None:
    """Print the value of a parameter.

    Raises
    ------
    ToolError
        If the node or its parameter does not exist.
    """
    node = _find(session, options)
    values = _get_values(session, node, [options.parameter_name])
    if not values:
        raise ToolError('Parameter not set')
    label, value = _LABELS[values[0].type][0], parameter_value_to_python(values[0])
    if options.hide_type:
        print_now(value)
    elif value is None:
        print_now(label)
    else:
        print_now(label, value)


def set_value(session: Session, options: argparse.Namespace) -> None:
    """Set a parameter.

    Raises
    ------
    ToolError
        If the node does not exist, or it rejects the value.
    """
    node = _find(session, options)
    parameter = Parameter(
        name=options.parameter_name, value=get_parameter_value(string_value=options.value))
    response = _call(session, node, lambda client: client.set_parameters([parameter]))
    (result,) = response.results
    reason = f': {result.reason}' if result.reason else ''
    if not result.successful:
        raise ToolError(f'Setting parameter failed{reason}')
    print_now(f'Set parameter successful{reason}')


def show_list(session: Session, options: argparse.Namespace) -> None:
    """Print the names of the parameters of one node or of all nodes.

    Raises
    ------
    ToolError
        If the node does not exist, or one does not respond.
    """
    if options.node_name:
        nodes = [_find(session, options)]
    else:
        session.discover(options.timeout)
        nodes = sorted(_nodes(session, options.include_hidden_nodes))
    for node in nodes:
        response = _call(
            session, node, lambda client: client.list_parameters(options.param_prefixes))
        names = sorted(name for name in response.result.names
                       if not options.filter or options.filter.match(name))
        if names and not options.node_name:
            print_now(f'{node}:')
        for line in _with_types(session, node, names) if options.param_type else names:
            print_now(f'  {line}')


def _with_types(session: Session, node: str, names: list[str]) -> list[str]:
    response = _call(session, node, lambda client: client.describe_parameters(names))
    return [f'{descriptor.name} (type: {_LABELS[descriptor.type][1]})'
            for descriptor in response.descriptors]


def dump(session: Session, options: argparse.Namespace) -> None:
    """Print the parameters of a node as a parameter file.

    Raises
    ------
    ToolError
        If the node does not exist or does not respond.
    """
    node = _find(session, options)
    response = _call(session, node, lambda client: client.list_parameters())
    names = sorted(response.result.names)
    tree: dict[str, Any] = {}
    for name, value in zip(names, _get_values(session, node, names), strict=True):
        *groups, leaf = name.split('.')
        group = tree
        for key in groups:
            group = group.setdefault(key, {})
        group[leaf] = parameter_value_to_python(value)
    print_now(yaml.dump({node: {'ros__parameters': tree}}, default_flow_style=False))


def load(session: Session, options: argparse.Namespace) -> None:
    """Set the parameters that a parameter file contains.

    Raises
    ------
    ToolError
        If the file is invalid, the node does not exist, or it rejects a value.
    """
    try:
        names = list(parameter_dict_from_yaml_file(
            options.parameter_file, not options.no_use_wildcard))
    except (OSError, ValueError, AttributeError, AssertionError, TypeError, RuntimeError,
            yaml.YAMLError) as error:
        reason = ' '.join(str(error).split())
        raise ToolError(f'{options.parameter_file}: {reason}, expected a parameter file') from None
    node = _find(session, options)
    response = _call(session, node, lambda client: client.load_parameter_file(
        options.parameter_file, not options.no_use_wildcard))
    failed = 0
    for name, result in zip(names, response.results, strict=True):
        reason = f': {result.reason}' if result.reason else ''
        if result.successful:
            print_now(f'Set parameter {name} successful{reason}')
        else:
            failed += 1
            print(f'Set parameter {name} failed{reason}', file=sys.stderr)
    if failed:
        raise ToolError(f'{failed} of {len(names)} parameters not set')


def _get_values(session: Session, node: str, names: list[str]) -> list[Any]:
    return list(_call(session, node, lambda client: client.get_parameters(names)).values)


def _nodes(session: Session, hidden: bool) -> set[str]:
    return {f'{namespace.rstrip("/")}/{name}'
            for name, namespace in session.node.get_node_names_and_namespaces()
            if hidden or not name.startswith('_')}


def _find(session: Session, options: argparse.Namespace) -> str:
    """Wait for the node `options.node_name`, and return its full name."""
    name = f'/{options.node_name.removeprefix("/")}'
    if not session.spin_until(
            lambda: name in _nodes(session, options.include_hidden_nodes), options.timeout):
        raise ToolError('Node not found')
    return name


def _call(session: Session, node: str, request: Callable[[AsyncParameterClient], Future]) -> Any:
    """Send a request to a node's parameter services, and return the response."""
    client = AsyncParameterClient(session.node, node)
    if not session.spin_until(client.services_are_ready, _SERVICE_TIMEOUT_S):
        raise ToolError('Wait for service timed out waiting for parameter services for node '
                        f'{node}')
    future = request(client)
    if not session.spin_until(future.done, _SERVICE_TIMEOUT_S):
        raise ToolError(f'{node}: no response within {_SERVICE_TIMEOUT_S:g} s')
    return future.result()


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='scripts/param', description='Read and set the parameters of running nodes.')
    verbs = parser.add_subparsers(required=True, metavar='list | get | set | dump | load')
    subparsers = {}
    for name, verb, text in (
            ('list', show_list, 'Print the names of the parameters of one node or of all nodes.'),
            ('get', get, 'Print the value of a parameter.'),
            ('set', set_value, 'Set a parameter.'),
            ('dump', dump, 'Print the parameters of a node as a parameter file.'),
            ('load', load, 'Set the parameters that a parameter file contains.')):
        subparser = subparsers[name] = verbs.add_parser(name, help=text)
        subparser.set_defaults(verb=verb)
        subparser.add_argument('node_name', nargs='?' if verb is show_list else None)
        if verb in (get, set_value):
            subparser.add_argument('parameter_name')
        subparser.add_argument('--include-hidden-nodes', action='store_true',
                               help='include hidden nodes')
        subparser.add_argument('--timeout', type=nonnegative_float, default=_DISCOVERY_TIMEOUT_S,
                               metavar='S',
                               help='maximum time to discover the node '
                                    f'(default: {_DISCOVERY_TIMEOUT_S:g} s)')
    subparsers['load'].add_argument('parameter_file', help='parameter file')
    subparsers['load'].add_argument('--no-use-wildcard', action='store_true',
                                    help="ignore the parameters of the node '/**'")
    subparsers['set'].add_argument('value', help='value in YAML')
    subparsers['get'].add_argument('--hide-type', action='store_true',
                                   help='print the value without its type')
    subparser = subparsers['list']
    subparser.add_argument('--filter', type=_pattern, metavar='REGEX',
                           help='only names that match')
    subparser.add_argument('--param-prefixes', nargs='+', default=[], metavar='PREFIX',
                           help='only names with one of these prefixes')
    subparser.add_argument('--param-type', action='store_true', help='print the types')
    return parser


def _pattern(text: str) -> re.Pattern[str]:
    """Compile a regular expression, for argparse."""
    try:
        return re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(
            f'{text!r}: {error}, expected a regular expression') from None


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
