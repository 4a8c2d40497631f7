"""The command line of an experiment: exit codes and tables."""

import pytest

from rhs_isac_ros.experiments import JobError, markdown_table, run_command
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


def test_a_table_is_aligned_markdown():
    table = markdown_table(['method', 'm²'], [['direct', '1.5'], ['ga', '12.25']])
    assert table.splitlines() == [
        '| method |    m² |', '| ------ | ----: |', '| direct |   1.5 |', '| ga     | 12.25 |']
