"""What the commands share: their entry and exit codes, and the node of `topic` and `param`."""

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.utilities import try_shutdown
from rclpy.validate_full_topic_name import validate_full_topic_name

from rhs_isac_ros.calibration import CalibrationError
from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.executables import discard_stdout, print_error
from rhs_isac_ros.model import ScenarioError
from rhs_isac_ros.positioning import ModelError
from rhs_isac_ros.ros.recording import RecordingError
from rhs_isac_ros.ros.run import check_domain, parse
from rhs_isac_ros.ros.startup import (
    WITHOUT_SERVICES,
    SecurityError,
    is_enabled,
    one_line,
    prepare,
    use_discovery_profile,
)
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.arguments import check_distinct
from rhs_isac_ros.support.optional import MissingLibraryError

# Changes of the graph do not wake the executor, so the graph is polled with this period [s].
_POLL_PERIOD_S = 0.02
# Discovery is complete when the graph has not changed for this time [s]. It pauses while DDS
# security exchanges keys.
_SETTLE_S = 1.0 if is_enabled() else 0.4


# Errors of arguments and files.
INVALID = (RecordingError, ScenarioError, CodebookError, CalibrationError, ModelError,
           plugins.PluginError, OSError)


class ToolError(RuntimeError):
    """A command cannot be executed."""


def run_command(
        work: Callable[[argparse.Namespace, list[str]], int],
        parser: argparse.ArgumentParser, arguments: Sequence[str] | None,
        inputs: Sequence[str] = (), outputs: Sequence[str] = (),
        conflict: Callable[[argparse.Namespace], str] = lambda options: '') -> int:
    """Run a command whose command line may contain ROS arguments.

    Parameters
    ----------
    work
        Takes the options, and the name of the program with its command line; returns an exit code.
    arguments
        Command line; by default that of the process.
    inputs, outputs
        Options with names of files; no output may be an input or another output.
    conflict
        Returns the error if options contradict each other, otherwise ''.

    Returns
    -------
    int
        Exit code: that of `work`, usually 0, including after a signal or when the reader closes
        the output; 1 after a `ToolError`; 2 if an argument or a file is invalid.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = parse(parser, arguments)
    if problem := conflict(options):
        parser.error(problem)

    def named(names: Sequence[str]) -> dict[str, Path | None]:
        return {name: getattr(options, name.removeprefix('--')) for name in names}
    check_distinct(parser, named(inputs), named(outputs))
    try:
        return work(options, [parser.prog, *arguments])
    except KeyboardInterrupt:
        # The handlers of signals are not installed yet while libraries are imported.
        return 0
    except BrokenPipeError:
        discard_stdout()
        return 0
    except (ToolError, MissingLibraryError) as error:
        print_error(error, parser.prog)
        return 1
    except INVALID as error:
        print_error(error, parser.prog)
        return 2


class Session:
    """A context manager with one node, which the command itself spins."""

    def __init__(self) -> None:
        use_discovery_profile()
        rclpy.init(args=prepare(['']))
        with one_line():
            self.node = Node(f'_rhs_isac_cli_{os.getpid()}', **WITHOUT_SERVICES)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def __enter__(self) -> 'Session':
        """Return `self`."""
        return self

    def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None,
            traceback: TracebackType | None) -> None:
        """Destroy the node and shut the context down."""
        self._executor.shutdown()
        self.node.destroy_node()
        try_shutdown()

    def spin_until(self, condition: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Spin until a condition holds; return whether it does.

        Parameters
        ----------
        condition
            Evaluated after every callback and poll.
        timeout_s
            Maximum duration [s]; None: unlimited.
        """
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while not condition():
            if end_s is not None and time.monotonic() >= end_s:
                return False
            self._executor.spin_once(timeout_sec=_POLL_PERIOD_S)
        return True

    def discover(self, timeout_s: float) -> None:
        """Spin until other nodes have been discovered and the graph no longer changes.

        Parameters
        ----------
        timeout_s
            Maximum duration [s].
        """
        end_s = time.monotonic() + timeout_s
        graph, changed_s = self._graph(), time.monotonic()
        while (now_s := time.monotonic()) < end_s:
            self._executor.spin_once(timeout_sec=_POLL_PERIOD_S)
            previous, graph = graph, self._graph()
            if graph != previous:
                changed_s = now_s
            if len(self.node.get_node_names()) > 1 and now_s - changed_s > _SETTLE_S:
                return

    def _graph(self) -> list[Any]:
        return sorted([*self.node.get_topic_names_and_types(),
                       *self.node.get_node_names_and_namespaces()], key=repr)

    def full_name(self, topic: str) -> str:
        """Return the full name of a topic whose name may be relative.

        Raises
        ------
        ToolError
            If it is not a valid name of a topic.
        """
        try:
            name = expand_topic_name(topic, self.node.get_name(), self.node.get_namespace())
            validate_full_topic_name(name)
        except (ValueError, InvalidTopicNameException) as error:
            # The end of the text is a position in the sources of ROS.
            raise ToolError(str(error).partition(', at /')[0]) from None
        return name


def print_now(*values: object, end: str = '\n') -> None:
    """Print and flush, so that a pipe receives the text at once."""
    print(*values, end=end, flush=True)


def run_tool(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    """Run the command of a command line.

    Parameters
    ----------
    parser
        Its subparsers set ``verb``, a callable that takes session and options.
    arguments
        Command line; by default that of the process.

    Returns
    -------
    int
        Exit code: 0, including after a signal or when the reader closes the output; 1 after an
        error.
    """
    check_domain(parser)
    options = parser.parse_args(arguments)
    try:
        with Session() as session, one_line():
            options.verb(session, options)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except (ToolError, SecurityError) as error:
        print(error, file=sys.stderr)
        return 1
    except BrokenPipeError:
        discard_stdout()
    return 0
