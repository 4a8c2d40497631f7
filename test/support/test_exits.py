"""Signals, errors and exit codes at the end of a command."""

import subprocess
import sys
import types

import pytest

from rhs_isac_ros.support import exits


@pytest.mark.parametrize(('spec', 'expected'), [
    (None, 'fig4.py: error: x\n'),
    (types.SimpleNamespace(name='lab.__main__'), 'python3 -m lab: error: x\n'),
    (types.SimpleNamespace(name='lab.tool'), 'python3 -m lab.tool: error: x\n')])
def test_an_error_names_the_program_of_the_process_by_default(spec, expected, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, '__main__', types.SimpleNamespace(__spec__=spec))
    monkeypatch.setattr(sys, 'argv', ['/lab/fig4.py', 'x'])
    exits.print_error('x')
    assert capsys.readouterr().err == expected


@pytest.mark.parametrize(('result', 'code', 'text'), [
    (None, 0, ''), (1, 1, ''), (LookupError('no such place'), 2, 'lab: error: no such place\n'),
    (OSError('disk full'), 1, 'lab: error: disk full\n'),
    (EOFError('no answer'), 1, 'lab: error: no answer\n'), (BrokenPipeError(), 0, ''),
    (KeyboardInterrupt(), 130, '')])
def test_the_end_of_a_command(result, code, text, capsys):
    def work():
        if isinstance(result, BaseException):
            raise result
        return result
    assert exits.exit_code_of(work, (LookupError,), 'lab', failures=(EOFError,)) == code
    assert capsys.readouterr().err == text


@pytest.mark.parametrize(('setup', 'ends'), [
    ('', 'True True True'),
    # As under nohup.
    ('signal.signal(signal.SIGHUP, signal.SIG_IGN)', 'True True False')])
def test_a_handler_of_all_signals_that_end_a_command_respects_nohup(setup, ends):
    code = f"""
import signal
from rhs_isac_ros.support.exits import on_end_signals
{setup}
received = []
on_end_signals(lambda number, _: received.append(number))
numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
for number in numbers:
    signal.raise_signal(number)
print(*(number in received for number in numbers))
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=True, timeout=240)
    assert done.stdout.strip() == ends
