"""State diagrams show exactly the transitions of the roles."""


import pytest
import states

from rhs_isac_ros.protocol.role import ANY, SAME, always


def shown(function):
    """Return the name of a guard or an action as pages show it."""
    return function.__name__.lstrip('_')


def changes(role):
    """Return source, label and target of all changes of state, tried row by row."""
    machine, found = states.ROLES[role], set()
    for state in machine.STATES:
        unguarded = set()
        for row in machine.TABLE:
            if row.event in unguarded or not (row.source is ANY or state in row.source):
                continue
            if row.guard is always:
                unguarded.add(row.event)
            if row.target not in (SAME, state):
                guard = '' if row.guard is always else f' [{shown(row.guard)}]'
                found.add((state.value, row.event.__name__ + guard, row.target.value))
    return found


@pytest.mark.parametrize('role', states.ROLES)
def test_edges_are_the_changes_of_state(role):
    drawn = {(edge.source.value, label, edge.target.value)
             for edge in states.edges(role) for label in edge.labels}
    assert drawn == changes(role)
    pairs = [(edge.source, edge.target) for edge in states.edges(role)]
    assert len(pairs) == len(set(pairs))
