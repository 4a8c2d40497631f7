"""Types of command line arguments, for argparse."""

import argparse


def positive_int(text: str) -> int:
    """Parse an integer of at least 1, or raise argparse.ArgumentTypeError."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r}, expected an integer') from None
    if number < 1:
        raise argparse.ArgumentTypeError(f'{text}, expected at least 1')
    return number
