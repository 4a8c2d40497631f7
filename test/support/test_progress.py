"""The progress of a command without a terminal."""

import sys

import pytest

from rhs_isac_ros.support.progress import progress_bar


def test_a_quiet_command_shows_no_progress(capfd):
    with progress_bar(4, 'step', quiet=True) as show:
        assert show is None
    assert capfd.readouterr() == ('', '')


def test_the_bar_shows_number_and_text(capfd):
    pytest.importorskip('tqdm')
    with progress_bar(4, 'step') as show:
        show(3, '0.1 m^2')
    assert '0.1 m^2:  75%' in capfd.readouterr().err


def test_without_tqdm_some_numbers_are_printed_as_lines(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'tqdm', None)
    with progress_bar(4, 'step', line_every=2) as show:
        for number in range(5):
            show(number, f'{number} m^2')
    assert capsys.readouterr().err.splitlines() == [
        'step 0: 0 m^2', 'step 2: 2 m^2', 'step 4: 4 m^2']
