"""State diagrams: all that the tables say, and nothing else."""

import itertools
import re
import xml.etree.ElementTree as ElementTree

import pytest

from rhs_isac_ros.protocol import diagram
from rhs_isac_ros.protocol.state_machine import ANY, SAME

SVG = '{http://www.w3.org/2000/svg}'
each_role = pytest.mark.parametrize('role', diagram.ROLES)


def changes(role):
    """Source, input and target of every change of state, by asking the table as the roles do."""
    states, table = diagram.ROLES[role]
    inputs = {event for _, event in table}
    for state in states:
        for event in inputs:
            step = table.get((state, event)) or table.get((ANY, event))
            if step and step.to is not SAME and step.to is not state:
                yield state.value, event.value, step.to.value


@each_role
def test_edges_are_the_changes_of_state(role):
    drawn = {(edge.source.value, event, edge.target.value)
             for edge in diagram.edges(role) for event in edge.inputs}
    assert drawn == set(changes(role))
    pairs = [(edge.source, edge.target) for edge in diagram.edges(role)]
    assert len(pairs) == len(set(pairs))


@each_role
def test_the_picture_shows_every_state_and_every_change_inside_its_borders(role):
    picture = ElementTree.fromstring(diagram.svg(role))
    texts = list(picture.iter(f'{SVG}text'))
    assert [text.text for text in texts if text.get('class') == 'state'] == [
        state.value for state in diagram.ROLES[role][0]]
    labels = [text.text for text in texts if text.get('class') != 'state']
    assert sorted(labels) == sorted(', '.join(edge.inputs) for edge in diagram.edges(role))
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
def test_arrows_share_no_stretch(role):
    """Else nobody could tell them apart."""
    picture = ElementTree.fromstring(diagram.svg(role))
    stretches = []
    for path in picture.iter(f'{SVG}path'):
        points = [tuple(map(int, point)) for point in re.findall(r'(\d+) (\d+)', path.get('d'))]
        stretches += zip(points, points[1:], strict=False)
    for first, second in itertools.combinations(stretches, 2):
        for along, across in ((0, 1), (1, 0)):
            lines = {point[across] for point in (*first, *second)}
            spans = [sorted(point[along] for point in line) for line in (first, second)]
            assert len(lines) > 1 or spans[0][1] <= spans[1][0] or spans[1][1] <= spans[0][0]


@each_role
def test_the_table_has_every_row(role, capsys):
    assert diagram.main([role, '--format', 'table']) == 0
    rows = [line.split('\t') for line in capsys.readouterr().out.splitlines()]
    table = diagram.ROLES[role][1]
    assert len(rows) == len(table)
    for (state, event, target, actions, counter), ((source, name), step) in zip(
            rows, table.items(), strict=True):
        assert state == ('any' if source is ANY else source.value)
        assert event == name.value
        assert target == ('the same' if step.to is SAME else step.to.value)
        assert actions == ', '.join(step.do)
        assert counter == step.counts


@each_role
def test_mermaid_says_the_same(role, capsys):
    assert diagram.main([role, '--format', 'mermaid']) == 0
    head, start, *lines = capsys.readouterr().out.splitlines()
    assert head == 'stateDiagram-v2'
    assert start == f'  [*] --> {next(iter(diagram.ROLES[role][0])).value}'
    found = set()
    for line in lines:
        source, target, inputs = re.fullmatch(r'  (\w+) --> (\w+): ([\w, ]+)', line).groups()
        found |= {(source, event, target) for event in inputs.split(', ')}
    assert found == set(changes(role))
