"""The end of a command that runs jobs: exit codes and messages."""

import argparse

import pytest

from rhs_isac_ros.support.job_commands import run_command, unfinished
from rhs_isac_ros.support.jobs import Job, JobError
from rhs_isac_ros.support.optional import MissingLibraryError


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


@pytest.mark.parametrize(('jobs_before', 'n_jobs', 'error', 'is_kept'), [
    (0, 2, None, False), (1, 2, None, True), (0, 2, KeyboardInterrupt, True),
    (0, 2, JobError, True), (0, 0, ConnectionError, False), (0, 2, ValueError, False),
    (1, 0, ValueError, True), (1, 2, ValueError, True)])
def test_results_are_kept_if_the_next_call_can_use_them(
        tmp_path, jobs_before, n_jobs, error, is_kept):
    folder = tmp_path / 'out.npz.jobs'
    for number in range(jobs_before):
        folder.mkdir()
        (folder / f'before-{number}.json').write_text('{}', encoding='utf-8')

    def strand():
        yield dict, [Job(str(number), {'number': number}) for number in range(n_jobs)]
        if error:
            raise error('no good')

    def work():
        with unfinished(tmp_path / 'out.npz', argparse.Namespace(jobs=1, dask=None), True) as them:
            them.run([strand()])
    if error:
        with pytest.raises(error):
            work()
    else:
        work()
    assert folder.exists() == is_kept
    # Another run may still need its results.
    assert len(list(folder.glob('before-*'))) == jobs_before


def test_runs_with_one_output_keep_the_results_of_each_other(tmp_path):
    def begin(name):
        def strand():
            return (yield dict, [Job(name, {'name': name})])
        run = unfinished(tmp_path / 'out', argparse.Namespace(jobs=1, dask=None), True)
        run.__enter__().run([strand()])
        return run
    first, second = begin('first'), begin('second')
    first.__exit__(None, None, None)
    assert [file.stem for file in (tmp_path / 'out.jobs').iterdir()] == ['second']
    second.__exit__(None, None, None)
    assert not any(tmp_path.iterdir())
