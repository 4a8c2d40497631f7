"""Types and checks of command-line arguments, for argparse."""

import argparse
import math
from pathlib import Path


def positive_int(text: str) -> int:
    """Parse an integer of at least 1, or raise argparse.ArgumentTypeError."""
    return _int(text, 1)


def nonnegative_int(text: str) -> int:
    """Parse an integer of at least 0, or raise argparse.ArgumentTypeError."""
    return _int(text, 0)


def positive_float(text: str) -> float:
    """Parse a finite number above 0, or raise argparse.ArgumentTypeError."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a positive number')
    return number


def check_directory(parser: argparse.ArgumentParser, argument: str, file: Path | None) -> None:
    """Exit with a usage error if the directory of an output file does not exist.

    Parameters
    ----------
    argument
        Name of the argument.
    file
        Value of the argument; None if it was not given.
    """
    if file and not file.resolve().parent.is_dir():
        parser.error(f'argument {argument}: {file}, expected a file in a directory that exists')


def _int(text: str, low: int) -> int:
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r}, expected an integer') from None
    if number < low:
        raise argparse.ArgumentTypeError(f'{text}, expected at least {low}')
    return number
