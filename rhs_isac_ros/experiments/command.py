"""Command lines of experiments: common options, exit codes and tables."""

import argparse
import re
import sys
from collections.abc import Callable, Sequence

from rhs_isac_ros.executables import print_error
from rhs_isac_ros.experiments.jobs import JobError
from rhs_isac_ros.support.arguments import integer, output_folder
from rhs_isac_ros.support.optional import MissingLibraryError

# Exit code that shells report after Ctrl-C.
_INTERRUPTED = 130


def add_run_options(parser: argparse.ArgumentParser, output: str) -> None:
    """Add the options of `run_jobs`; `output` is the default folder of the results."""
    parser.add_argument('--jobs', type=integer(1, 1024), default=-1, metavar='N',
                        help='number of parallel jobs (default: one per core)')
    parser.add_argument('--dask', type=_address, metavar='ADDRESS',
                        help='scheduler of a Dask cluster to use instead of this machine; '
                             'its workers need this package, and one thread each for '
                             'accurate timing')
    parser.add_argument('--output', type=output_folder, default=output, metavar='DIR',
                        help='folder of the results (default: %(default)s); jobs that have '
                             'results there are not repeated')


def _address(text: str) -> str:
    if not re.fullmatch(r'(\w+://)?[^\s/:]+:\d{1,5}', text):
        raise argparse.ArgumentTypeError(f'{text!r}, expected HOST:PORT')
    return text


def run_command(experiment: Callable[[], None]) -> int:
    """Run an experiment; return 0, 1 after an error, which is printed, or 130 after Ctrl-C."""
    try:
        experiment()
    except KeyboardInterrupt:
        print('interrupted: finished jobs are kept; repeat the command to resume',
              file=sys.stderr)
        return _INTERRUPTED
    except (JobError, MissingLibraryError, OSError) as error:
        print_error(f'{error}; finished jobs are kept; repeat the command to resume')
        return 1
    return 0


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table with aligned columns, the first to the left, others to the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ['-' * widths[0], *('-' * (width - 1) + ':' for width in widths[1:])]
    lines = [
        [entry.ljust(width) if column == 0 else entry.rjust(width)
         for column, (entry, width) in enumerate(zip(row, widths, strict=True))]
        for row in (header, rule, *rows)]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)
