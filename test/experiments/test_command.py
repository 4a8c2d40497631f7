"""What the commands of all experiments share."""

from pathlib import Path

import pytest

from rhs_isac_ros.experiments import JobError, parse_options, positive_int, run_command


def parse(*arguments):
    return parse_options('About.', 'fig0', 30, 3, arguments)


def test_defaults_are_those_of_the_full_run():
    options = parse()
    assert (options.trials, options.quick, options.jobs, options.dask) == (30, False, -1, None)
    assert options.output == Path('results/fig0')


def test_quick_and_trials_change_the_number_of_trials():
    assert parse('--quick').trials == 3
    assert parse('--trials', '7').trials == 7


def test_an_experiment_may_have_options_of_its_own():
    options = parse_options('About.', 'fig0', 30, 3, ['--more', '4'],
                            lambda parser: parser.add_argument('--more', type=positive_int))
    assert options.more == 4


@pytest.mark.parametrize('arguments', [
    ['--trials', '0'], ['--jobs', '-2'], ['--trials', 'x'],
    ['--quick', '--trials', '3'], ['--magic']])
def test_wrong_options_end_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        parse(*arguments)
    assert caught.value.code == 2
    assert 'error: ' in capsys.readouterr().err


@pytest.mark.parametrize(('error', 'code', 'text'), [
    (None, 0, ''), (JobError('job a failed'), 1, 'error: job a failed'),
    (OSError('disk'), 1, 'error: disk'), (KeyboardInterrupt(), 130, 'the same command resumes')])
def test_exit_codes_tell_how_it_ended(error, code, text, capsys):
    def experiment():
        if error:
            raise error
    assert run_command(experiment) == code
    assert text in capsys.readouterr().err


def test_a_bug_is_not_hidden():
    def experiment():
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError):
        run_command(experiment)
