"""``scripts/watch``: a network at work, in the terminal."""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from rhs_isac_ros.monitoring.overview import RECEIVES, Overview
from rhs_isac_ros.ros import diagnostics, qos, topics
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.ros.subscriptions import listen, subscribe
from rhs_isac_ros.tools.session import say
from rhs_isac_ros.tools.watch_view import render

_REFRESH_S = 0.25
# Every node tells of itself once in this time; with some room.
_ROUND_S = 1.3


class WatchNode(Node):
    """Keeps an overview of its namespace.

    Attributes
    ----------
    overview
        The overview, on the clock `time.monotonic`.
    """

    def __init__(self) -> None:
        super().__init__('watch', start_parameter_services=False)
        self.overview = Overview()
        # What is malformed, the nodes count: a word in the log would go across the view.
        listen(self, RECEIVES, None,
               lambda message: self.overview.add(message, time.monotonic()), lambda error: None)
        subscribe(self, DiagnosticArray, topics.DIAGNOSTICS, self._hear, qos.EXCHANGE)

    def _hear(self, message: DiagnosticArray) -> None:
        for name, report in diagnostics.from_ros(message):
            self.overview.hear(name, report, time.monotonic())


def main(arguments: Sequence[str] | None = None) -> int:
    """Show a network until a signal comes, or once.

    Parameters
    ----------
    arguments
        Command line, ROS arguments among it; by default the process's.

    Returns
    -------
    int
        Exit code: 0, also after a signal; 1 if rich is missing or, with ``--once``, no cycle was
        seen.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = _parser().parse_args(remove_ros_args(['watch', *arguments])[1:])
    try:
        import rich  # noqa: F401
    except ImportError:
        print('error: watch needs rich, which is not installed (pip install rich)',
              file=sys.stderr)
        return 1
    arguments = ['watch', *arguments]
    try:
        return _once(options.timeout, arguments) if options.once else _live(arguments)
    except BrokenPipeError:
        # Python flushes once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _live(arguments: Sequence[str]) -> int:
    from rich.console import Console
    from rich.live import Live

    nodes, drawn_s, console = [], 0.0, Console()
    # Without a terminal there is nothing to draw over: each view follows the last one.
    if not console.is_terminal:
        def draw(view: object) -> None:
            with console.capture() as text:
                console.print(view)
            say(text.get())
        frame, period_s = contextlib.nullcontext(), 4 * _REFRESH_S
    else:
        frame = live = Live(console=console, screen=True, auto_refresh=False)

        def draw(view: object) -> None:
            live.update(view, refresh=True)
        period_s = _REFRESH_S

    def refresh() -> bool:
        """Draw between two turns of the executor, where an error is not lost in a callback."""
        nonlocal drawn_s
        now_s = time.monotonic()
        if now_s > drawn_s + period_s:
            drawn_s = now_s
            draw(render(nodes[0].overview, now_s))
        return False
    with frame:
        return run(lambda: _made(nodes), arguments, refresh)


def _once(timeout_s: float, arguments: Sequence[str]) -> int:
    from rich.console import Console

    nodes, began_s = [], time.monotonic()

    def done() -> bool:
        overview, now_s = nodes[0].overview, time.monotonic()
        return now_s > began_s + timeout_s or bool(
            overview.fixes and now_s > overview.began_s + _ROUND_S)
    code = run(lambda: _made(nodes), arguments, done)
    if nodes and nodes[0].overview.fixes:
        Console().print(render(nodes[0].overview, time.monotonic()))
    elif time.monotonic() - began_s > timeout_s:
        print(f'error: no complete cycle within {timeout_s:g} s, in the domain '
              f'{os.environ.get("ROS_DOMAIN_ID", "0")} and this namespace', file=sys.stderr)
        return 1
    return code


def _made(nodes: list[WatchNode]) -> list[WatchNode]:
    nodes.append(WatchNode())
    return nodes


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='watch', description='Show phase, users, losses and faults of a network until '
        'Ctrl-C. ROS arguments choose the namespace: --ros-args -r __ns:=/lab')
    parser.add_argument('--once', action='store_true',
                        help='wait for one complete cycle, print the view, end')
    parser.add_argument('--timeout', type=float, default=60.0, metavar='S',
                        help='how long --once waits (default: 60 s)')
    return parser


if __name__ == '__main__':
    sys.exit(main())
