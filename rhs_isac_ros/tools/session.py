"""A command's node, hidden from lists of nodes, and the way every command ends."""

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from types import TracebackType

import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.validate_full_topic_name import validate_full_topic_name

from rhs_isac_ros.ros.run import use_discovery_profile

# How often to look at the graph, which wakes nobody up [s].
_POLL_S = 0.02
# A graph that stays the same for so long is taken for complete [s].
_SETTLED_S = 0.4


class ToolError(RuntimeError):
    """A command cannot do what it is asked for."""


class Session:
    """A context with one node, which the command itself spins.

    Attributes
    ----------
    node
        The node.
    """

    def __init__(self) -> None:
        use_discovery_profile()
        rclpy.init(args=[])
        self.node = Node(f'_rhs_isac_cli_{os.getpid()}', start_parameter_services=False)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def __enter__(self) -> 'Session':
        """Return itself."""
        return self

    def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None,
            traceback: TracebackType | None) -> None:
        """End the node and the context."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def until(self, condition: Callable[[], bool], patience_s: float | None = None) -> bool:
        """Spin until a condition holds.

        Parameters
        ----------
        condition
            The condition.
        patience_s
            How long to wait for it [s]; None: without end.

        Returns
        -------
        bool
            Whether it holds.
        """
        end_s = None if patience_s is None else time.monotonic() + patience_s
        while not condition():
            if end_s is not None and time.monotonic() >= end_s:
                return False
            self._executor.spin_once(timeout_sec=_POLL_S)
        return True

    def discover(self, patience_s: float) -> None:
        """Spin until others are in the graph and no more come, or until patience ends.

        Parameters
        ----------
        patience_s
            How long at most [s].
        """
        end_s = time.monotonic() + patience_s
        graph, since_s = self._graph(), time.monotonic()
        while (now_s := time.monotonic()) < end_s:
            self._executor.spin_once(timeout_sec=_POLL_S)
            before, graph = graph, self._graph()
            if graph != before:
                since_s = now_s
            if len(self.node.get_node_names()) > 1 and now_s - since_s > _SETTLED_S:
                return

    def _graph(self) -> list:
        return sorted([*self.node.get_topic_names_and_types(),
                       *self.node.get_node_names_and_namespaces()], key=repr)

    def full_name(self, topic: str) -> str:
        """Return a topic's full name.

        Parameters
        ----------
        topic
            The name, perhaps relative.

        Returns
        -------
        str
            The name from the root.

        Raises
        ------
        ToolError
            If it is no name of a topic.
        """
        try:
            name = expand_topic_name(topic, self.node.get_name(), self.node.get_namespace())
            validate_full_topic_name(name)
        except (ValueError, InvalidTopicNameException) as error:
            raise ToolError(str(error)) from None
        return name


def say(*values: object, end: str = '\n') -> None:
    """Print at once, also into a pipe.

    Parameters
    ----------
    *values
        What to print.
    end
        What to end with.
    """
    print(*values, end=end, flush=True)


def run_tool(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    """Run the command that a parser's default ``verb`` names.

    Parameters
    ----------
    parser
        Its subparsers set ``verb``, a function of session and options.
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code: 0, also after a signal or when nobody reads on; 1 if something is wrong.
    """
    options = parser.parse_args(arguments)
    try:
        with Session() as session:
            options.verb(session, options)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except ToolError as error:
        print(error, file=sys.stderr)
        return 1
    except BrokenPipeError:
        # Python flushes once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
