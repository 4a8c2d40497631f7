"""The live view of a network, drawn with the optional library rich."""

from typing import TYPE_CHECKING, Literal

import numpy as np

from rhs_isac_ros.monitoring.overview import Fix, NodeStatus, Overview
from rhs_isac_ros.protocol.base_station import State

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
