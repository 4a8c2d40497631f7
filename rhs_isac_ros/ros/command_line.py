"""Command lines with ROS arguments, and the help of the nodes."""

import argparse
import itertools
import os
import re
from collections.abc import Iterator, Sequence

from rclpy.utilities import remove_ros_args

from rhs_isac_ros.ros.parameters import CODEBOOK, NODES, Parameter, hint, known_names
from rhs_isac_ros.support.arguments import ArgumentParser

# The highest domain whose ports exist.
_MAX_DOMAIN = 232
# Parameters that rclpy declares for each node.
_OF_RCLPY = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
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


def check_parameters(
        parser: argparse.ArgumentParser, executable: str, arguments: Sequence[str]) -> None:
    """Exit with a usage error if ``-p`` sets a parameter that only other executables have.

    Likewise if no executable has it. A parameter file may set both, because several nodes may
    share the file; `parameters.check_overrides` warns of the latter.
    """
    accepted = set(_names(executable)).union(*map(_names, _composed(executable)))
    for name in _assigned(arguments):
        if name not in known_names() and not name.startswith(_OF_RCLPY):
            parser.error(f'argument -p: {name}: unknown parameter{hint(name)}; see --help')
        owners = [owner for owner in NODES if name in _names(owner)]
        if owners and name not in accepted:
            parser.error(f'argument -p: {name} is a parameter of {", ".join(owners)}, '
                         f'expected one of {executable}')


def _names(executable: str) -> list[str]:
    """Return the names of the parameters of an executable, without those of composed nodes."""
    names = [parameter.name for parameter in NODES[executable]]
    return [*names, *CODEBOOK] if executable == 'optimizer' else names


def _assigned(arguments: Sequence[str]) -> Iterator[str]:
    """Yield the parameters that options set for all nodes of the process."""
    in_ros_arguments = False
    for word, following in itertools.pairwise(arguments):
        if word in ('--ros-args', '--'):
            in_ros_arguments = word == '--ros-args'
        elif in_ros_arguments and word in ('-p', '--param'):
            name, _, _ = following.partition(':=')
            # A name with a colon begins with the name of the node that it is for.
            if ':' not in name:
                yield name


def _composed(executable: str) -> list[str]:
    """Return the other executables whose nodes run in the process of an executable."""
    return [name for name in NODES if name not in ('network', 'visualizer')
            ] if executable == 'network' else []


def parameter_help(executable: str) -> str:
    """Return a description of the parameters of an executable, with an example."""
    own = list(NODES[executable])
    lines = ['ROS parameters:', *(_describe(parameter) for parameter in own)]
    if executable == 'optimizer':
        lines += [f'  {name}\n      {text}' for name, text in CODEBOOK.items()]
    elif composed := _composed(executable):
        # The network numbers its users itself.
        others = {parameter.name: parameter for name in composed for parameter in NODES[name]
                  if parameter.name != 'user_id'}
        lines += ['', 'ROS parameters of the composed nodes:', *map(_describe, others.values())]
    example = _example(own)
    return '\n'.join([*lines, '', f'example: {executable} --ros-args -p {example}'])


def _describe(parameter: Parameter) -> str:
    details = [parameter.type, f'default {parameter.default_text}']
    if parameter.range:
        details.append(parameter.range)
    if parameter.dynamic:
        details.append('dynamic')
    return f'  {parameter.name} ({"; ".join(details)})\n      {parameter.text}'


def _example(parameters: Sequence[Parameter]) -> str:
    """Return an assignment to the most specific parameter with a default."""
    chosen = next((parameter for parameter in parameters
                   if parameter.name not in ('scenario_file', 'seed')), parameters[0])
    value = 'my.yaml' if chosen.default == '' else chosen.default_text
    return f'{chosen.name}:={value}'
