"""``scripts/watch``: shows a running network in the terminal."""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from rclpy.node import Node

from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.monitoring.cycle_log import RECEIVES
from rhs_isac_ros.monitoring.network_state import Fix, NodeStatus, Overview
from rhs_isac_ros.protocol.base_station import State
from rhs_isac_ros.ros.diagnostics import subscribe_reports
from rhs_isac_ros.ros.endpoints import subscribe_messages
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.ros.startup import WITHOUT_SERVICES
from rhs_isac_ros.support.arguments import ArgumentParser, nonnegative_float
from rhs_isac_ros.support.optional import optional_import
from rhs_isac_ros.tools.command import ToolError, print_now, run_command

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table


# Further users are counted, not shown.
_MAX_USERS = 20
_Justify = Literal['left', 'right']


def render(overview: Overview, now_s: float) -> 'RenderableType':
    """Return the view at a time [s], on the clock of the overview, for a console of rich.

    Raises
    ------
    ImportError
        If rich is not installed.
    """
    from rich.console import Group

    return Group(_header(overview, now_s), _users(overview, now_s), _nodes(overview, now_s))


def _header(overview: Overview, now_s: float) -> 'RenderableType':
    from rich.text import Text

    phase = State.PAUSED.value if overview.paused else overview.phase
    if not overview.phase:
        return Text(phase or 'waiting for a base station', style='yellow')
    user = f' of user {overview.user}' if overview.user else ''
    text = Text.assemble(
        (phase, 'bold cyan'), f' for {now_s - overview.phase_began_s:.2f} s, cycle '
        f'{overview.cycle_id}{user}\n{overview.rate_hz(now_s):.1f} cycles/s, ',
        f'{overview.served} served, {overview.given_up} given up; ',
        f'codebook {_printable(overview.codebook_id) or "not known yet"}')
    if overview.last_failure:
        text.append(f'\nlast given up: {_printable(overview.last_failure)}', style='yellow')
    return text


def _table(title: str, *columns: tuple[str, _Justify]) -> 'Table':
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title, title_justify='left', title_style='bold', box=box.SIMPLE_HEAD,
                  pad_edge=False)
    for name, justify in columns:
        table.add_column(escape(name), justify=justify, no_wrap=justify == 'right')
    return table


def _users(overview: Overview, now_s: float) -> 'RenderableType':
    table = _table(
        'Users', ('user', 'right'), ('position\n[m]', 'right'), ('error\n[m]', 'right'),
        ('sigma\n[m]', 'right'), ('capacity\n[Mbit/s]', 'right'), ('loss\n[%]', 'right'),
        ('age\n[s]', 'right'))
    # In order of their numbers, so that each user keeps its row.
    for user, fix in sorted(overview.users.items())[:_MAX_USERS]:
        table.add_row(*(_user_row(fix, now_s) if fix else (str(user), 'no fix yet', *[''] * 5)))
    if len(overview.users) > _MAX_USERS:
        table.caption = f'and {len(overview.users) - _MAX_USERS} more'
    return table


def _user_row(fix: Fix, now_s: float) -> list[str]:
    cycle = fix.cycle
    position = ' '.join(f'{x:6.2f}' for x in cycle.estimate.position)
    return [str(cycle.user), position, f'{cycle.error_m:.2f}', f'{fix.sigma_m:.2f}',
            _number(cycle.capacity.actual_bps / 1e6, 2),
            _number(cycle.capacity.loss_percent, 3), f'{now_s - fix.received_s:.1f}']


def _number(value: float, digits: int) -> str:
    return '' if np.isnan(value) else f'{value:.{digits}f}'


def _nodes(overview: Overview, now_s: float) -> 'RenderableType':
    table = _table('Nodes', ('node', 'left'), ('phase', 'left'), ('state', 'left'),
                   ('given up', 'left'), ('dropped', 'left'))
    for name, status in sorted(overview.nodes.items()):
        table.add_row(*_node_row(name, status, now_s))
    return table


def _node_row(name: str, status: NodeStatus, now_s: float) -> list['RenderableType']:
    from rich.text import Text

    state = Text(_printable(status.report.summary),
                 style='yellow' if status.report.fault else 'green')
    if status.silent(now_s):
        state = Text(f'silent for {now_s - status.received_s:.0f} s', style='red')
    given_up = {reason: n for reason, n in status.counts('cycles').items() if reason != 'served'}
    # Received strings are not markup, so they are wrapped in Text.
    phase = Text(_printable(status.report.values.get('phase', '')))
    return [Text(_printable(name)), phase, state, Text(_counts(given_up)),
            Text(_counts(status.counts('dropped')))]


def _counts(counts: dict[str, int]) -> str:
    return _printable(', '.join(f'{n} {reason}' for reason, n in counts.items())) or '0'


def _printable(text: str) -> str:
    """Replace characters that would control the terminal."""
    return ''.join(char if char.isprintable() else '?' for char in text)


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
        subscribe_reports(self, lambda name, report: self.overview.add_report(
            name, report, time.monotonic()))


def main(arguments: Sequence[str] | None = None) -> int:
    """Show a network until a signal arrives, or once; see `run_command`."""
    return run_command(_watch, _parser(), arguments)


def _watch(options: argparse.Namespace, arguments: list[str]) -> int:
    with optional_import('watch', extra=_PROGRAM):
        import rich  # noqa: F401
    return _print_once(options.timeout, arguments) if options.once else _show_live(arguments)


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
        raise ToolError(f'no complete cycle within {timeout_s:g} s, in the domain '
                        f'{os.environ.get("ROS_DOMAIN_ID", "0")} and this namespace')
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
