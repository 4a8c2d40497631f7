"""The scripts of the tools are links to one file."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / 'scripts'


def test_another_name_is_rejected(tmp_path):
    (tmp_path / 'permissions').symlink_to(SCRIPTS / '_tool')
    done = subprocess.run([tmp_path / 'permissions'], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith('permissions: not a tool')


@pytest.mark.parametrize(('arguments', 'code', 'line'), [
    ([], 1, 'usage: python3 -m rhs_isac_ros.tools COMMAND [ARGUMENT ...]\n'),
    (['topic'], 2, 'python3 -m rhs_isac_ros.tools: error: no command named topic\n')])
def test_a_missing_or_unknown_name_is_an_error(arguments, code, line):
    done = subprocess.run([sys.executable, '-m', 'rhs_isac_ros.tools', *arguments], cwd=ROOT,
                          capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (code, '', line)


def test_a_link_in_another_directory_finds_the_package(built_scripts, tmp_path):
    (tmp_path / 'param').symlink_to(SCRIPTS / 'param')
    done = subprocess.run([tmp_path / 'param', '--help'], cwd=tmp_path, capture_output=True,
                          text=True, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: scripts/param ')


def test_setup_rejects_an_unknown_group():
    done = subprocess.run([SCRIPTS / 'setup', 'recordin'], capture_output=True, text=True,
                          check=False)
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr == ("scripts/setup: 'recordin', expected recording, samples, "
                           'experiments, docs, test, view or peers\n')


@pytest.mark.parametrize(('script', 'built', 'distribution', 'line'), [
    ('scripts/setup', 'system', '',
     'scripts/setup: this clone was built on ROS 2 Jazzy, which is not sourced'),
    ('scripts/setup', 'wheels', 'jazzy',
     'scripts/setup: this clone was built with the wheels, but ROS 2 Jazzy is sourced'),
    ('. scripts/env.sh', 'wheels', 'jazzy',
     'env.sh: this clone was built with the wheels, but ROS 2 jazzy is sourced'),
    ('. scripts/env.sh', 'system', 'rolling',
     'env.sh: this clone was built on ROS 2 Jazzy, but ROS 2 rolling is sourced'),
    ('. scripts/env.sh', None, 'jazzy', 'env.sh: the packages have not been built')])
def test_the_build_of_another_ros_is_neither_used_nor_replaced(
        script, built, distribution, line, tmp_path):
    (tmp_path / 'scripts').mkdir()
    for name in ('setup', 'env.sh'):
        shutil.copy(SCRIPTS / name, tmp_path / 'scripts')
    if built:
        (tmp_path / 'install').mkdir()
        (tmp_path / 'install' / '.setup').write_text(f'{built} 0123456789\n')
    before = sorted(tmp_path.rglob('*'))
    done = subprocess.run(['bash', '-c', script], cwd=tmp_path, capture_output=True, text=True,
                          check=False, env={**os.environ, 'ROS_DISTRO': distribution})
    assert (done.returncode, done.stdout) == (1, '')
    (found,) = done.stderr.splitlines()
    assert found.startswith(line)
    assert sorted(tmp_path.rglob('*')) == before
