"""The command line of an experiment: options and exit codes."""

from pathlib import Path

import pytest

from rhs_isac_ros.experiments import (
    JobError,
    MissingLibraryError,
    parse_options,
    positive_int,
    run_command,
)


def parse(*arguments):
    return parse_options('About.', 'fig0', 30, 3, arguments)


def test_defaults_are_those_of_the_full_run():
    options = parse()
    assert (options.trials, options.quick, options.jobs, options.dask) == (30, False, -1, None)
    assert (options.output, options.format) == (Path('results/fig0'), 'png')


def test_quick_and_trials_set_the_number_of_trials():
    assert parse('--quick').trials == 3
    assert parse('--trials', '7').trials == 7


def test_an_experiment_may_add_options():
    options = parse_options('About.', 'fig0', 30, 3, ['--more', '4'],
                            lambda parser: parser.add_argument('--more', type=positive_int))
    assert options.more == 4


@pytest.mark.parametrize('arguments', [
    ['--trials', '0'], ['--jobs', '-2'], ['--trials', 'x'],
    ['--quick', '--trials', '3'], ['--magic']])
def test_invalid_options_exit_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        parse(*arguments)
    assert caught.value.code == 2
    assert 'error: ' in capsys.readouterr().err


def test_another_format_is_refused_with_the_expected_ones(capsys):
    with pytest.raises(SystemExit) as caught:
        parse('--format', 'gif')
    assert caught.value.code == 2
    error = capsys.readouterr().err.replace("'", '')
    assert 'argument --format: invalid choice: gif (choose from png, pdf, svg)' in error


@pytest.mark.parametrize(('error', 'code', 'text'), [
    (None, 0, ''), (JobError('job a failed'), 1, 'error: job a failed'),
    (MissingLibraryError('needs joblib'), 1, 'error: needs joblib'),
    (OSError('disk'), 1, 'error: disk'),
    (KeyboardInterrupt(), 130,
     'interrupted: finished jobs are kept; repeat the command to resume')])
def test_exit_codes_and_messages(error, code, text, capsys):
    def experiment():
        if error:
            raise error
    assert run_command(experiment) == code
    assert text in capsys.readouterr().err


def test_unexpected_errors_propagate():
    def experiment():
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError):
        run_command(experiment)
