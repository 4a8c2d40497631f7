"""``scripts/watch``: shows a running network in the terminal."""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from rhs_isac_ros.executables import discard_stdout, exit_code_of, print_error
from rhs_isac_ros.model.arguments import ArgumentParser, nonnegative_float
from rhs_isac_ros.model.optional import MissingLibraryError, optional_import
from rhs_isac_ros.monitoring.overview import RECEIVES, Overview
from rhs_isac_ros.ros import diagnostics, qos, topics
from rhs_isac_ros.ros.command_line import parse
from rhs_isac_ros.ros.early import WITHOUT_SERVICES
from rhs_isac_ros.ros.endpoints import subscribe, subscribe_messages
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.tools.session import print_now
from rhs_isac_ros.tools.watch_view import render

if TYPE_CHECKING:
    from rich.console import RenderableType

_PROGRAM = 'watch'
_REFRESH_PERIOD_S = 0.25
# Refresh period when the output is not a terminal [s].
_PRINT_PERIOD_S = 1.0
# Every node has reported its diagnostics after this time: they are published once a second.
_DIAGNOSTICS_TIMEOUT_S = 1.3


class WatchNode(Node):
    """Maintains an overview of its namespace.

    Attributes
    ----------
    overview
        The overview, with times of `time.monotonic`.
    """

    def __init__(self) -> None:
        super().__init__('watch', **WITHOUT_SERVICES)
        self.overview = Overview()
        # Log messages would disturb the view; the nodes themselves count malformed messages.
        subscribe_messages(
            self, RECEIVES, None,
            lambda message: self.overview.add(message, time.monotonic()), lambda error: None)
        subscribe(self, DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, qos.EXCHANGE)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for name, report in diagnostics.from_ros(message):
            self.overview.add_report(name, report, time.monotonic())


def main(arguments: Sequence[str] | None = None) -> int:
    """Show a network until a signal arrives, or once.

    Parameters
    ----------
    arguments
        Command line including ROS arguments; by default that of the process.

    Returns
    -------
    int
        Exit code: 0, including after a signal; 1 if rich is missing or, with ``--once``, no cycle
        was complete in time.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = parse(_parser(), arguments)
    try:
        with optional_import('watch', extra=_PROGRAM):
            import rich  # noqa: F401
    except MissingLibraryError as error:
        print_error(error, _PROGRAM)
        return 1
    arguments = [_PROGRAM, *arguments]
    try:
        return _print_once(options.timeout, arguments) if options.once else _show_live(arguments)
    except BrokenPipeError:
        discard_stdout()
        return 0


def _show_live(arguments: Sequence[str]) -> int:
    nodes: list[WatchNode] = []
    drawn_s = 0.0
    with contextlib.ExitStack() as stack:
        draw, period_s = _renderer(stack)

        def refresh() -> bool:
            """Draw between two executor iterations; an exception here ends the program."""
            nonlocal drawn_s
            now_s = time.monotonic()
            if now_s > drawn_s + period_s:
                drawn_s = now_s
                draw(render(nodes[0].overview, now_s))
            return False
        return run(lambda: _create(nodes), arguments, refresh)


def _renderer(
        stack: contextlib.ExitStack) -> tuple[Callable[['RenderableType'], None], float]:
    """Return a function that shows a view, and the period of its calls [s].

    On a terminal, each view replaces the previous one until the stack is closed; otherwise the
    views are printed one after the other.
    """
    from rich.console import Console
    from rich.live import Live

    console = Console()
    if console.is_terminal:
        live = stack.enter_context(Live(console=console, screen=True, auto_refresh=False))
        return lambda view: live.update(view, refresh=True), _REFRESH_PERIOD_S

    def print_view(view: 'RenderableType') -> None:
        with console.capture() as text:
            console.print(view)
        print_now(text.get())
    return print_view, _PRINT_PERIOD_S


def _print_once(timeout_s: float, arguments: Sequence[str]) -> int:
    from rich.console import Console

    nodes: list[WatchNode] = []
    began_s = time.monotonic()

    def done() -> bool:
        overview, now_s = nodes[0].overview, time.monotonic()
        return now_s > began_s + timeout_s or bool(
            overview.fixes and now_s > overview.began_s + _DIAGNOSTICS_TIMEOUT_S)
    code = run(lambda: _create(nodes), arguments, done)
    if nodes and nodes[0].overview.fixes:
        Console().print(render(nodes[0].overview, time.monotonic()))
    elif time.monotonic() - began_s > timeout_s:
        print_error(f'no complete cycle within {timeout_s:g} s, in the domain '
                    f'{os.environ.get("ROS_DOMAIN_ID", "0")} and this namespace', _PROGRAM)
        return 1
    return code


def _create(nodes: list[WatchNode]) -> list[WatchNode]:
    nodes.append(WatchNode())
    return nodes


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog=_PROGRAM, description='Show phase, users, losses and faults of a network until '
        'Ctrl-C. ROS arguments select the namespace: --ros-args -r __ns:=/lab')
    parser.add_argument('--once', action='store_true',
                        help='wait for one complete cycle, print the view, and exit')
    parser.add_argument('--timeout', type=nonnegative_float, default=60.0, metavar='S',
                        help='maximum wait of --once (default: 60 s)')
    return parser


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
