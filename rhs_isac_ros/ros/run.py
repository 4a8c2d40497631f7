"""Command lines with ROS arguments, and the spinning and shutdown of nodes."""

import argparse
import gc
import itertools
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, remove_ros_args, try_shutdown

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.executables import print_error
from rhs_isac_ros.model import ScenarioError
from rhs_isac_ros.ros import parameters
from rhs_isac_ros.ros.parameters import CODEBOOK, NODES, Parameter
from rhs_isac_ros.ros.startup import SecurityError, leave, one_line, prepare, use_discovery_profile
from rhs_isac_ros.support.arguments import ArgumentParser
from rhs_isac_ros.support.fields import ParameterError

# The highest domain whose port numbers are valid.
_MAX_DOMAIN = 232
# Parameters that rclpy declares for each node.
_OF_RCLPY = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
# Options that ROS accepts only after --ros-args.
_ROS_OPTIONS = {'-p', '--param', '-r', '--remap', '--params-file', '--log-level'}


def parse(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of a command line, which may include ROS arguments.

    If an argument or the domain is invalid, print one line and exit with code 2.
    """
    check_domain(parser)
    try:
        words = remove_ros_args([parser.prog, *arguments])[1:]
    except RuntimeError as error:
        # Omit positions in the sources of ROS and tokens of the parser.
        reason = re.sub(r',? at \S+:\d+|\.? Error: Expected lexeme.*', '', str(error))
        parser.error('invalid ROS arguments: '
                     + reason.removeprefix('Failed to parse ROS arguments: '))
    options, unknown = parser.parse_known_args(words)
    if unknown:
        advice = ''
        if any(word in _ROS_OPTIONS or ':=' in word for word in unknown):
            advice = '; ROS arguments follow --ros-args, as in --ros-args -p NAME:=VALUE'
        parser.error(f'unrecognized arguments: {" ".join(unknown)}{advice}')
    return options


def check_domain(parser: argparse.ArgumentParser) -> None:
    """Exit with a usage error if the environment variable ROS_DOMAIN_ID is invalid."""
    text = os.environ.get('ROS_DOMAIN_ID', '')
    if text and not (text.isascii() and text.isdigit() and int(text[:9]) <= _MAX_DOMAIN):
        parser.error(f'environment variable ROS_DOMAIN_ID: {text!r}, '
                     f'expected an integer from 0 to {_MAX_DOMAIN}')


def check_parameters(
        parser: argparse.ArgumentParser, executable: str, arguments: Sequence[str]) -> None:
    """Exit with a usage error if ``-p`` sets a parameter that the executable does not have.

    A parameter file may set parameters of several executables; see `parameters.check_overrides`.
    """
    accepted = set(_names(executable)).union(*map(_names, _composed(executable)))
    for name in _assigned(arguments):
        if name not in parameters.known_names() and not name.startswith(_OF_RCLPY):
            parser.error(f'argument -p: {name}: unknown parameter{parameters.hint(name)}')
        owners = [owner for owner in NODES if name in _names(owner)]
        if owners and name not in accepted:
            parser.error(f'argument -p: {name} is a parameter of {", ".join(owners)}, '
                         f'expected one of {executable}')


def _names(executable: str) -> list[str]:
    """Return the names of the parameters of an executable, not of the nodes that it composes."""
    names = [parameter.name for parameter in NODES[executable]]
    return [*names, *CODEBOOK] if executable == 'optimizer' else names


def _assigned(arguments: Sequence[str]) -> Iterator[str]:
    """Yield the names of parameters that ``-p`` options set for all nodes of the process."""
    in_ros_arguments = False
    for word, following in itertools.pairwise(arguments):
        if word in ('--ros-args', '--'):
            in_ros_arguments = word == '--ros-args'
        elif in_ros_arguments and word in ('-p', '--param'):
            name, _, _ = following.partition(':=')
            # A name with a colon sets a parameter of a single node.
            if ':' not in name:
                yield name


def _composed(executable: str) -> list[str]:
    return [name for name in NODES if name not in ('network', 'visualizer')
            ] if executable == 'network' else []


def parameter_help(executable: str) -> str:
    """Return a description of the parameters of an executable, with an example."""
    own = list(NODES[executable])
    lines = ['ROS parameters:', *(_describe(parameter) for parameter in own)]
    if executable == 'optimizer':
        lines += [f'  {name}\n      {text}' for name, text in CODEBOOK.items()]
    elif composed := _composed(executable):
        # `network` sets these itself.
        others = {parameter.name: parameter for name in composed for parameter in NODES[name]
                  if parameter.name not in ('user_id', 'user_count')}
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
    """Return an assignment to the first parameter, preferably not the scenario file or seed."""
    chosen = next((parameter for parameter in parameters
                   if parameter.name not in ('scenario_file', 'seed')), parameters[0])
    value = 'my.yaml' if chosen.default == '' else chosen.default_text
    return f'{chosen.name}:={value}'


# Maximum time to destroy the nodes [s]. Fast DDS 2.14 can deadlock if a publisher is destroyed
# while another participant times out.
_DESTRUCTION_S = 10
# Maximum time between two checks for a signal [s].
_POLL_S = 0.1


def collect_signals() -> list[int]:
    """Handle SIGINT and SIGTERM; return the list to which the handlers append each signal."""
    # A handler may interrupt the other one, so it must not take a lock.
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
    return signals


def run(make: Callable[[], Sequence[Node]], args: Sequence[str] | None = None,
        done: Callable[[], bool] = lambda: False) -> int:
    """Create nodes, spin them until a signal arrives or `done` returns True, and destroy them.

    The handlers for SIGINT and SIGTERM only record the signal, because those of rclpy would
    invalidate the context while a callback publishes. `args` is a command line with the name of
    the program, by default the command line of the process. The returned exit code is 2 if a
    parameter, a file or the security set-up is invalid, otherwise 0.
    """
    program = os.path.basename(args[0]) if args else ''
    signals = collect_signals()
    use_discovery_profile()
    try:
        if not ok():
            rclpy.init(args=prepare(sys.argv if args is None else args),
                       signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        print_error(error, program)
        return 2
    nodes: Sequence[Node] = ()
    executor = None
    try:
        with one_line():
            nodes = make()
        leave()
        for node in nodes:
            parameters.check_overrides(node)
        executor = EventsExecutor()
        for node in nodes:
            executor.add_node(node)
        # Without the freeze, each garbage collection would examine the objects of all imported
        # modules, which could delay a cycle by tens of milliseconds.
        gc.collect()
        gc.freeze()
        while ok() and not signals and not done():
            # This call returns after each message. Other ways of spinning do not return until the
            # queue is empty, so a busy node would not react to signals.
            executor.spin_once(timeout_sec=_POLL_S)
    except ExternalShutdownException:
        pass
    except (ParameterError, ParameterException, ScenarioError, CodebookError,
            SecurityError) as error:
        print_error(error, program)
        return 2
    finally:
        # The default action of SIGALRM also ends a process that is deadlocked in the middleware,
        # where a Python handler would never run.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_DESTRUCTION_S)
        leave()
        for node in nodes:
            node.destroy_node()
        if executor is not None:
            executor.shutdown()
        try_shutdown()
        signal.alarm(0)
        # Python restores the default handlers at exit. A further signal, for instance from
        # `ros2 launch` after Ctrl-C, would then kill a process that is about to exit normally.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return 0


def entry(executable: str, make: Callable[[], Sequence[Node]]) -> Callable[..., int]:
    """Return the main function of an executable that has only ROS arguments.

    `executable` is a key of `NODES`. The help text takes the description from the module in which
    `make` is defined: the part after the colon in the first line of the docstring.
    """
    def main(args: Sequence[str] | None = None) -> int:
        arguments = sys.argv[1:] if args is None else list(args)
        first_line = (sys.modules[make.__module__].__doc__ or '').partition('\n')[0]
        text = first_line.rpartition('``: ')[2]
        parser = ArgumentParser(
            prog=executable, usage=f'{executable} [--ros-args -p NAME:=VALUE ...]',
            description=text[:1].upper() + text[1:], epilog=parameter_help(executable),
            formatter_class=argparse.RawDescriptionHelpFormatter)
        parse(parser, arguments)
        check_parameters(parser, executable, arguments)
        return run(make, [executable, *arguments])
    return main
