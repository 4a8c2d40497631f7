"""``scripts/watch``: shows a running network in the terminal."""

import argparse
import contextlib
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from rclpy.node import Node

from rhs_isac_ros.monitoring.cycle_log import RECEIVES, CompleteCycle
from rhs_isac_ros.monitoring.network_state import Overview
from rhs_isac_ros.protocol.base_station import BsState
from rhs_isac_ros.ros.diagnostics import subscribe_reports
from rhs_isac_ros.ros.endpoints import subscribe_messages
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.support.arguments import ArgumentParser, nonnegative_float
from rhs_isac_ros.support.optional import optional_import
from rhs_isac_ros.tools import command

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

# Maximum number of users in the table; the others are counted.
_MAX_USERS = 20
_PROGRAM = 'watch'
_REFRESH_PERIOD_S = 0.25
# Refresh period when the output is not a terminal [s].
_PRINT_PERIOD_S = 1.0
# Nodes publish diagnostics once a second, so all diagnostics have arrived after this time [s].
_DIAGNOSTICS_TIMEOUT_S = 1.3


def render(overview: Overview, now_s: float) -> 'RenderableType':
    """Return the view at `now_s` [s], a time as in `Overview.add`, for a console of rich."""
    from rich.console import Group

    return Group(_header(overview, now_s), _users(overview, now_s), _nodes(overview, now_s))


def _header(overview: Overview, now_s: float) -> 'RenderableType':
    from rich.text import Text

    phase = BsState.PAUSED.value if overview.paused else overview.phase
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


def _table(title: str, justify: Literal['left', 'right'], *heads: str) -> 'Table':
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title, title_justify='left', title_style='bold', box=box.SIMPLE_HEAD,
                  pad_edge=False)
    for head in heads:
        table.add_column(escape(head), justify=justify, no_wrap=justify == 'right')
    return table


def _users(overview: Overview, now_s: float) -> 'RenderableType':
    table = _table('Users', 'right', 'user', 'position\n[m]', 'error\n[m]', 'sigma\n[m]',
                   'out/blk\n[%]', 'capacity\n[Mbit/s]', 'loss\n[%]', 'age\n[s]')
    # Sorted, so that users keep their order.
    for user, cycle in sorted(overview.users.items())[:_MAX_USERS]:
        table.add_row(str(user), *(_results(cycle, now_s) if cycle else ['no fix yet']))
    notes = [f'and {len(overview.users) - _MAX_USERS} more'] * (len(overview.users) > _MAX_USERS)
    if any(map(_probabilities, overview.users.values())):
        notes.append('out/blk: probability of being outside of the region/blocked')
    table.caption = '; '.join(notes) or None
    return table


def _probabilities(cycle: CompleteCycle | None) -> str:
    percent = (100 * cycle.estimate.outside_probability, 100 * cycle.estimate.blocked_probability
              ) if cycle else ()
    return '{:.0f}/{:.0f}'.format(*percent) if any(percent) else ''


def _results(cycle: CompleteCycle, now_s: float) -> list[str]:
    position = ' '.join(f'{x:6.2f}' for x in cycle.estimate.position)
    return [position, f'{cycle.error_m:.2f}', f'{cycle.sigma_m:.2f}', _probabilities(cycle),
            _number(cycle.capacity.actual_bps / 1e6, 2),
            _number(cycle.capacity.loss_percent, 3), f'{now_s - cycle.ended_s:.1f}']


def _number(value: float, digits: int) -> str:
    return '' if np.isnan(value) else f'{value:.{digits}f}'


def _nodes(overview: Overview, now_s: float) -> 'RenderableType':
    from rich.text import Text

    table = _table('Nodes', 'left', 'node', 'phase', 'state', 'given up', 'dropped')
    for name, status in sorted(overview.nodes.items()):
        report, given_up = status.report, status.counts('cycles')
        given_up.pop('served', None)
        state = Text(_printable(report.summary), style='yellow' if report.fault else 'green')
        if status.silent(now_s):
            state = Text(f'silent for {now_s - status.received_s:.0f} s', style='red')
        # `Text` prevents rich from interpreting received strings as markup.
        table.add_row(
            Text(_printable(name)), Text(_printable(report.details.get('phase', ''))), state,
            Text(_counts(given_up)), Text(_counts(status.counts('dropped'))))
    return table


def _counts(counts: dict[str, int]) -> str:
    return _printable(', '.join(f'{n} {reason}' for reason, n in counts.items())) or '0'


def _printable(text: str) -> str:
    """Replace characters that could control the terminal."""
    return ''.join(char if char.isprintable() else '?' for char in text)


class WatchNode(Node):
    """Maintains an overview of the network in its namespace, with times of `time.monotonic`."""

    def __init__(self) -> None:
        super().__init__('watch', **WITHOUT_SERVICES)
        self.overview = Overview()
        # Log messages would disturb the view, and the nodes already count malformed messages.
        subscribe_messages(self, RECEIVES, None, self.overview.add, lambda error: None)
        subscribe_reports(self, lambda name, report: self.overview.add_report(
            name, report, time.monotonic()))


def _watch(options: argparse.Namespace, arguments: list[str]) -> int:
    with optional_import('watch', extra=_PROGRAM):
        import rich  # noqa: F401
    return _print_once(options.timeout, arguments) if options.once else _show_live(arguments)


def _show_live(arguments: Sequence[str]) -> int:
    """Redraw the view on a terminal; elsewhere, print one view after another."""
    from rich.console import Console
    from rich.live import Live

    console, drawn_s = Console(), 0.0
    on_terminal = Live(console=console, screen=True, auto_refresh=False)
    with on_terminal if console.is_terminal else contextlib.nullcontext() as live:
        period_s = _REFRESH_PERIOD_S if live else _PRINT_PERIOD_S

        def refresh(node: WatchNode) -> bool:
            """Draw between two iterations of the executor; an exception here ends the program."""
            nonlocal drawn_s
            now_s = time.monotonic()
            if now_s > drawn_s + period_s:
                drawn_s = now_s
                view = render(node.overview, now_s)
                if live:
                    live.update(view, refresh=True)
                else:
                    with console.capture() as text:
                        console.print(view)
                    command.print_now(text.get())
            return False
        command.observe(WatchNode, arguments, refresh)
    return 0


def _print_once(timeout_s: float, arguments: Sequence[str]) -> int:
    from rich.console import Console

    end_s = time.monotonic() + timeout_s

    def done(node: WatchNode) -> bool:
        now_s = time.monotonic()
        return now_s > end_s or bool(
            any(node.overview.users.values())
            and now_s > node.overview.began_s + _DIAGNOSTICS_TIMEOUT_S)
    node = command.observe(lambda: command.expecting_cycles(WatchNode()), arguments, done)
    if any(node.overview.users.values()):
        Console().print(render(node.overview, time.monotonic()))
    elif time.monotonic() > end_s:
        raise command.none_within('no complete cycle', timeout_s)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog=_PROGRAM, description='Show phase, users, losses and faults of a network until '
        'Ctrl-C.')
    parser.add_argument('--once', action='store_true',
                        help='wait for one complete cycle, print the view, and exit')
    parser.add_argument('--timeout', type=nonnegative_float, default=60.0, metavar='S',
                        help='maximum wait of --once (default: 60 s)')
    return parser


main = command.entry(_watch, _parser)
