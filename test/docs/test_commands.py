"""Commands of the pages run as they stand there, or are left out for a reason.

The blocks come from the sources of the pages. A new command must run within seconds, in a folder
with the files of `GIVEN`, or match a pattern of `LEFT_OUT`.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / 'docs'
LEFT_OUT = {
    'colcon|rosdep|ros2|ln': 'needs a sourced Jazzy or its workspace',
    'sudo|docker|git|pip|venv/bin/pip|python3 -m (pip|venv)|scripts/setup|mkdir|cd':
        'installs; test_examples installs the plug-ins',
    r'scripts/(demo|run|topic|param|record|watch|view|board)\b|export ROS|\. ':
        'needs a network, a board or a browser; the tests of nodes and tools run these programs',
    'scripts/replay|rosbags-convert|.* ?calibrate .*(mcap|arrays)|python3 -m .*touchstone':
        'needs a recording or a file of a solver; the tests of tools make their own',
    'scripts/(test|benchmark|reproduce)|python3 -m .*(sweep|positioning|library|spectrum)':
        'takes minutes; their tests run them with fewer trials',
    r'python3 -m rhs_isac_ros.codebook (?!.*--method random)': 'optimises for a minute',
    'dask|[^ ]* docs/examples/': 'does not end, or is run by test_examples or test_tasks',
}
# Files that readers have made when they reach a block.
GIVEN = {'mine.yaml': 'config/lab.yaml', 'office.yaml': 'docs/examples/office.yaml'}


def commands(page):
    """Yield the commands of a page's blocks; a backslash continues a line."""
    lines = iter(page.read_text(encoding='utf-8').splitlines())
    for line in lines:
        opening = re.fullmatch(r'(\s*)\.\. code-block:: sh|```sh', line)
        if not opening:
            continue
        indent = ' ' * (len(opening[1]) + 1) if opening[1] is not None else ''
        text, block = '', iter(lines)
        for row in block:
            if row == '```' or row.strip() and not row.startswith(indent):
                break
            text += row.strip().removesuffix('\\') + ('' if row.endswith('\\') else '\n')
        yield from (one for one in text.splitlines() if one.strip())


@pytest.fixture(scope='module')
def by_page():
    found = {page.name: [*commands(page)]
             for page in (ROOT / 'README.md', *sorted(DOCS.glob('*.rst')))}
    return {name: texts for name, texts in found.items() if texts}


def left_out(command):
    return any(re.match(pattern, command) for pattern in LEFT_OUT)


def test_each_reason_leaves_out_a_command(by_page):
    every = [command for found in by_page.values() for command in found]
    assert len(every) > 150
    for pattern in LEFT_OUT:
        assert any(re.match(pattern, command) for command in every), pattern


def test_the_tutorial_removes_all_its_files_at_its_end(by_page):
    *commands, last = by_page['tutorial.rst']
    assert last.startswith('rm -f ')
    used = re.findall(r'[ =/](\w+\.(?:yaml|png|mcap))\b', '\n'.join(commands))
    assert {*used, 'demo.png'} == {*last.split()[2:]}


def test_quick_commands_run_as_the_pages_state(by_page, built_scripts, tmp_path):
    n_run = 0
    for name, found in by_page.items():
        quick = [command for command in found if not left_out(command)]
        if not quick:
            continue
        folder = tmp_path / name
        folder.mkdir()
        for link in ('scripts', 'config', 'docs'):
            (folder / link).symlink_to(ROOT / link)
        for file, source in GIVEN.items():
            shutil.copy(ROOT / source, folder / file)
        done = subprocess.run(
            ['bash', '-euo', 'pipefail'], input='\n'.join(quick), cwd=folder, text=True,
            capture_output=True, timeout=120, check=False,
            env={**os.environ, 'PATH': f'{Path(sys.executable).parent}:{os.environ["PATH"]}',
                 'OPENBLAS_NUM_THREADS': '1'})
        assert done.returncode == 0, f'{name}: {quick}: {done.stderr}'
        n_run += len(quick)
    assert n_run >= 6
