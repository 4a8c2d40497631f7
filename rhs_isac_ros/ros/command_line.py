"""Command lines with ROS arguments, and the help of the nodes."""

import argparse
import os
import re
from collections.abc import Sequence

from rclpy.utilities import remove_ros_args

from rhs_isac_ros.model.arguments import ArgumentParser
from rhs_isac_ros.ros.parameter import Parameter
from rhs_isac_ros.ros.parameters import CODEBOOK, NODES

# The highest domain whose ports exist.
_MAX_DOMAIN = 232
# Options that ROS accepts only after --ros-args.
_ROS_OPTIONS = {'-p', '--param', '-r', '--remap', '--params-file', '--log-level'}


def parse(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse a command line that may contain ROS arguments, and check the environment.

    Print an error as one line and exit with code 2 if an argument or the domain is invalid.

    Parameters
    ----------
    arguments
        Command line without the name of the program.
    """
    check_domain(parser)
    try:
        words = remove_ros_args([parser.prog, *arguments])[1:]
    except RuntimeError as error:
        # Positions in the sources of ROS and the tokens of its parser do not help the user.
        reason = re.sub(r',? at \S+:\d+|\.? Error: Expected lexeme.*', '', str(error))
        parser.error('invalid ROS arguments: '
                     + reason.removeprefix('Failed to parse ROS arguments: '))
    options, unknown = parser.parse_known_args(words)
    if unknown:
        hint = ''
        if any(word in _ROS_OPTIONS or ':=' in word for word in unknown):
            hint = '; ROS arguments follow --ros-args, as in --ros-args -p NAME:=VALUE'
        parser.error(f'unrecognized arguments: {" ".join(unknown)}{hint}')
    return options


def check_domain(parser: argparse.ArgumentParser) -> None:
    """Exit with a usage error if the environment variable ROS_DOMAIN_ID is invalid."""
    text = os.environ.get('ROS_DOMAIN_ID', '')
    if text and not (text.isascii() and text.isdigit() and int(text[:9]) <= _MAX_DOMAIN):
        parser.error(f'environment variable ROS_DOMAIN_ID: {text!r}, '
                     f'expected an integer from 0 to {_MAX_DOMAIN}')


def node_parser(executable: str, description: str) -> ArgumentParser:
    """Return a parser for an executable whose arguments are all ROS arguments.

    Parameters
    ----------
    description
        A sentence, which may be preceded by the name of the executable and a colon.
    """
    text = description.rpartition('``: ')[2]
    return ArgumentParser(
        prog=executable, usage=f'{executable} [--ros-args -p NAME:=VALUE ...]',
        description=text[:1].upper() + text[1:], epilog=parameter_help(executable),
        formatter_class=argparse.RawDescriptionHelpFormatter)


def parameter_help(executable: str) -> str:
    """Return a description of the parameters of an executable, with an example."""
    own = list(NODES[executable])
    lines = ['ROS parameters:', *(_describe(parameter) for parameter in own)]
    if executable == 'optimizer':
        lines += [f'  {name}\n      {text}' for name, text in CODEBOOK.items()]
    elif executable == 'network':
        others = {parameter.name: parameter for name, parameters in NODES.items()
                  if name not in (executable, 'visualizer') for parameter in parameters
                  if parameter.name != 'user_id'}
        lines += ['', 'ROS parameters of the composed nodes:', *map(_describe, others.values())]
    example = _example(own)
    return '\n'.join([*lines, '', f'example: {executable} --ros-args -p {example}'])


def _describe(parameter: Parameter) -> str:
    details = [parameter.kind, f'default {_text(parameter)}']
    if parameter.range:
        details.append(parameter.range)
    if parameter.dynamic:
        details.append('dynamic')
    return f'  {parameter.name} ({"; ".join(details)})\n      {parameter.text}'


def _text(parameter: Parameter) -> str:
    """Return the default of a parameter as YAML."""
    if parameter.default in ('', []):
        return 'empty'
    text = str(parameter.default)
    return text.lower() if isinstance(parameter.default, bool) else text


def _example(parameters: Sequence[Parameter]) -> str:
    """Return an assignment to the most specific parameter with a default."""
    chosen = next((parameter for parameter in parameters
                   if parameter.name not in ('scenario_file', 'seed')), parameters[0])
    value = 'my.yaml' if chosen.default == '' else _text(chosen)
    return f'{chosen.name}:={value}'
