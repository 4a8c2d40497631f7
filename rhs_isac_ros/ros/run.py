"""Spinning and shutdown of the nodes of an executable."""

import gc
import os
import signal
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, try_shutdown

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.executables import print_error
from rhs_isac_ros.model import ScenarioError
from rhs_isac_ros.ros import command_line, parameters
from rhs_isac_ros.ros.early import leave, use_discovery_profile
from rhs_isac_ros.ros.parameters import ParameterError
from rhs_isac_ros.ros.security import SecurityError, one_line, prepare

# Maximum time between two checks for a signal.
_POLL_S = 0.1


def run(make: Callable[[], Sequence[Node]], args: Sequence[str] | None = None,
        done: Callable[[], bool] = lambda: False) -> int:
    """Create nodes, spin them in this thread until a signal arrives, and destroy them.

    SIGINT and SIGTERM only set a flag: the handlers of rclpy would invalidate the context while a
    callback publishes.

    Parameters
    ----------
    make
        Creates the nodes.
    args
        Command line with the name of the program; by default that of the process.
    done
        Polled; the nodes stop spinning when it returns True.

    Returns
    -------
    int
        Exit code: 0 after a signal, a shutdown or when done; 2 if a parameter or a file is
        invalid.
    """
    program = os.path.basename(args[0]) if args else ''
    # A list, because a handler may interrupt the other one and must not take a lock.
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
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
        # Without this, every collection examines all objects of the imported modules, which takes
        # tens of milliseconds, at any time during a cycle.
        gc.collect()
        gc.freeze()
        while ok() and not signals and not done():
            executor.spin_once(timeout_sec=_POLL_S)
    except ExternalShutdownException:
        pass
    except (ParameterError, ParameterException, ScenarioError, CodebookError,
            SecurityError) as error:
        print_error(error, program)
        return 2
    finally:
        leave()
        for node in nodes:
            node.destroy_node()
        if executor is not None:
            executor.shutdown()
        try_shutdown()
        # Python restores the default handlers when it exits. A further signal, as from Ctrl-C on
        # a launch, would then kill a process that is about to exit normally.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return 0


def entry(executable: str, make: Callable[[], Sequence[Node]]) -> Callable[..., int]:
    """Return the main function of an executable whose arguments are all ROS arguments.

    Parameters
    ----------
    executable
        Name of the executable, a key of `parameters.NODES`.
    make
        Creates the nodes; the docstring of its module describes the executable.

    Returns
    -------
    Callable
        Takes a command line, by default that of the process, and returns the exit code of `run`.
    """
    def main(args: Sequence[str] | None = None) -> int:
        arguments = sys.argv[1:] if args is None else list(args)
        first_line = (sys.modules[make.__module__].__doc__ or '').partition('\n')[0]
        parser = command_line.node_parser(executable, first_line)
        command_line.parse(parser, arguments)
        command_line.check_parameters(parser, executable, arguments)
        return run(make, [executable, *arguments])
    return main
