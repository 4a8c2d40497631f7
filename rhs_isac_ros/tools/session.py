"""The hidden node of a command-line tool, and its exit codes."""

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.utilities import try_shutdown
from rclpy.validate_full_topic_name import validate_full_topic_name

from rhs_isac_ros.executables import discard_stdout
from rhs_isac_ros.ros.command_line import check_domain
from rhs_isac_ros.ros.early import WITHOUT_SERVICES, use_discovery_profile
from rhs_isac_ros.ros.security import SecurityError, one_line, prepare

# Changes of the graph do not wake the executor, so the graph is polled with this period [s].
_POLL_PERIOD_S = 0.02
# Discovery is complete when the graph has not changed for this time [s].
_SETTLE_S = 0.4


class ToolError(RuntimeError):
    """A command cannot be executed."""


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
        with Session() as session:
            options.verb(session, options)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except (ToolError, SecurityError) as error:
        print(error, file=sys.stderr)
        return 1
    except BrokenPipeError:
        discard_stdout()
    return 0
