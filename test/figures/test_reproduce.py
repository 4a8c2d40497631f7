"""The help of ``scripts/reproduce``: experiments, durations and common options."""

import ast
import re
import subprocess

import pytest

from rhs_isac_ros.experiments import parse_options

FOLDER = 'scripts/figures'


@pytest.fixture(scope='module')
def reproduce(pytestconfig):
    """Callable that runs the script and returns its output."""
    def run(*arguments):
        return subprocess.run(
            [pytestconfig.rootpath / 'scripts' / 'reproduce', *arguments], check=True,
            timeout=20, capture_output=True, text=True).stdout
    return run


@pytest.fixture(scope='module')
def scripts(pytestconfig):
    """The descriptions of the experiments by name."""
    return {path.stem: ast.get_docstring(ast.parse(path.read_text(encoding='utf-8')))
            for path in (pytestconfig.rootpath / FOLDER).glob('*.py')}


def test_the_help_describes_every_experiment_and_its_duration(reproduce, scripts):
    text = reproduce('--help')
    assert len(scripts) >= 4
    for name, description in scripts.items():
        first = description.splitlines()[0]
        duration = re.search(r'^Duration on two cores: (.*--quick.*)$', description, re.M)[1]
        assert f'\n  {name}\n    {first}\n    Takes {duration}\n' in text


def test_the_help_has_the_options_that_all_experiments_share(reproduce, capsys):
    with pytest.raises(SystemExit, match='0'):
        parse_options('About.', 'fig0', 30, 3, ['--help'])
    options = set(re.findall(r'^  (--\w+)', capsys.readouterr().out, re.M))
    assert '--format' in options
    assert set(re.findall(r'^  (--\w+)', reproduce('--help'), re.M)) == options


def test_without_arguments_it_lists_the_names(reproduce, scripts):
    assert reproduce().split() == sorted(scripts)
