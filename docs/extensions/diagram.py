"""State diagrams and tables of the roles, generated from their tables of transitions.

``python3 docs/extensions/diagram.py bs`` prints an SVG picture; ``--format mermaid`` and
``--format table`` print text.
"""

import argparse
import enum
import html
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rhs_isac_ros.protocol.role import ANY, SAME, Row, StateMachine, always, rows_for
from rhs_isac_ros.ros.roster import ROSTER

# Sizes of the picture [px].
_BOX, _PORT, _GAP, _LANE, _LETTER = 150, 20, 30, 14, 6.8
# Pages may be dark, so the picture has their colour of text. They include it, so that its style
# must not match other pictures.
_STYLE = (
    '.states text{font:11px monospace;fill:currentColor}'
    '.states .state{font-weight:bold;font-size:13px}'
    '.states rect{fill:currentColor;fill-opacity:.08;stroke:currentColor}'
    '.states path{fill:none;stroke:currentColor;stroke-opacity:.6}'
    '.states .head{fill:currentColor;fill-opacity:.8}')


class Edge(NamedTuple):
    """All transitions from one state to another.

    Attributes
    ----------
    labels
        Event and guard of each transition.
    """

    source: enum.Enum
    target: enum.Enum
    labels: tuple[str, ...]

    @property
    def text(self) -> str:
        """The label of the arrow."""
        return ', '.join(self.labels)


def draw(name: str, states: Sequence[enum.Enum], edges: Sequence[Edge]) -> str:
    """Return the diagram of a role as an SVG document.

    States are stacked in order. Arrows to the next state are drawn between the boxes, other
    forward arrows on the right, and backward arrows on the left.
    """
    place = {state: index for index, state in enumerate(states)}
    steps = [edge for edge in edges if place[edge.target] - place[edge.source] == 1]
    sides = {1: [edge for edge in edges if place[edge.target] - place[edge.source] > 1],
             -1: [edge for edge in edges if place[edge.target] < place[edge.source]]}
    tops, heights = _stack(states, sides)
    label = {side: _longest(group) for side, group in sides.items()}
    # The label of an arrow to the next state must fit too.
    label[1] = max(label[1], _longest(steps) + 6 - _BOX / 2)
    margin = {side: label[side] + (len(group) + 1) * _LANE + 10 for side, group in sides.items()}
    left = margin[-1]
    width = left + _BOX + margin[1]
    parts = []
    for state in states:
        y, height = tops[state], heights[state]
        parts.append(f'<rect x="{left:.0f}" y="{y}" width="{_BOX}" height="{height}" rx="6"/>')
        parts.append(_text(left + _BOX / 2, y + height / 2 + 4, state.value, 'middle', 'state'))
    for edge in steps:
        x, y = left + _BOX / 2, tops[edge.source] + heights[edge.source]
        parts.append(_arrow([(x, y), (x, tops[edge.target])]))
        parts.append(_text(x + 6, y + _GAP / 2 + 2, edge.text))
    for side, group in sides.items():
        edge_x = left + (_BOX if side > 0 else 0)
        parts += _around(group, side, edge_x, label[side], _ports(states, group, tops), place)
    bottom = tops[states[-1]] + heights[states[-1]] + 10
    return (f'<svg xmlns="http://www.w3.org/2000/svg" class="states" width="{width:.0f}" '
            f'height="{bottom}" viewBox="0 0 {width:.0f} {bottom}" role="img">'
            f'<title>States of {name}</title>'
            f'<style>{_STYLE}</style>{"".join(parts)}</svg>')


def _longest(group: Sequence[Edge]) -> float:
    """Return the width of the longest label [px]."""
    return max((_LETTER * len(edge.text) for edge in group), default=0)


def _stack(states: Sequence[enum.Enum], sides: Mapping[int, Sequence[Edge]]
           ) -> tuple[dict[enum.Enum, int], dict[enum.Enum, int]]:
    """Return upper edges and heights of the boxes, with room for all arrows at either side."""
    tops, heights, y = {}, {}, 10
    for state in states:
        ends = max(sum((edge.source is state) + (edge.target is state) for edge in group)
                   for group in sides.values())
        tops[state], heights[state] = y, _PORT * max(ends, 1) + 14
        y += heights[state] + _GAP
    return tops, heights


def _ports(states: Sequence[enum.Enum], group: Sequence[Edge], tops: Mapping[enum.Enum, int]
           ) -> dict[tuple[Edge, bool], int]:
    """Return the heights at which the edges of one side begin (True) and end (False)."""
    ports: dict[tuple[Edge, bool], int] = {}
    for state in states:
        ends = [(edge, True) for edge in group if edge.source is state]
        ends += [(edge, False) for edge in group if edge.target is state]
        ports |= {end: tops[state] + 20 + _PORT * number for number, end in enumerate(ends)}
    return ports


def _around(group: Sequence[Edge], side: int, edge_x: float, label: float,
            ports: Mapping[tuple[Edge, bool], int], place: Mapping[enum.Enum, int]) -> list[str]:
    """Return arrows on one side, each in its own lane, the shortest innermost."""
    parts = []
    order = sorted(group, key=lambda edge: abs(place[edge.target] - place[edge.source]))
    for lane, edge in enumerate(order):
        x = edge_x + side * (label + 10 + _LANE * (lane + 1))
        begin, end = ports[edge, True], ports[edge, False]
        parts.append(_arrow([(edge_x, begin), (x, begin), (x, end), (edge_x, end)]))
        parts.append(_text(edge_x + side * 6, begin - 4, edge.text,
                           'start' if side > 0 else 'end'))
    return parts


def _arrow(points: Sequence[tuple[float, float]]) -> str:
    path = 'M' + ' L'.join(f'{x:.0f} {y:.0f}' for x, y in points)
    (x0, y0), (x, y) = points[-2:]
    length = abs(x - x0) + abs(y - y0)
    dx, dy = (x - x0) / length, (y - y0) / length
    corners = [(x, y), *((x - 8 * dx + s * 4 * dy, y - 8 * dy + s * 4 * dx) for s in (1, -1))]
    head = ' '.join(f'{a:.0f},{b:.0f}' for a, b in corners)
    return f'<path d="{path}"/><polygon class="head" points="{head}"/>'


def _text(x: float, y: float, text: str, anchor: str = 'start', kind: str = '') -> str:
    name = f' class="{kind}"' if kind else ''
    return (f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}"{name}>{html.escape(text)}'
            '</text>')


ROLES: Mapping[str, type[StateMachine]] = {
    name: member.role for name, member in ROSTER.items() if hasattr(member.role, 'TABLE')}
HEAD = ('state', 'event', 'guard', 'next state', 'actions', 'counts')


def edges(role: str) -> list[Edge]:
    """Return the state changes of a role (a key of `ROLES`), one edge per pair of states."""
    machine = ROLES[role]
    found: dict[tuple[enum.Enum, enum.Enum], list[str]] = {}
    for state in machine.STATES:
        for event in dict.fromkeys(row.event for row in machine.TABLE):
            for row in rows_for(machine.TABLE, state, event):
                if row.target is not SAME and row.target is not state:
                    found.setdefault((state, row.target), []).append(_label(row))
                if row.guard is always:
                    break
    return [Edge(*pair, tuple(labels)) for pair, labels in found.items()]


def rows(role: str) -> list[tuple[str, ...]]:
    """Return the table of a role as text, with the columns of `HEAD`; empty cells mean none."""
    return [(_source(row, ROLES[role].STATES), row.event.__name__, _guard(row),
             'the same' if row.target is SAME else row.target.value,
             ', '.join(action.__name__.lstrip('_') for action in row.actions),
             row.outcome.value if row.outcome else '')
            for row in ROLES[role].TABLE]


def _source(row: Row[Any, Any], states: type[enum.Enum]) -> str:
    if row.source is ANY:
        return 'any'
    others = [state for state in states if state not in row.source]
    if len(others) == 1:
        return f'any but {others[0].value}'
    return ', '.join(state.value for state in row.source)


def _guard(row: Row[Any, Any]) -> str:
    return '' if row.guard is always else row.guard.__name__.lstrip('_')


def _label(row: Row[Any, Any]) -> str:
    guard = _guard(row)
    return f'{row.event.__name__} [{guard}]' if guard else row.event.__name__


def mermaid(role: str) -> str:
    """Return the diagram of a role as a Mermaid ``stateDiagram-v2``."""
    first = next(iter(ROLES[role].STATES)).value
    lines = [f'  {edge.source.value} --> {edge.target.value}: {edge.text}'
             for edge in edges(role)]
    return '\n'.join(['stateDiagram-v2', f'  [*] --> {first}', *lines])


def svg(role: str) -> str:
    """Return the diagram of a role as a standalone SVG document."""
    return draw(role, list(ROLES[role].STATES), edges(role))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        prog='python3 docs/extensions/diagram.py', description='Draw the states of a role.')
    parser.add_argument('role', choices=tuple(ROLES))
    parser.add_argument('--format', choices=('svg', 'mermaid', 'table'), default='svg')
    options = parser.parse_args(arguments)
    if options.format == 'table':
        print('\n'.join('\t'.join(row) for row in rows(options.role)))
    else:
        print({'svg': svg, 'mermaid': mermaid}[options.format](options.role))
    return 0


if __name__ == '__main__':
    sys.exit(main())
