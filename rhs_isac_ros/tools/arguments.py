"""Types and checks of command-line arguments."""

import argparse
import math
from pathlib import Path


def positive_int(text: str) -> int:
    """Convert an argument to an integer of at least 1."""
    if int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text}, expected at least 1')
    return int(text)


def nonnegative_int(text: str) -> int:
    """Convert an argument to an integer of at least 0."""
    if int(text) < 0:
        raise argparse.ArgumentTypeError(f'{text}, expected at least 0')
    return int(text)


def positive_float(text: str) -> float:
    """Convert an argument to a finite number above 0."""
    if not 0 < float(text) < math.inf:
        raise argparse.ArgumentTypeError(f'{text}, expected a positive number')
    return float(text)


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
