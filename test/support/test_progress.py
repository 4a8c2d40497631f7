"""The progress of a command on a terminal and in a file."""

import io
import sys

import pytest

from rhs_isac_ros.support.progress import progress_bar


def test_a_quiet_command_shows_no_progress(capfd):
    with progress_bar(4, 'step', quiet=True) as show:
        assert show is None
    assert capfd.readouterr() == ('', '')


def test_a_file_has_a_line_every_ten_seconds(monkeypatch, capsys):
    clock = iter([0.0, 3.0, 11.0, 12.0, 21.5])
    monkeypatch.setattr('time.monotonic', lambda: next(clock))
    with progress_bar(4, 'step', label='codebooks') as show:
        for number in range(3):
            show(number, f'{number} m^2')
        show(3, '', 8)
    assert capsys.readouterr().err.splitlines() == [
        'codebooks: step 1 of 4: 1 m^2: 11 s', 'codebooks: step 3 of 8: 22 s']


@pytest.mark.parametrize('missing', [False, True])
def test_a_terminal_shows_a_bar_if_tqdm_is_installed(monkeypatch, missing):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, 'stderr', terminal)
    if missing:
        monkeypatch.setitem(sys.modules, 'tqdm', None)
    else:
        pytest.importorskip('tqdm')
    with progress_bar(4, 'step') as show:
        show(3, '0.1 m^2')
    assert ('0.1 m^2:  75%' in terminal.getvalue()) != missing
