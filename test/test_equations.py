"""Every equation and proposition of the paper is implemented in one place that says so."""

import ast
import re
from pathlib import Path

import pytest

import rhs_isac_ros

ROOT = Path(rhs_isac_ros.__file__).parent
WANTED = [f'Eq. ({number})' for number in range(1, 18)] + ['Proposition 2', 'Proposition 3']


def claims() -> dict[str, list[str]]:
    """Places by what the first line of their docstring says they implement."""
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


@pytest.mark.parametrize('wanted', WANTED)
def test_is_implemented_once(wanted):
    assert len(CLAIMS.get(wanted, [])) == 1, CLAIMS.get(wanted)


def test_nothing_unknown_is_claimed():
    assert set(CLAIMS) <= {*WANTED, 'Proposition 1', 'Algorithm 1'}
