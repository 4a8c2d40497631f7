"""The live view of a network, drawn with the library rich, which is optional."""

import numpy as np

from rhs_isac_ros.monitoring.overview import Fix, NodeHealth, Overview

# More users than this are counted, not shown.
_MOST_USERS = 20


def render(overview: Overview, now_s: float) -> object:
    """Draw the view.

    Parameters
    ----------
    overview
        What is known of the network.
    now_s
        The time, on the clock of the overview [s].

    Returns
    -------
    object
        What a console of rich prints.

    Raises
    ------
    ImportError
        If rich is not installed.
    """
    from rich.console import Group

    return Group(_head(overview, now_s), _users(overview, now_s), _nodes(overview, now_s))


def _head(overview: Overview, now_s: float) -> object:
    from rich.text import Text

    if not overview.phase:
        return Text('waiting for a base station', style='yellow')
    whose = f' of user {overview.user}' if overview.user else ''
    text = Text.assemble(
        (overview.phase, 'bold cyan'), f' for {now_s - overview.since_s:.2f} s, cycle '
        f'{overview.cycle_id}{whose}\n{overview.rate_hz(now_s):.1f} cycles/s, ',
        f'{overview.served} served, {overview.given_up} given up; ',
        f'codebook {_printable(overview.codebook_id) or "not known yet"}')
    if overview.failure:
        text.append(f'\nlast given up: {_printable(overview.failure)}', style='yellow')
    return text


def _table(title: str, *columns: tuple[str, str]) -> object:
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title, title_justify='left', title_style='bold', box=box.SIMPLE_HEAD,
                  pad_edge=False)
    for name, justify in columns:
        table.add_column(escape(name), justify=justify, no_wrap=justify == 'right')
    return table


def _users(overview: Overview, now_s: float) -> object:
    table = _table(
        'Users', ('user', 'right'), ('position\n[m]', 'right'), ('error\n[m]', 'right'),
        ('sigma\n[m]', 'right'), ('capacity\n[Mbit/s]', 'right'), ('loss\n[%]', 'right'),
        ('age\n[s]', 'right'))
    for fix in overview.fixes[:_MOST_USERS]:
        table.add_row(*_user_row(fix, now_s))
    fixed = len(overview.fixes)
    if fixed > _MOST_USERS:
        table.caption = f'and {fixed - _MOST_USERS} more'
    waiting = sorted(user for user, fix in overview.users.items() if fix is None)
    for user in waiting[:max(_MOST_USERS - fixed, 0)]:
        table.add_row(str(user), 'no fix yet', *[''] * 5)
    return table


def _user_row(fix: Fix, now_s: float) -> list[str]:
    record = fix.record
    place = ' '.join(f'{x:6.2f}' for x in record.estimate.position)
    return [str(record.user), place, f'{record.error_m:.2f}', f'{fix.sigma_m:.2f}',
            _number(record.capacity.actual_bps / 1e6, 2),
            _number(record.capacity.loss_percent, 3), f'{now_s - fix.seen_s:.1f}']


def _number(value: float, digits: int) -> str:
    return '' if np.isnan(value) else f'{value:.{digits}f}'


def _nodes(overview: Overview, now_s: float) -> object:
    table = _table('Nodes', ('node', 'left'), ('phase', 'left'), ('state', 'left'),
                   ('given up', 'left'), ('dropped', 'left'))
    for name, health in sorted(overview.nodes.items()):
        table.add_row(*_node_row(name, health, now_s))
    return table


def _node_row(name: str, health: NodeHealth, now_s: float) -> list[object]:
    from rich.text import Text

    state = Text(_printable(health.report.summary),
                 style='yellow' if health.report.fault else 'green')
    if health.silent(now_s):
        state = Text(f'silent for {now_s - health.seen_s:.0f} s', style='red')
    given_up = {reason: n for reason, n in health.counts('cycles').items() if reason != 'served'}
    # Text: what others send is no markup.
    phase = Text(_printable(health.report.values.get('phase', '')))
    return [Text(_printable(name)), phase, state, Text(_counts(given_up)),
            Text(_counts(health.counts('dropped')))]


def _counts(counts: dict[str, int]) -> str:
    return _printable(', '.join(f'{n} {reason}' for reason, n in counts.items())) or '0'


def _printable(text: str) -> str:
    """Return a text without what would control the terminal."""
    return ''.join(sign if sign.isprintable() else '?' for sign in text)
