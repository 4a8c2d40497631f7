"""The README is short, its example runs, and its links lead somewhere."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook

ROOT = Path(__file__).parents[1]
README = (ROOT / 'README.md').read_text(encoding='utf-8')


def test_the_readme_has_at_most_150_lines():
    assert len(README.splitlines()) <= 150


def test_the_library_example_runs(monkeypatch, capsys, tmp_path):
    # Not in the clone: the example must not depend on the working directory.
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r'```python\n(.*?)```', README, re.DOTALL)
    # Other tests cover the optimiser; two steps show that the call is right.
    variables: dict = {}
    exec(code.replace('max_steps=50', 'max_steps=2'), variables)
    assert len(capsys.readouterr().out.splitlines()) >= 3
    assert isinstance(variables['better'], Codebook)
    assert np.isfinite(variables['fix'].mean).all()


@pytest.mark.parametrize('page', ['README.md', 'QUALITY_DECLARATION.md'])
def test_links_lead_to_files(page):
    targets = re.findall(r'\]\(([^)#:]+)[^):]*\)', (ROOT / page).read_text(encoding='utf-8'))
    assert len(targets) > 10
    assert not [target for target in targets if not (ROOT / target).exists()]


DECLARATION = (ROOT / 'QUALITY_DECLARATION.md').read_text(encoding='utf-8')


def test_each_requirement_of_level_3_has_a_state_and_a_link():
    """As in the comparison chart of REP-2004: required, recommended or optional at level 3."""
    rows = [line.split('|')[1:-1] for line in DECLARATION.splitlines() if line.startswith('| ')]
    found = {cells[0].strip(): cells for cells in rows}
    required = '1.i 1.ii 1.iv 1.v 2.i 2.iv 3.iii 3.iv 3.v.a 3.v.c 6.i'
    recommended = '1.iii 1.vi 3.v 4.i 5.i 7.i'
    for item in f'{required} {recommended}'.split():
        _, _, state, where = found[item]
        assert re.match(r'met|open|beyond', state.strip()), item
        assert '](' in where, item


def test_the_declaration_lists_each_dependency_at_run_time():
    listed = set(re.findall(r'`([a-z0-9_]+)`', DECLARATION[DECLARATION.index('## Dependencies'):]))
    depended = {dependency.text for path in ('package.xml', 'msg_defs/package.xml')
                for dependency in ElementTree.parse(ROOT / path).iter()
                if dependency.tag in ('depend', 'exec_depend')}
    own = {'rhs_isac_msgs'}
    assert {name for name in depended if not name.startswith('python3-')} - own <= listed


def test_commands_exist():
    commands = set(re.findall(r'scripts/([a-z.]+[a-z])', README))
    assert {'demo', 'test', 'setup', 'run', 'watch'} <= commands
    assert not [command for command in commands if not (ROOT / 'scripts' / command).is_file()]
