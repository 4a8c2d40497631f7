"""Every equation and proposition of the paper is implemented by exactly one function or class."""

import ast
import re
from pathlib import Path

import pytest

import rhs_isac_ros

ROOT = Path(rhs_isac_ros.__file__).parent
EXPECTED = [f'Eq. ({number})' for number in range(1, 18)] + ['Proposition 2', 'Proposition 3']


def claims() -> dict[str, list[str]]:
    """Functions and classes by the equation that their docstring names."""
    found = {}
    for path in sorted(ROOT.rglob('*.py')):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                first = (ast.get_docstring(node) or '').partition('\n')[0]
                if first.startswith('Implements'):
                    claim = re.match(r'Implements (Eq\. \(\d+\)|[A-Z]\w+ \d+)\.', first)
                    place = f'{path.relative_to(ROOT)}:{node.name}'
                    found.setdefault(claim[1] if claim else first, []).append(place)
    return found


CLAIMS = claims()


@pytest.mark.parametrize('expected', EXPECTED)
def test_each_equation_is_implemented_once(expected):
    assert len(CLAIMS.get(expected, [])) == 1, CLAIMS.get(expected)


def test_no_docstring_names_an_unknown_equation():
    assert set(CLAIMS) <= {*EXPECTED, 'Proposition 1', 'Algorithm 1'}
