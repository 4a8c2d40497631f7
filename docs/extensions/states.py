"""State diagrams and tables of the roles, from their tables of transitions."""

import collections
from typing import NamedTuple

import svg

from rhs_isac_ros.protocol.role import ANY, SAME, always, rows_for
from rhs_isac_ros.ros.roster import MEMBERS

# Sizes of the picture [px].
_BOX, _PORT, _GAP, _LANE, _LETTER = 150, 20, 30, 14, 6.8
ROLES = {name: member.role for name, member in MEMBERS.items() if hasattr(member.role, 'TABLE')}
HEAD = ('state', 'event', 'guard', 'next state', 'actions', 'counts')


class Edge(NamedTuple):
    """All transitions from a state to another; a label is an event with its guard."""

    source: object
    target: object
    labels: tuple

    @property
    def text(self):
        """The label of the arrow."""
        return ', '.join(self.labels)


def edges(role):
    """Return the changes of state of a role, one edge for each pair of states."""
    machine, found = ROLES[role], collections.defaultdict(list)
    for state in machine.STATES:
        for event in dict.fromkeys(row.event for row in machine.TABLE):
            for row in rows_for(machine.TABLE, state, event):
                if row.target is not SAME and row.target is not state:
                    guard = f' [{_guard(row)}]' if _guard(row) else ''
                    found[state, row.target].append(event.__name__ + guard)
                if row.guard is always:
                    break
    return [Edge(*pair, tuple(labels)) for pair, labels in found.items()]


def rows(role):
    """Return the table of a role as text, with the columns of `HEAD`; empty cells mean none."""
    return [(_source(row, ROLES[role].STATES), row.event.__name__, _guard(row),
             'the same' if row.target is SAME else row.target.value,
             ', '.join(action.__name__.lstrip('_') for action in row.actions),
             row.outcome.value if row.outcome else '')
            for row in ROLES[role].TABLE]


def _source(row, states):
    if row.source is ANY:
        return 'any'
    others = [state for state in states if state not in row.source]
    if len(others) == 1:
        return f'any but {others[0].value}'
    return ', '.join(state.value for state in row.source)


def _guard(row):
    return '' if row.guard is always else row.guard.__name__.lstrip('_')


def picture(role):
    """Return the diagram of a role as an SVG document.

    States are stacked in order. Arrows to the next state are drawn between the boxes, other
    forward arrows on the right, and backward arrows on the left.
    """
    states, found = list(ROLES[role].STATES), edges(role)
    place = {state: index for index, state in enumerate(states)}
    span = {edge: place[edge.target] - place[edge.source] for edge in found}
    steps = [edge for edge in found if span[edge] == 1]
    # The shortest arrows are innermost.
    sides = {1: sorted((edge for edge in found if span[edge] > 1), key=span.get),
             -1: sorted((edge for edge in found if span[edge] < 0), key=span.get, reverse=True)}
    tops, heights = _stack(states, sides)
    label = {side: _longest(group) for side, group in sides.items()}
    # The label of an arrow to the next state must fit too.
    label[1] = max(label[1], _longest(steps) + 6 - _BOX / 2)
    margin = {side: label[side] + (len(group) + 1) * _LANE + 10 for side, group in sides.items()}
    left, parts = margin[-1], []
    for state in states:
        y, height = tops[state], heights[state]
        parts.append(f'<rect x="{left:.0f}" y="{y}" width="{_BOX}" height="{height}" rx="6"/>')
        parts.append(
            svg.text(left + _BOX / 2, y + height / 2 + 4, state.value, 'middle', 'title'))
    for edge in steps:
        x, y = left + _BOX / 2, tops[edge.source] + heights[edge.source]
        parts.append(svg.arrow([(x, y), (x, tops[edge.target])]))
        parts.append(svg.text(x + 6, y + _GAP / 2 + 2, edge.text))
    for side, group in sides.items():
        box_x, ports = left + (_BOX if side > 0 else 0), _ports(states, group, tops)
        for lane, edge in enumerate(group, 1):
            x, begin, end = (
                box_x + side * (label[side] + 10 + _LANE * lane), ports[edge, True],
                ports[edge, False])
            parts.append(svg.arrow([(box_x, begin), (x, begin), (x, end), (box_x, end)]))
            parts.append(svg.text(
                box_x + side * 6, begin - 4, edge.text, 'start' if side > 0 else 'end'))
    return svg.document('states', f'States of {role}', left + _BOX + margin[1],
                        tops[states[-1]] + heights[states[-1]] + 10, parts)


def _longest(group):
    """Return the width of the longest label [px]."""
    return max((_LETTER * len(edge.text) for edge in group), default=0)


def _stack(states, sides):
    """Return upper edges and heights of the boxes, with room for all arrows at either side."""
    tops, heights, y = {}, {}, 10
    for state in states:
        ends = max(sum((edge.source is state) + (edge.target is state) for edge in group)
                   for group in sides.values())
        tops[state], heights[state] = y, _PORT * max(ends, 1) + 14
        y += heights[state] + _GAP
    return tops, heights


def _ports(states, group, tops):
    """Return the heights at which the edges of one side begin (True) and end (False)."""
    ports = {}
    for state in states:
        ends = [(edge, True) for edge in group if edge.source is state]
        ends += [(edge, False) for edge in group if edge.target is state]
        ports |= {end: tops[state] + 20 + _PORT * number for number, end in enumerate(ends)}
    return ports
