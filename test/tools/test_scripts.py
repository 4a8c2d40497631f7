"""The scripts of the tools are links to one file."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / 'scripts'
NAMES = ('watch', 'record', 'replay', 'snapshot', 'topic', 'param')


@pytest.mark.parametrize('name', NAMES)
def test_every_script_leads_to_a_module(name):
    assert (SCRIPTS / name).resolve() == SCRIPTS / '_tool'
    assert (ROOT / 'rhs_isac_ros' / 'tools' / f'{name}.py').is_file()


def test_another_name_is_rejected(tmp_path):
    (tmp_path / 'permissions').symlink_to(SCRIPTS / '_tool')
    done = subprocess.run([tmp_path / 'permissions'], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith('permissions: not a tool')


def test_a_link_in_another_directory_finds_the_package(tmp_path):
    (tmp_path / 'param').symlink_to(SCRIPTS / 'param')
    done = subprocess.run([tmp_path / 'param', '--help'], cwd=tmp_path, capture_output=True,
                          text=True, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: param ')
