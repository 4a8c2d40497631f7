"""Check a board Open Source RIS, show its pattern, or switch one element after the other."""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Iterator, Sequence

import numpy as np

from rhs_isac_ros.frontend.opensourceris import COLUMNS, ROWS, OpenSourceRis
from rhs_isac_ros.frontend.opensourceris_emulator import EmulatedBoard
from rhs_isac_ros.frontend.surface import SurfaceFault
from rhs_isac_ros.support.arguments import ArgumentParser, nonnegative_float, positive_float
from rhs_isac_ros.support.exits import exit_code_of


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code.

    The code is 0; 1 if `check` finds wrong patterns; 2 after an error; or 130 after Ctrl-C.
    """
    parser = ArgumentParser(
        # The script names itself.
        prog=os.environ.get('RHS_ISAC_PROGRAM', 'python3 -m rhs_isac_ros.frontend'),
        description=__doc__)
    commands = parser.add_subparsers(dest='command', required=True)
    for name, text in (
            ('check', 'print serial number, supply and times, and read each element back'),
            ('show', 'print the last pattern: # is 1, . is 0, seen from the front'),
            ('sweep', 'switch on one element after the other, from the lower left')):
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument('port', type=_port, metavar='PORT',
                             help='device such as /dev/ttyUSB0, or emulated')
        command.add_argument('--timeout', type=positive_float, default=0.1,
                             help='time for an answer of the board [s]')
        if name == 'sweep':
            command.add_argument('--interval', type=nonnegative_float, default=0.2,
                                 help='time for each element [s]')
    options = parser.parse_args(arguments)
    return exit_code_of(lambda: _run(options), (SurfaceFault,), parser.prog)


def _run(options: argparse.Namespace) -> int:
    with _board(options.port, options.timeout) as board:
        if options.command == 'check':
            return _check(board)
        if options.command == 'sweep':
            _sweep(board, options.interval)
        else:
            print(picture(board.read()))
        return 0


def picture(configuration: np.ndarray) -> str:
    """Draw a configuration, [256], as seen from the front, with one line for each row."""
    rows = configuration.reshape(ROWS, COLUMNS)[::-1]
    return '\n'.join(' '.join('#' if state else '.' for state in row) for row in rows)


def _port(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError("'', expected a device or emulated")
    return text


@contextlib.contextmanager
def _board(port: str, timeout_s: float) -> Iterator[OpenSourceRis]:
    with contextlib.ExitStack() as stack:
        if port == 'emulated':
            port = stack.enter_context(EmulatedBoard()).port
        # Commands read back by themselves, where they measure or print it.
        board = OpenSourceRis(port=port, timeout_s=timeout_s, read_back=False)
        stack.callback(board.close)
        yield board


def _check(board: OpenSourceRis) -> int:
    """Print what the board answers, and how fast; return 1 if it reads back another pattern."""
    print(f'serial number {board.serial_number()}, supply {board.supply_voltage_v():.2f} V')
    durations_s, wrong = [], []
    with _restored(board):
        for element, configuration in enumerate(np.eye(board.n_elements)):
            times_s = [time.perf_counter()]
            board.apply(configuration)
            times_s.append(time.perf_counter())
            shown = board.read()
            times_s.append(time.perf_counter())
            durations_s.append(np.diff(times_s))
            if (shown != configuration).any():
                wrong.append(element)
    for name, times_ms in zip(('set', 'read'), 1e3 * np.transpose(durations_s), strict=True):
        print(f'{name}: median {np.median(times_ms):.2f} ms, longest {times_ms.max():.2f} ms')
    print(f'{board.n_elements - len(wrong)} of {board.n_elements} patterns of one element are '
          f'right{f"; wrong: {wrong}" if wrong else ""}')
    return int(bool(wrong))


def _sweep(board: OpenSourceRis, interval_s: float) -> None:
    with _restored(board):
        for element, configuration in enumerate(np.eye(board.n_elements)):
            board.apply(configuration)
            row, column = divmod(element, COLUMNS)
            print(f'element {element}: row {row}, column {column}', flush=True)
            time.sleep(interval_s)


@contextlib.contextmanager
def _restored(board: OpenSourceRis) -> Iterator[None]:
    """Set the pattern again that the board has at first, unless a fault ends the block."""
    before = board.read()
    try:
        yield
    except KeyboardInterrupt:
        board.apply(before)
        raise
    board.apply(before)


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
