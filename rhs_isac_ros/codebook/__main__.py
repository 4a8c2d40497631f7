"""Optimise a codebook and write it as a ROS 2 parameter file."""

import argparse
import sys
from collections.abc import Sequence

from rhs_isac_ros.codebook.command import ERRORS, add_options, check, run
from rhs_isac_ros.executables import exit_code_of, print_error
from rhs_isac_ros.support.arguments import ArgumentParser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, also after Ctrl-C, or 2 if an argument or a file is invalid."""
    parser = ArgumentParser(
        prog='python3 -m rhs_isac_ros.codebook', description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add_options(parser)
    options = parser.parse_args(arguments)
    check(parser, options)
    try:
        run(options)
    except ERRORS as error:
        print_error(error, parser.prog)
        return 2
    return 0


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
