"""`python3 -m rhs_isac_ros.frontend`: what it prints, and its exit codes."""

import re

import numpy as np
import pytest

from rhs_isac_ros.frontend import OpenSourceRis
from rhs_isac_ros.frontend.__main__ import main, picture


@pytest.fixture
def pattern(board, driver):
    """A pattern that the board shows before the command."""
    pattern = np.random.default_rng(0).integers(0, 2, 256)
    driver.apply(pattern)
    driver.close()
    return pattern


def test_check_reads_every_element_back_and_restores_the_pattern(board, pattern, capsys):
    assert main(['check', board.port, '--timeout', '60']) == 0
    state, set_ms, read_ms, count = capsys.readouterr().out.splitlines()
    assert state == 'serial number 0, supply 5.80 V'
    assert re.fullmatch(r'set: median \d+\.\d\d ms, longest \d+\.\d\d ms', set_ms)
    assert re.fullmatch(r'read: median \d+\.\d\d ms, longest \d+\.\d\d ms', read_ms)
    assert count == '256 of 256 patterns of one element are right'
    assert (board.configuration == pattern).all()


def test_check_names_the_elements_that_differ(board, capsys):
    board.faults = {3: 'flipped bit', 200: 'flipped bit'}
    assert main(['check', board.port, '--timeout', '60']) == 1
    assert capsys.readouterr().out.splitlines()[-1] == (
        '254 of 256 patterns of one element are right; wrong: [3, 200]')


def test_show_draws_the_pattern(board, pattern, capsys):
    assert main(['show', board.port, '--timeout', '60']) == 0
    assert capsys.readouterr().out == picture(pattern) + '\n'


def test_the_picture_has_the_last_row_at_the_top():
    lines = picture(np.arange(256) == 241).splitlines()
    assert lines == ['. #' + 14 * ' .'] + 15 * ['.' + 15 * ' .']


def test_sweep_shows_one_element_after_the_other(board, pattern, capsys, monkeypatch):
    shown, apply = [], OpenSourceRis.apply

    def record(driver, configuration):
        apply(driver, configuration)
        shown.append(board.configuration)
    monkeypatch.setattr(OpenSourceRis, 'apply', record)
    assert main(['sweep', board.port, '--interval', '0', '--timeout', '60']) == 0
    assert (shown == np.vstack([np.eye(256), pattern])).all()
    lines = capsys.readouterr().out.splitlines()
    assert (len(lines), lines[-1]) == (256, 'element 255: row 15, column 15')


def test_ctrl_c_ends_a_sweep_and_restores_the_pattern(board, pattern, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt
    monkeypatch.setattr('time.sleep', interrupt)
    assert main(['sweep', board.port, '--timeout', '60']) == 130
    assert (board.configuration == pattern).all()


def test_a_fault_is_one_line(board, capsys, monkeypatch):
    """It begins with the name that was typed."""
    monkeypatch.setenv('RHS_ISAC_PROGRAM', 'scripts/board')
    board.faults = {7: 'silence'}
    assert main(['check', board.port, '--timeout', '0.05']) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f'scripts/board: error: {board.port}: no answer to ')


def test_the_emulated_board_needs_no_hardware(capsys):
    assert main(['show', 'emulated', '--timeout', '60']) == 0
    assert capsys.readouterr().out == picture(np.zeros(256)) + '\n'
