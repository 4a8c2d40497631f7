"""One function implements each formula of the paper, and the model page links to it."""

import ast
import re
from pathlib import Path

import rhs_isac_ros

ROOT = Path(rhs_isac_ros.__file__).parent
PAGE = (Path(__file__).parents[2] / 'docs' / 'model.rst').read_text(encoding='utf-8')
CLAIM = re.compile(r'(?:Implements )?(Eq\. \(\d+\)|Proposition \d+|Algorithm \d+)[.:]')


def claims() -> dict[str, list[str]]:
    """Full names of functions and classes by the equation that their docstring names."""
    found = {}
    for path in sorted(ROOT.rglob('*.py')):
        module = '.'.join(('rhs_isac_ros', *path.relative_to(ROOT).with_suffix('').parts))
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                first = (ast.get_docstring(node) or '').partition('\n')[0]
                if first.startswith('Implements'):
                    claim = CLAIM.match(first)
                    found.setdefault(claim[1] if claim else first, []).append(
                        f'{module}.{node.name}')
    return found


def links() -> dict[str, list[str]]:
    """Links after `Implemented by` in each section of the page, by equation."""
    found = {}
    parts = re.split(r'^(\S.*)\n[-^=]{3,}$', PAGE, flags=re.MULTILINE)
    for title, text in zip(parts[1::2], parts[2::2], strict=True):
        named = re.findall(r'Implemented\s+by\s+:(?:func|class):`~([\w.]+)`', text)
        claim = CLAIM.match(title)
        if claim or named:
            found[claim[1] if claim else title] = named
    return found


def test_each_formula_links_to_the_only_function_that_implements_it():
    found = claims()
    assert links() == found
    assert all(len(places) == 1 for places in found.values())
    assert found.keys() == {*(f'Eq. ({number})' for number in range(1, 18)),
                            'Proposition 2', 'Proposition 3', 'Algorithm 1'}
