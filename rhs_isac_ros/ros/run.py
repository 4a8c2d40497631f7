"""Command line, init, spin and shutdown of nodes, and the errors at their start.

`starting` makes each error at the start a `StartError` of one line. A command prints it and
ends with exit code 2.
"""

import argparse
import contextlib
import gc
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import rclpy
from rclpy.exceptions import InvalidHandle, NameValidationException, ParameterException
from rclpy.executors import Executor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, remove_ros_args, try_shutdown

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import ScenarioError
from rhs_isac_ros.ros import environment, parameters
from rhs_isac_ros.support.exits import exit_code_of, on_end_signals
from rhs_isac_ros.support.fields import ParameterError

# Options that ROS accepts only after --ros-args.
_ROS_OPTIONS = {'-p', '--param', '-r', '--remap', '--params-file', '--log-level'}
# The remapping rules for the name and the namespace of a node.
_RULE = re.compile(r'(?:[^:]+:)?__(node|name|ns):=(.*)')
# What an error of rcl or Fast DDS means, by a part of its text.
_MEANINGS = {
    'failed to create participant': 'Fast DDS rejects the files of the enclave, which may be '
    'damaged, expired, or signed by another authority or for another ROS_DOMAIN_ID',
    'security libraries': 'Fast DDS was built without security, as in the wheels; install the '
    f'packages of ROS 2 Jazzy, or unset {environment.SECURITY}',
    'error not set': 'ROS_SECURITY_KEYSTORE: empty, expected a keystore'}
# Maximum time to destroy the nodes [s]. Fast DDS 2.14 can deadlock if a publisher is destroyed
# while another participant times out.
_DESTRUCTION_S = 10
# Maximum time between two checks of `done`, and of a wait without it [s]. A wait without an end
# would take all of a processor.
_POLL_S, _WAIT_S = 0.1, 60.0


_NodeT = TypeVar('_NodeT', bound=Node)


class StartError(Exception):
    """A node cannot start."""


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Convert an error of rcl, a name, a parameter or a file to a `StartError` of one line."""
    try:
        with warnings.catch_warnings():
            # ROS warns when it destroys an incomplete node.
            warnings.simplefilter('ignore', RuntimeWarning)
            yield
    except rclpy_implementation.UnknownROSArgsError as error:
        raise StartError(f'invalid ROS arguments: {error}') from None
    except rclpy_implementation.RCLError as error:
        raise StartError(_reason(str(error))) from None
    except UnicodeEncodeError as error:
        raise StartError(f'argument {error.object!a}: expected UTF-8') from None
    except OSError as error:
        # Errors about the output, which have no file name, have their own exit codes.
        if error.filename is None:
            raise
        raise StartError(f'{error.filename}: {error.strerror}') from None
    except (NameValidationException, ParameterError, ParameterException, ScenarioError,
            CodebookError) as error:
        # rclpy marks the invalid character of a name in a further line.
        raise StartError(' '.join(str(error).split()).removesuffix(' ^')) from None


def _reason(text: str) -> str:
    """Return an error of rcl without positions in its sources and tokens of its parser."""
    for part, meaning in _MEANINGS.items():
        if part in text:
            return meaning
    text = re.sub(r',? at \S+:\d+|\.? Error: Expected lexeme.*', '', ' '.join(text.split()))
    return text.replace('Failed to parse ROS', 'invalid ROS').replace(
        'error creating node: Unable to resolve peer', 'ROS_STATIC_PEERS: no address of').strip()


def init(args: Sequence[str]) -> None:
    """Initialise rclpy with a command line that begins with the name of the program.

    Raises `StartError`. The signal handlers of rclpy are not installed, because they would
    invalidate the context while a callback publishes.
    """
    with starting():
        environment.use_discovery_profile()
        rclpy.init(args=[*args, *_enclave(args), *environment.log_arguments()],
                   signal_handler_options=SignalHandlerOptions.NO)


def _enclave(args: Sequence[str]) -> list[str]:
    """Return arguments that select an enclave of DDS security, if none is given.

    Nodes and ``replay`` have their full names as enclaves; all other tools have ``operator``.
    """
    if not environment.is_secure() or '--enclave' in args:
        return []
    rules = {match[1]: match[2] for match in map(_RULE.fullmatch, args) if match}
    program = os.path.basename(args[0])
    is_own = program in (*parameters.NODES, 'replay')
    enclave = f'{rules.get("ns", "").rstrip("/")}/' + (
        rules.get('node', rules.get('name', program)) if is_own else 'operator')
    folder = Path(os.environ.get('ROS_SECURITY_KEYSTORE', ''), 'enclaves', enclave.lstrip('/'))
    if os.environ.get(environment.STRATEGY) != 'Enforce' and not folder.is_dir():
        print(f'WITHOUT security: {environment.STRATEGY} is not Enforce, and there is no folder '
              f'{folder}', file=sys.stderr)
    return ['--ros-args', '--enclave', enclave]


def parse(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments of a command line, which may include ROS arguments.

    If an argument or an environment variable of ROS is invalid, exit with a usage error.
    """
    environment.check_environment(parser)
    try:
        with starting():
            words = remove_ros_args([parser.prog, *arguments])[1:]
    except StartError as error:
        parser.error(str(error))
    options, unknown = parser.parse_known_args(words)
    if unknown:
        advice = ''
        if any(word in _ROS_OPTIONS or ':=' in word for word in unknown):
            advice = '; ROS arguments follow --ros-args, as in --ros-args -p NAME:=VALUE'
        parser.error(f'unrecognized arguments: {" ".join(unknown)}{advice}')
    return options


def _wake_on_signals(executor: Executor) -> None:
    """Let each signal end a wait of the executor, which the handler of Python cannot."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)

    def wake() -> None:
        while os.read(reader, 1):
            executor.wake()
    threading.Thread(target=wake, daemon=True).start()


def spin(make: Callable[[], Sequence[_NodeT]], args: Sequence[str],
         done: Callable[[Sequence[_NodeT]], bool] | None = None) -> Sequence[_NodeT]:
    """Create nodes, spin them until a signal arrives or `done` returns True, and destroy them.

    `args` is a command line with the name of the program. Returns the nodes. Raises StartError if
    they cannot start.
    """
    signals: list[int] = []
    on_end_signals(lambda number, _: signals.append(number))
    nodes: Sequence[_NodeT] = ()
    executor = None
    try:
        init(args)
        with starting():
            nodes = make()
            parameters.check_nodes(nodes)
        executor = EventsExecutor()
        for node in nodes:
            executor.add_node(node)
        # A garbage collection that examines all modules can delay a cycle by tens of milliseconds.
        gc.collect()
        gc.freeze()
        _wake_on_signals(executor)
        while ok() and not signals and not (done and done(nodes)):
            # Other ways of spinning return, and react to signals, only when the queue is empty.
            try:
                executor.spin_once(timeout_sec=_POLL_S if done else _WAIT_S)
            # The queue may hold a request to a service that has been destroyed, for instance on
            # stand-by.
            except InvalidHandle:
                pass
    finally:
        signal.set_wakeup_fd(-1)
        # In a deadlocked middleware, a Python handler of SIGALRM would never run.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_DESTRUCTION_S)
        for node in nodes:
            node.destroy_node()  # type: ignore[no-untyped-call]
        if executor is not None:
            executor.shutdown()
        try_shutdown()
        signal.alarm(0)
        # Python restores the default handlers at exit. A further signal, for instance from
        # `ros2 launch` after Ctrl-C, would then kill a process that is about to exit normally.
        on_end_signals(signal.SIG_IGN)
    return nodes


def run(make: Callable[[], Sequence[Node]], args: Sequence[str]) -> int:
    """Spin nodes until a signal arrives; return exit code 0, or 2 if they cannot start."""
    def work() -> None:
        spin(make, args)
    return exit_code_of(work, (StartError,), os.path.basename(args[0]))


def entry(executable: str, make: Callable[[], Sequence[Node]]) -> Callable[..., int]:
    """Return the main function of an executable of `NODES` that has only ROS arguments.

    The help text begins with the docstring of the module in which `make` is defined.
    """
    def main(args: Sequence[str] | None = None) -> int:
        arguments = sys.argv[1:] if args is None else list(args)
        parser = parameters.make_parser(executable, sys.modules[make.__module__].__doc__ or '')
        parse(parser, arguments)
        parameters.check_arguments(parser, executable, arguments)
        return run(make, [executable, *arguments])
    return main
