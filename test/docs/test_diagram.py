"""State diagrams and tables show exactly the transitions of the roles."""

import itertools
import re
import xml.etree.ElementTree as ElementTree

import diagram
import pytest

from rhs_isac_ros.protocol.role import ANY, SAME, always

SVG = '{http://www.w3.org/2000/svg}'
each_role = pytest.mark.parametrize('role', diagram.ROLES)


def shown(function):
    """Return the name of a guard or an action as pages show it."""
    return function.__name__.lstrip('_')


def changes(role):
    """Return source, label and target of all changes of state, tried row by row."""
    machine, found = diagram.ROLES[role], set()
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
             for edge in diagram.edges(role) for label in edge.labels}
    assert drawn == changes(role)
    pairs = [(edge.source, edge.target) for edge in diagram.edges(role)]
    assert len(pairs) == len(set(pairs))


def test_some_edges_of_the_base_station():
    edges = {(edge.source.value, edge.target.value): edge.text for edge in diagram.edges('bs')}
    assert edges['beaconing', 'configuring'] == 'Timeout [some_acks], Ack [last_ack]'
    assert edges['estimating', 'resting'] == 'Timeout, NoFix'
    assert ('resting', 'transmitting') not in edges


@each_role
def test_the_picture_shows_every_state_and_change_inside_its_borders(role):
    picture = ElementTree.fromstring(diagram.svg(role))
    texts = list(picture.iter(f'{SVG}text'))
    assert [text.text for text in texts if text.get('class') == 'state'] == [
        state.value for state in diagram.ROLES[role].STATES]
    labels = [text.text for text in texts if text.get('class') != 'state']
    assert sorted(labels) == sorted(edge.text for edge in diagram.edges(role))
    assert len(list(picture.iter(f'{SVG}path'))) == len(labels)
    width, height = float(picture.get('width')), float(picture.get('height'))
    for path in picture.iter(f'{SVG}path'):
        for x, y in re.findall(r'(-?\d+) (-?\d+)', path.get('d')):
            assert 0 < float(x) < width
            assert 0 < float(y) < height
    for text in texts:
        reach = 6.7 * len(text.text)
        begin = float(text.get('x')) - {'start': 0, 'middle': reach / 2, 'end': reach}[
            text.get('text-anchor')]
        assert begin > 0
        assert begin + reach < width


@each_role
def test_arrows_do_not_overlap(role):
    picture = ElementTree.fromstring(diagram.svg(role))
    segments = []
    for path in picture.iter(f'{SVG}path'):
        points = [tuple(map(int, point)) for point in re.findall(r'(\d+) (\d+)', path.get('d'))]
        segments += zip(points, points[1:], strict=False)
    for first, second in itertools.combinations(segments, 2):
        for along, across in ((0, 1), (1, 0)):
            lines = {point[across] for point in (*first, *second)}
            spans = [sorted(point[along] for point in line) for line in (first, second)]
            assert len(lines) > 1 or spans[0][1] <= spans[1][0] or spans[1][1] <= spans[0][0]


@each_role
def test_the_table_has_every_row(role, capsys):
    assert diagram.main([role, '--format', 'table']) == 0
    rows = [tuple(line.split('\t')) for line in capsys.readouterr().out.splitlines()]
    assert rows == diagram.rows(role)
    table = diagram.ROLES[role].TABLE
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


def test_one_row_shows_the_treatment_of_a_late_ack():
    (row,) = [row for row in diagram.rows('bs') if row[-1] == 'late_ack']
    assert row == ('any but beaconing', 'Ack', '', 'the same', 'count_ack, register_user',
                   'late_ack')


@each_role
def test_mermaid_shows_the_same_changes(role, capsys):
    assert diagram.main([role, '--format', 'mermaid']) == 0
    head, start, *lines = capsys.readouterr().out.splitlines()
    assert head == 'stateDiagram-v2'
    assert start == f'  [*] --> {next(iter(diagram.ROLES[role].STATES)).value}'
    found = set()
    for line in lines:
        source, target, labels = re.fullmatch(r'  (\w+) --> (\w+): ([][\w, ]+)', line).groups()
        found |= {(source, label, target) for label in labels.split(', ')}
    assert found == changes(role)
