"""`pip install .` in a fresh virtual environment gives a library that works without ROS."""

import ast
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGED = (
    'config', 'launch', 'resource', 'rhs_isac_ros', 'LICENSE', 'package.xml', 'pyproject.toml',
    'setup.cfg', 'setup.py')
# The required libraries by the name of the import, and with those that the build needs.
REQUIRED = {'numpy': 'numpy', 'scipy': 'scipy', 'yaml': 'pyyaml', 'threadpoolctl': 'threadpoolctl'}
LINKED = (*REQUIRED, 'setuptools', '_distutils_hack', 'pkg_resources', 'wheel')


def read_extras():
    """Extras of setup.py: their requirements by name."""
    tree = ast.parse((ROOT / 'setup.py').read_text(encoding='utf-8'))
    (extras,) = [ast.literal_eval(node.value) for node in ast.walk(tree)
                 if isinstance(node, ast.keyword) and node.arg == 'extras_require']
    return extras


class Installation:
    """A virtual environment with the package and links to what it requires, and nothing else."""

    def __init__(self, folder):
        self.folder = folder
        self.prefix = folder / 'venv'
        venv.create(self.prefix, symlinks=True)
        (site,) = self.prefix.glob('lib/python*/site-packages')
        for spec in filter(None, map(importlib.util.find_spec, LINKED)):
            found = Path(spec.submodule_search_locations[0] if spec.submodule_search_locations
                         else spec.origin)
            # Beside it are its metadata, and in a wheel its shared libraries.
            for path in (found, *found.parent.glob(f'{found.stem}[-.]*')):
                if not (site / path.name).exists():
                    (site / path.name).symlink_to(path)

    def run(self, program, *arguments):
        # The caller's environment may name ROS and the clone itself.
        environment = {name: value for name, value in os.environ.items() if name not in (
            'PYTHONPATH', 'PYTHONHOME', 'LD_LIBRARY_PATH', 'VIRTUAL_ENV')}
        return subprocess.run(
            (self.prefix / 'bin' / program, *arguments), cwd=self.folder, env=environment,
            capture_output=True, text=True, timeout=240, check=False)


@pytest.fixture(scope='module')
def installation(tmp_path_factory):
    fresh = Installation(tmp_path_factory.mktemp('installation'))
    # A copy, since pip builds inside the source folder.
    source = fresh.folder / 'source'
    source.mkdir()
    for name in PACKAGED:
        path = ROOT / name
        if path.is_dir():
            shutil.copytree(path, source / name, ignore=shutil.ignore_patterns('__pycache__'))
        else:
            shutil.copy(path, source)
    # The pip of the tests, because one of its own takes long to install.
    done = fresh.run(sys.executable, '-m', 'pip', '--python', fresh.prefix / 'bin' / 'python',
                     '--quiet', '--disable-pip-version-check', 'install', '--no-index',
                     '--no-deps', '--no-build-isolation', './source')
    assert done.returncode == 0, done.stderr
    return fresh


def test_the_library_requires_four_others(installation):
    done = installation.run('python', '-c', 'import importlib.metadata\n'
                            'print(*importlib.metadata.requires("rhs_isac_ros"), sep="\\n")')
    required = {re.match('[a-z]+', line)[0].lower() for line in done.stdout.lower().splitlines()
                if 'extra ==' not in line}
    assert required == set(REQUIRED.values())


def test_the_installed_package_is_typed(installation):
    done = installation.run('python', '-c', 'import rhs_isac_ros; print(rhs_isac_ros.__file__)')
    package = Path(done.stdout.strip()).parent
    assert package.is_relative_to(installation.prefix)
    assert (package / 'py.typed').is_file()


def test_scenarios_and_codebooks_are_installed(installation):
    installed = installation.prefix / 'share' / 'rhs_isac_ros' / 'config'
    assert {path.name for path in installed.glob('*.yaml')} == {
        path.name for path in (ROOT / 'config').glob('*.yaml')}


@pytest.mark.parametrize(('library', 'arguments'), [
    ('matplotlib', ('codebook', '--method', 'random', '--plot', 'codebook.png')),
    ('pymoo', ('codebook', '--method', 'genetic')),
    ('sklearn', ('positioning', '--codebook', 'source/config/codebook.yaml'))])
def test_a_missing_extra_is_named_in_one_line(installation, library, arguments):
    module, *options = arguments
    done = installation.run('python', '-m', f'rhs_isac_ros.{module}', '--quiet', *options)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f'needs {library}, which is not installed' in line


@pytest.mark.parametrize('name', ['bs', 'watch'])
def test_an_executable_without_ros_fails_with_one_line(installation, name):
    done = installation.run(name)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f'{name}: error: needs ROS 2 Jazzy, which is not sourced')


def test_the_extra_all_is_the_union_of_the_optional_features():
    extras = read_extras()
    features = extras.keys() - {'all', 'docs', 'test'}
    assert sorted(extras['all']) == sorted(name for key in features for name in extras[key])
