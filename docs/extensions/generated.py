"""The directive ``generated``: parts of pages that are generated from the code.

``.. generated:: parameter_table`` calls the function of that name below, which returns
reStructuredText or SVG.
"""

import ast
import dataclasses
import functools
import importlib
import pkgutil
import re
from pathlib import Path

import sequence
import states
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.domains.python import PythonDomain
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import nested_parse_with_titles

from rhs_isac_ros.experiments.sweep_settings import MEASURES
from rhs_isac_ros.model.scenario import Extensions, Scenario, Table1
from rhs_isac_ros.protocol.events import Kind, Outcome
from rhs_isac_ros.ros import parameters

ROOT = Path(__file__).parents[2]
MESSAGES = ROOT / 'msg_defs' / 'msg'
KINDS = {Kind.DROPPED: 'dropped message', Kind.REPEATED: 'repeated step',
         Kind.LOST: 'lost cycle', Kind.IDLE: 'idle'}


def table(head, rows, widths):
    """Return a table; each cell is one line of reStructuredText."""
    lines = ['.. list-table::', '   :header-rows: 1', f'   :widths: {widths}', '']
    for row in (head, *rows):
        for number, cell in enumerate(row):
            lines.append(f'   {"* -" if number == 0 else "  -"} {cell}'.rstrip())
    return '\n'.join(lines)


def code(text):
    """Return a name as code; empty for an empty name."""
    return f'``{text}``' if text else ''


def parameter_table():
    """Return a table of the ROS parameters of each node, and one of those that several share."""
    owners = {}
    for executable, group in parameters.NODES.items():
        for parameter in group:
            owners.setdefault(parameter.name, (parameter, []))[1].append(executable)
    sections = {}
    for name, (parameter, nodes_) in owners.items():
        row = (code(name), parameter.type, parameter.default_text, parameter.range,
               'yes' if parameter.dynamic else '')
        if len(nodes_) == 1:
            sections.setdefault(nodes_[0], []).append((*row, parameter.text))
        else:
            sections.setdefault('', []).append((*row, f'{parameter.text} ({", ".join(nodes_)})'))
    # Shared parameters come first.
    return '\n\n'.join(
        f'{title}\n{"-" * len(title)}\n\n' + table(
            ('parameter', 'type', 'default', 'range', 'dynamic', 'description'), rows,
            '20 9 11 17 9 34')
        for title, rows in ((code(node) or 'Several nodes', sections[node])
                            for node in sorted(sections)))


def scenario_table(kind):
    """Return a table of the scenario fields of `Table1` or `Extensions`."""
    rows, defaults = [], Scenario().fields()
    for field in dataclasses.fields({'table1': Table1, 'extensions': Extensions}[kind]):
        declared, source = field.metadata['declared'], field.metadata['source']
        default = defaults[field.name]
        source = f' Source: {source}.' if source else ''
        limits = f'{declared.low:g} to {declared.high:g}' + declared.has_unknown * ' or unknown'
        rows.append((code(field.name), declared.unit, 'null' if default is None else default,
                     limits, declared.text + source))
    return table(('field', 'unit', 'default', 'range', 'meaning'), rows, '22 7 11 14 46')


def measure_table():
    """Return a table of the measures of sweeps."""
    rows = [(code(name), measure.unit, measure.label) for name, measure in MEASURES.items()]
    return table(('measure', 'unit', 'meaning'), rows, '30 15 55')


def message_list():
    """Return the definitions of all messages, from their files."""
    parts = []
    for path in sorted(MESSAGES.glob('*.msg')):
        text = path.read_text(encoding='utf-8').rstrip()
        head = re.match(r'((?:#.*\n)*)', text)[1]
        description = ' '.join(line.lstrip('# ').strip() for line in head.splitlines())
        title = path.stem
        body = '\n'.join(f'   {line}'.rstrip() for line in text[len(head):].splitlines())
        parts.append(f'.. _message-{title.lower()}:\n\n{title}\n{"^" * len(title)}\n\n'
                     f'{description.replace("`", "``")}\n\n.. code-block:: none\n\n{body}\n')
    return '\n'.join(parts)


def state_table(role):
    """Return all rows of the table of a role."""
    def cell(number, text):
        plain = number == 0 or text == 'the same'
        return text if plain else code(text)
    rows = [tuple(cell(number, text) for number, text in enumerate(row))
            for row in states.rows(role)]
    return table(states.HEAD, rows, '14 17 17 14 24 14')


def outcome_table():
    """Return the counters of `Outcome`, each with its kind."""
    rows = [(code(f'{kind.value}.{outcome.value}'), KINDS[kind])
            for kind in Kind for outcome in sorted(Outcome, key=lambda outcome: outcome.value)
            if outcome.kind is kind]
    return table(('counter', 'kind'), rows, '40 60')


def dependency_table():
    """Return a table of the libraries in extras that have no rosdep key, for pip."""
    tree = ast.parse((ROOT / 'setup.py').read_text(encoding='utf-8'))
    (extras,) = [ast.literal_eval(node.value) for node in ast.walk(tree)
                 if isinstance(node, ast.keyword) and node.arg == 'extras_require']
    keys = (ROOT / 'package.xml').read_text(encoding='utf-8')
    rows = []
    for extra, names in extras.items():
        # The extra `all` repeats the others.
        missing = [name for name in names if extra != 'all'
                   and f'>python3-{name.replace("scikit-learn", "sklearn")}<' not in keys]
        if missing:
            rows.append((code(extra), code(' '.join(missing)),
                         code(f'python3 -m pip install {" ".join(missing)}')))
    return table(('extra', 'packages', 'command'), rows, '20 30 50')


def module_list(package):
    """Return the public names of a package, then each of its modules in full."""
    home = importlib.import_module(package)
    parts = []
    public = [getattr(home, name) for name in getattr(home, '__all__', ())]
    entries = [f'* :py:obj:`~{item.__module__}.{item.__qualname__}`' for item in public
           if getattr(item, '__module__', '').startswith('rhs_isac_ros')
           and hasattr(item, '__qualname__')]
    if entries:
        parts.append(f'``from {package} import`` one of:\n\n' + '\n'.join(entries) + '\n')
    parts += [f'.. autofunction:: {package}.{item.__name__}\n' for item in public
              if getattr(item, '__module__', '') == package]
    for info in pkgutil.walk_packages(home.__path__, f'{package}.'):
        name = info.name.removeprefix(f'{package}.')
        if name.startswith('_'):
            continue
        # The modules of a package within describe its members.
        members = '   :no-members:\n' if info.ispkg else ''
        parts.append(f'``{name}``\n{"-" * (len(name) + 4)}\n\n'
                     f'.. automodule:: {info.name}\n{members}')
    return '\n'.join(parts)


class Generated(SphinxDirective):
    """Directive that inserts the result of a function."""

    required_arguments = 1
    optional_arguments = 1

    def run(self):
        """Return the nodes."""
        text = FUNCTIONS[self.arguments[0]](*self.arguments[1:])
        if text.startswith('<svg'):
            return [nodes.raw('', f'<div class="picture">{text}</div>', format='html')]
        node = nodes.section()
        node.document = self.state.document
        source = f'<{self.arguments[0]}>'
        nested_parse_with_titles(self.state, StringList(text.splitlines(), source), node)
        return node.children


FUNCTIONS = {function.__name__: function for function in (
    parameter_table, scenario_table, measure_table, message_list, state_table, outcome_table,
    dependency_table, module_list)} | {
        'state_picture': states.picture, 'cycle_sequence': sequence.picture}


class KnownNames(PythonDomain):
    """The Python domain, which finds names of other libraries missing without a search.

    Sphinx compares each of them with all objects, which takes a tenth of the build.
    """

    @functools.cached_property
    def known(self):
        """Last parts of the names of all objects, which are known once all pages are read."""
        return {name.rpartition('.')[2] for name in self.objects}

    def find_obj(self, env, modname, classname, name, *arguments):
        """Return the objects of a name, as pairs of full name and entry."""
        if name.removesuffix('()').rpartition('.')[2] not in self.known:
            return []
        return super().find_obj(env, modname, classname, name, *arguments)


def setup(app):
    """Register the directive and the domain."""
    app.add_directive('generated', Generated)
    app.add_domain(KnownNames, override=True)
    return {'parallel_read_safe': True}
