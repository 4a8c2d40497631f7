"""How every node spins and ends."""

import os
import signal
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import ScenarioError
from rhs_isac_ros.ros.parameters import ParameterError
from rhs_isac_ros.ros.resources import discovery_profile_file

# The executor looks at least this often whether a signal has come.
_POLL_S = 0.5
# Where Fast DDS is told of a file with profiles.
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'


def find_each_other_quickly() -> None:
    """Have Fast DDS tell sooner than usual who is gone and who is back, in this process.

    It reads a profile when the first node is made. One that the environment names already stays;
    an empty name stands for none at all.
    """
    file = os.environ.setdefault(_PROFILES, str(discovery_profile_file()))
    if not file:
        # Fast DDS would complain of it.
        del os.environ[_PROFILES]


def run(make: Callable[[], Sequence[Node]], args: Sequence[str] | None = None,
        done: Callable[[], bool] = lambda: False) -> int:
    """Make nodes, spin them in this thread until a signal comes, and clean up.

    SIGINT and SIGTERM only set a flag: rclpy's own handlers would take the context away from a
    callback that is just about to publish.

    Parameters
    ----------
    make
        Makes the nodes.
    args
        Command line; by default the process's.
    done
        Asked again and again whether to end without a signal.

    Returns
    -------
    int
        Exit code: 0 after a signal, a shutdown or when done, 2 if a parameter or a file is wrong.
    """
    # A list: a handler may interrupt the other one, and must take no lock.
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
    find_each_other_quickly()
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    nodes: Sequence[Node] = ()
    executor = None
    try:
        nodes = make()
        executor = EventsExecutor()
        for node in nodes:
            executor.add_node(node)
        while rclpy.ok() and not signals and not done():
            executor.spin_once(timeout_sec=_POLL_S)
    except ExternalShutdownException:
        pass
    except (ParameterError, ParameterException, ScenarioError, CodebookError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    finally:
        for node in nodes:
            node.destroy_node()
        if executor is not None:
            executor.shutdown()
        rclpy.try_shutdown()
        # Python gives a handler back when it ends: one more signal, as with Ctrl-C on a launch,
        # would then kill what ends well.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return 0


def entry(make: Callable[[], Sequence[Node]]) -> Callable[..., int]:
    """Return the main function of an executable.

    Parameters
    ----------
    make
        Makes its nodes.

    Returns
    -------
    Callable
        Takes a command line, by default the process's, and returns the exit code of `run`.
    """
    def main(args: Sequence[str] | None = None) -> int:
        return run(make, args)
    return main
