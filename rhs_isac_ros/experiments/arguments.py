"""Types of command line arguments, for argparse."""

import argparse


def positive_int(text: str) -> int:
    """Parse an integer of at least 1.

    Raises
    ------
    argparse.ArgumentTypeError
        If the text is anything else.
    """
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r}, expected an integer') from None
    if number < 1:
        raise argparse.ArgumentTypeError(f'{text}, expected at least 1')
    return number
