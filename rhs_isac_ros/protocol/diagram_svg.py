"""State diagrams as SVG pictures."""

import enum
import html
from collections.abc import Mapping, Sequence
from typing import NamedTuple

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
