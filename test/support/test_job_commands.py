"""The end of a command that runs jobs: exit codes and messages."""

import pytest

from rhs_isac_ros.support.job_commands import run_command
from rhs_isac_ros.support.jobs import JobError
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
