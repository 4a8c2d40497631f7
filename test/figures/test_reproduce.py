"""``scripts/reproduce``: the list of experiments, and the options that all of them share."""

import subprocess
from pathlib import Path

import pytest
from parts import frame


def test_without_arguments_it_lists_the_experiments(pytestconfig):
    scripts = pytestconfig.rootpath / 'scripts'
    listed = subprocess.run([scripts / 'reproduce'], check=True, timeout=240, capture_output=True,
                            text=True).stdout.splitlines()[4:]
    assert [line.split()[0] for line in listed] == sorted(
        path.stem for path in (scripts / 'figures').glob('*.py'))


def parse(*arguments):
    return frame.experiment_options('fig0', 'About.', 30, 3, arguments)


def test_defaults_are_those_of_the_full_run():
    options = parse()
    assert (options.trials, options.quick, options.jobs, options.dask) == (30, False, -1, None)
    assert (options.output, options.format) == (Path('results/fig0'), 'png')
    assert parse('--quick').trials == 3


@pytest.mark.parametrize('arguments', [
    ['--trials', '0'], ['--jobs', '-2'], ['--quick', '--trials', '3'], ['--format', 'gif']])
def test_invalid_options_exit_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit, match='2'):
        parse(*arguments)
    assert 'error: argument --' in capsys.readouterr().err
