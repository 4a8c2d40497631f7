"""``scripts/reproduce``: the help, and the options that all experiments share."""

import ast
import subprocess
from pathlib import Path

import pytest

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


@pytest.fixture(scope='module')
def parse(load_figure):
    """Callable that parses the arguments of an experiment."""
    parse_options = load_figure('fig3').parse_options
    return lambda *arguments: parse_options('About.', 'fig0', 30, 3, arguments)


def test_without_arguments_it_lists_the_names(reproduce, scripts):
    assert [line.split()[0] for line in reproduce().splitlines()[4:]] == sorted(scripts)


def test_defaults_are_those_of_the_full_run(parse):
    options = parse()
    assert (options.trials, options.quick, options.jobs, options.dask) == (30, False, -1, None)
    assert (options.output, options.format) == (Path('results/fig0'), 'png')


@pytest.mark.parametrize('arguments', [
    ['--trials', '0'], ['--jobs', '-2'], ['--trials', 'x'],
    ['--quick', '--trials', '3'], ['--magic']])
def test_invalid_options_exit_with_code_2(parse, arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        parse(*arguments)
    assert caught.value.code == 2
    assert 'error: ' in capsys.readouterr().err


def test_another_format_is_refused_with_the_expected_ones(parse, capsys):
    with pytest.raises(SystemExit) as caught:
        parse('--format', 'gif')
    assert caught.value.code == 2
    error = capsys.readouterr().err.replace("'", '')
    assert 'argument --format: invalid choice: gif (choose from png, pdf, svg)' in error
