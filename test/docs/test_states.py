"""State diagrams and tables show exactly the transitions of the roles."""


import pytest
import states

from rhs_isac_ros.protocol.role import ANY, SAME, always

each_role = pytest.mark.parametrize('role', states.ROLES)


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


@each_role
def test_edges_are_the_changes_of_state(role):
    drawn = {(edge.source.value, label, edge.target.value)
             for edge in states.edges(role) for label in edge.labels}
    assert drawn == changes(role)
    pairs = [(edge.source, edge.target) for edge in states.edges(role)]
    assert len(pairs) == len(set(pairs))


@each_role
def test_the_table_has_every_row(role):
    rows, table = states.rows(role), states.ROLES[role].TABLE
    for (state, event, guard, target, actions, counter), row in zip(rows, table, strict=True):
        if row.source is ANY:
            assert state == 'any'
        elif not state.startswith('any but'):
            assert state == ', '.join(source.value for source in row.source)
        assert event == row.event.__name__
        assert guard == ('' if row.guard is always else shown(row.guard))
        assert target == ('the same' if row.target is SAME else row.target.value)
        assert actions.split(', ') == [shown(action) for action in row.actions] or not actions
        assert counter == (row.outcome.value if row.outcome else '')
