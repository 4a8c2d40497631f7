"""State diagrams and tables of the roles, generated from their tables of transitions.

``python -m rhs_isac_ros.protocol.diagram bs`` prints an SVG picture; ``--format mermaid`` and
``--format table`` print text.
"""

import argparse
import enum
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.diagram_svg import Edge, draw
from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.protocol.state_machine import (
    ANY,
    SAME,
    StateMachine,
    Transition,
    always,
    rows_for,
)
from rhs_isac_ros.protocol.user import User

ROLES: Mapping[str, type[StateMachine[Any]]] = {
    'bs': BaseStation, 'user': User, 'rhs_controller': RhsController}
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
             ', '.join(action.__name__ for action in row.actions),
             row.outcome.value if row.outcome else '')
            for row in ROLES[role].TABLE]


def _source(row: Transition[Any, Any, Any], states: type[enum.Enum]) -> str:
    if row.source is ANY:
        return 'any'
    others = [state for state in states if state not in row.source]
    if len(others) == 1:
        return f'any but {others[0].value}'
    return ', '.join(state.value for state in row.source)


def _guard(row: Transition[Any, Any, Any]) -> str:
    return '' if row.guard is always else row.guard.__name__


def _label(row: Transition[Any, Any, Any]) -> str:
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
