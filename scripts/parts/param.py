"""``scripts/param``: commands of ``ros2 param``, which has no wheel, with the same output."""

import argparse
import contextlib
import re
import sys
from collections.abc import Callable
from typing import Any

import yaml
from parts.verbs import run_verb
from rcl_interfaces.msg import ParameterType, SetParametersResult
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from rhs_isac_ros.ros.session import Session
from rhs_isac_ros.support.arguments import ArgumentParser, nonnegative_float
from rhs_isac_ros.tools.command import ToolError, entry, print_now

# Texts that the parser of rcl, unlike that of Python, reads as something else.
_AMBIGUOUS = re.compile(
    r'y|n|yes|no|on|off|true|false|null|nan|inf|infinity|[-+.\d].*', re.IGNORECASE | re.DOTALL)
# Maximum time to discover a node [s], including the exchange of keys for DDS security.
_DISCOVERY_TIMEOUT_S = 10.0
# Maximum time to discover a node's services, and to wait for a response [s].
_SERVICE_TIMEOUT_S = 10.0
_LABELS = {
    ParameterType.PARAMETER_BOOL: 'Boolean value is:',
    ParameterType.PARAMETER_INTEGER: 'Integer value is:',
    ParameterType.PARAMETER_DOUBLE: 'Double value is:',
    ParameterType.PARAMETER_STRING: 'String value is:',
    ParameterType.PARAMETER_BYTE_ARRAY: 'Byte values are:',
    ParameterType.PARAMETER_BOOL_ARRAY: 'Boolean values are:',
    ParameterType.PARAMETER_INTEGER_ARRAY: 'Integer values are:',
    ParameterType.PARAMETER_DOUBLE_ARRAY: 'Double values are:',
    ParameterType.PARAMETER_STRING_ARRAY: 'String values are:',
}


# Each of the following functions raises ToolError if the node does not exist or does not respond.

def get(session: Session, options: argparse.Namespace) -> None:
    """Print the value of a parameter."""
    values = _get_values(session, _find(session, options), [options.parameter_name])
    if not values:
        raise ToolError('Parameter not set')
    value = parameter_value_to_python(values[0])
    print_now('Parameter not set.' if value is None else f'{_LABELS[values[0].type]} {value}')


def set_value(session: Session, options: argparse.Namespace) -> None:
    """Set a parameter to a YAML value."""
    try:
        content = yaml.load(options.value, yaml.BaseLoader)
    except yaml.YAMLError:
        content = options.value
    (result,) = _set(session, options, {options.parameter_name: content})
    if not result.successful:
        raise ToolError(f'Setting parameter failed{_reason(result)}')
    print_now(f'Set parameter successful{_reason(result)}')


def show_list(session: Session, options: argparse.Namespace) -> None:
    """Print the names of the parameters of one node, or of all nodes."""
    if options.node_name:
        nodes = [_find(session, options)]
    else:
        session.discover(options.timeout)
        nodes = sorted(_nodes(session))
    for node in nodes:
        try:
            names = _names(session, node)
        except ToolError as error:
            # A recorder, for example, has no services.
            if options.node_name:
                raise
            print(error, file=sys.stderr)
            continue
        if names and not options.node_name:
            print_now(f'{node}:')
        for name in names:
            print_now(f'  {name}')


def dump(session: Session, options: argparse.Namespace) -> None:
    """Print the parameters of a node as a parameter file."""
    node = _find(session, options)
    names = _names(session, node)
    types = _call(session, node, lambda client: client.get_parameter_types(names)).types
    # If one of several requested parameters is not set, a node of rclpy returns no values at all.
    names = [name for name, kind in zip(names, types, strict=True)
             if kind != ParameterType.PARAMETER_NOT_SET]
    tree: dict[str, Any] = {}
    for name, value in zip(names, _get_values(session, node, names), strict=True):
        *groups, leaf = name.split('.')
        group = tree
        for key in groups:
            group = group.setdefault(key, {})
        group[leaf] = parameter_value_to_python(value)
    print_now(yaml.dump({node: {'ros__parameters': tree}}, Dumper=_Dumper,
                        default_flow_style=False))


def load(session: Session, options: argparse.Namespace) -> None:
    """Set all parameters in a parameter file on one node, even those meant for other nodes."""
    file = options.parameter_file
    try:
        with open(file, encoding='utf-8') as stream:
            found = yaml.load(stream, yaml.BaseLoader)
        contents: dict[str, Any] = {}
        # Values for single nodes have precedence over those for all.
        for _, tree in sorted(found.items(), key=lambda pair: pair[0] != '/**'):
            contents |= _flat(tree['ros__parameters'])
    except (OSError, ValueError, AttributeError, TypeError, LookupError, yaml.YAMLError) as error:
        reason = ' '.join(str(error).split())
        raise ToolError(f'{file}: {reason}, expected a parameter file') from None
    failed = 0
    for name, result in zip(contents, _set(session, options, contents), strict=True):
        if result.successful:
            print_now(f'Set parameter {name} successful{_reason(result)}')
        else:
            failed += 1
            print(f'Set parameter {name} failed{_reason(result)}', file=sys.stderr)
    if failed:
        raise ToolError(f'{failed} of {len(contents)} parameters not set')


class _Dumper(yaml.SafeDumper):
    """A dumper that quotes the texts that the readers of ROS take for numbers or truth values."""


_Dumper.add_representer(str, lambda dumper, text: dumper.represent_scalar(
    'tag:yaml.org,2002:str', text, style="'" if _AMBIGUOUS.fullmatch(text) else None))


def _flat(tree: dict[str, Any], prefix: str = '') -> dict[str, Any]:
    """Return the values in nested mappings, by names with dots."""
    return {name: value for key, found in tree.items() for name, value in (
        _flat(found, f'{prefix}{key}.') if isinstance(found, dict) else {f'{prefix}{key}': found}
    ).items()}


def _set(session: Session, options: argparse.Namespace, contents: dict[str, Any]
         ) -> list[SetParametersResult]:
    """Set parameters to texts, or lists of texts, with the types that the node declares."""
    node = _find(session, options)
    # A node of rclpy that is asked for the type of an unknown parameter returns no types at all.
    names = [name for name in _names(session, node) if name in contents]
    types = dict(zip(names, _call(
        session, node, lambda client: client.get_parameter_types(names)).types, strict=True))
    try:
        parameters = [_parameter(name, content, Parameter.Type(types.get(name, 0)))
                      for name, content in contents.items()]
    except (TypeError, ValueError, AssertionError) as error:
        raise ToolError(f'{error}, expected values of parameters') from None
    return list(_call(session, node, lambda client: client.set_parameters(parameters)).results)


def _parameter(name: str, content: str | list[str], declared: Parameter.Type) -> Parameter:
    """Return a parameter of the declared type or, if the text does not fit, of that in YAML."""
    kind = declared.name.removesuffix('_ARRAY')
    with contextlib.suppress(TypeError, ValueError):
        return Parameter(name, declared, _value(content, kind) if isinstance(
            content, str) else [_value(text, kind) for text in content])
    return Parameter(name, value=_value(content) if isinstance(content, str) else [
        _value(text) for text in content])


def _value(text: str, kind: str = '') -> Any:
    """Return a text as number or truth value if it is one in YAML, or as a value of a kind."""
    value: Any = text
    # An impossible date is a ValueError.
    with contextlib.suppress(yaml.YAMLError, ValueError):
        value = yaml.safe_load(text)
    if kind == 'STRING' or not isinstance(value, bool | int | float):
        value = text
    # Python does not tell the truth values from the numbers 0 and 1.
    if kind and isinstance(value, bool) and kind != 'BOOL':
        raise ValueError(text)
    return float(value) if kind == 'DOUBLE' else value


def _reason(result: SetParametersResult) -> str:
    return f': {result.reason}' if result.reason else ''


def _names(session: Session, node: str) -> list[str]:
    response = _call(session, node, lambda client: client.list_parameters())
    return sorted(response.result.names)


def _get_values(session: Session, node: str, names: list[str]) -> list[Any]:
    return list(_call(session, node, lambda client: client.get_parameters(names)).values)


def _nodes(session: Session) -> set[str]:
    return {f'{namespace.rstrip("/")}/{name}'
            for name, namespace in session.node.get_node_names_and_namespaces()
            if not name.startswith('_')}


def _find(session: Session, options: argparse.Namespace) -> str:
    """Wait for the node `options.node_name`, and return its full name."""
    name = f'/{options.node_name.removeprefix("/")}'
    if not session.spin_until(lambda: name in _nodes(session), options.timeout):
        raise ToolError('Node not found')
    return name


def _call(session: Session, node: str, request: Callable[[AsyncParameterClient], Future]) -> Any:
    client = AsyncParameterClient(session.node, node)
    if not session.spin_until(client.services_are_ready, _SERVICE_TIMEOUT_S):
        raise ToolError('Wait for service timed out waiting for parameter services for node '
                        f'{node}')
    response = session.response(lambda: request(client), _SERVICE_TIMEOUT_S)
    if response is None:
        raise ToolError(f'{node}: no response within {_SERVICE_TIMEOUT_S:g} s')
    return response


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='scripts/param', description='Read and set the parameters of running nodes.')
    verbs = parser.add_subparsers(required=True, metavar='list | get | set | dump | load')
    for name, function, others, text in (
            ('list', show_list, (),
             'Print the names of the parameters of one node or of all nodes.'),
            ('get', get, ('parameter_name',), 'Print the value of a parameter.'),
            ('set', set_value, ('parameter_name', 'value'), 'Set a parameter to a YAML value.'),
            ('dump', dump, (), 'Print the parameters of a node as a parameter file.'),
            ('load', load, ('parameter_file',),
             'Set the parameters that a parameter file contains.')):
        verb = verbs.add_parser(name, help=text)
        verb.set_defaults(verb=function)
        verb.add_argument('node_name', nargs='?' if name == 'list' else None)
        for other in others:
            verb.add_argument(other)
        verb.add_argument('--timeout', type=nonnegative_float, default=_DISCOVERY_TIMEOUT_S,
                          metavar='S', help='maximum time to discover the node '
                          f'(default: {_DISCOVERY_TIMEOUT_S:g} s)')
    return parser


main = entry(run_verb, _parser)
