"""State diagrams, drawn from the tables that the roles run on.

``python -m rhs_isac_ros.protocol.diagram bs`` prints an SVG picture, with ``--format mermaid`` or
``--format table`` text.
"""

import argparse
import enum
import html
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rhs_isac_ros.protocol import base_station_table as bs_table
from rhs_isac_ros.protocol import rhs_controller, user
from rhs_isac_ros.protocol.state_machine import ANY, SAME, Transition

# States of every role, the first one first, and its table.
ROLES: Mapping[str, tuple[type[enum.Enum], Mapping[tuple, Transition]]] = {
    'bs': (bs_table.State, bs_table.TABLE),
    'user': (user.State, user.TABLE),
    'rhs_controller': (rhs_controller.State, rhs_controller.TABLE),
}
# Sizes of the picture [px].
_BOX, _PORT, _GAP, _LANE, _LETTER = 150, 20, 30, 14, 6.8
_STYLE = (
    'text{font:11px monospace;fill:#222}.state{font-weight:bold;font-size:13px}'
    'rect{fill:#eef3fa;stroke:#345}path{fill:none;stroke:#567}.head{fill:#567;stroke:none}')


class Edge(NamedTuple):
    """Transitions between two states.

    Attributes
    ----------
    source, target
        The states; they differ.
    inputs
        What leads from one to the other.
    """

    source: enum.Enum
    target: enum.Enum
    inputs: tuple[str, ...]


def edges(role: str) -> list[Edge]:
    """Gather the changes of state.

    Parameters
    ----------
    role
        A key of `ROLES`.

    Returns
    -------
    list of Edge
        One for each pair of states. A row for any state counts for each that has no row of its
        own for that input.
    """
    states, table = ROLES[role]
    found: dict[tuple[enum.Enum, enum.Enum], list[str]] = {}
    for (source, event), step in table.items():
        if step.to is SAME:
            continue
        own = [source] if source is not ANY else [
            state for state in states if (state, event) not in table]
        for state in own:
            if state is not step.to:
                found.setdefault((state, step.to), []).append(event.value)
    return [Edge(*pair, tuple(inputs)) for pair, inputs in found.items()]


def rows(role: str) -> list[tuple[str, str, str, str, str]]:
    """List a table as text.

    Parameters
    ----------
    role
        A key of `ROLES`.

    Returns
    -------
    list of tuple
        State, input, next state, actions and counter of every row; empty where there is none.
    """
    return [('any' if source is ANY else source.value, event.value,
             'the same' if step.to is SAME else step.to.value,
             ', '.join(step.do), step.counts)
            for (source, event), step in ROLES[role][1].items()]


def mermaid(role: str) -> str:
    """Write the diagram for Mermaid.

    Parameters
    ----------
    role
        A key of `ROLES`.

    Returns
    -------
    str
        A ``stateDiagram-v2``.
    """
    first = next(iter(ROLES[role][0])).value
    lines = [f'  {edge.source.value} --> {edge.target.value}: {", ".join(edge.inputs)}'
             for edge in edges(role)]
    return '\n'.join(['stateDiagram-v2', f'  [*] --> {first}', *lines])


def svg(role: str) -> str:
    """Draw the diagram: states below each other, the way on at the right, the way back left.

    Parameters
    ----------
    role
        A key of `ROLES`.

    Returns
    -------
    str
        An SVG document that needs nothing else.
    """
    states, found = list(ROLES[role][0]), edges(role)
    place = {state: index for index, state in enumerate(states)}
    steps = [edge for edge in found if place[edge.target] - place[edge.source] == 1]
    sides = {1: [edge for edge in found if place[edge.target] - place[edge.source] > 1],
             -1: [edge for edge in found if place[edge.target] < place[edge.source]]}
    tops, heights = _stack(states, sides)
    label = {side: _longest(group) for side, group in sides.items()}
    # What is written beside the way on to the next state must fit too.
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
        parts.append(_text(x + 6, y + _GAP / 2 + 2, ', '.join(edge.inputs)))
    for side, group in sides.items():
        edge_x = left + (_BOX if side > 0 else 0)
        parts += _around(group, side, edge_x, label[side], _ports(states, group, tops), place)
    bottom = tops[states[-1]] + heights[states[-1]] + 10
    return (f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{bottom}" '
            f'viewBox="0 0 {width:.0f} {bottom}" role="img"><title>States of {role}</title>'
            f'<style>{_STYLE}</style>{"".join(parts)}</svg>')


def _longest(group: Sequence[Edge]) -> float:
    """Width of the longest label [px]."""
    return max((_LETTER * len(', '.join(edge.inputs)) for edge in group), default=0)


def _stack(states: Sequence[enum.Enum], sides: Mapping[int, Sequence[Edge]]
           ) -> tuple[dict[enum.Enum, int], dict[enum.Enum, int]]:
    """Upper edges and heights of the boxes, with room for what begins and ends at either side."""
    tops, heights, y = {}, {}, 10
    for state in states:
        ends = max(sum((edge.source is state) + (edge.target is state) for edge in group)
                   for group in sides.values())
        tops[state], heights[state] = y, _PORT * max(ends, 1) + 14
        y += heights[state] + _GAP
    return tops, heights


def _ports(states: Sequence[enum.Enum], group: Sequence[Edge], tops: Mapping[enum.Enum, int]
           ) -> dict[tuple[Edge, bool], int]:
    """Heights where the edges of one side begin (True) and end (False)."""
    ports = {}
    for state in states:
        ends = [(edge, True) for edge in group if edge.source is state]
        ends += [(edge, False) for edge in group if edge.target is state]
        ports |= {end: tops[state] + 20 + _PORT * number for number, end in enumerate(ends)}
    return ports


def _around(group: Sequence[Edge], side: int, edge_x: float, label: float,
            ports: Mapping[tuple[Edge, bool], int], place: Mapping[enum.Enum, int]) -> list[str]:
    """Arrows out of a side, along a lane of their own, and back in; short ways further inside."""
    parts = []
    order = sorted(group, key=lambda edge: abs(place[edge.target] - place[edge.source]))
    for lane, edge in enumerate(order):
        x = edge_x + side * (label + 10 + _LANE * (lane + 1))
        begin, end = ports[edge, True], ports[edge, False]
        parts.append(_arrow([(edge_x, begin), (x, begin), (x, end), (edge_x, end)]))
        parts.append(_text(edge_x + side * 6, begin - 4, ', '.join(edge.inputs),
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code: 0.
    """
    parser = argparse.ArgumentParser(
        prog='python -m rhs_isac_ros.protocol.diagram', description='Draw the states of a role.')
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
