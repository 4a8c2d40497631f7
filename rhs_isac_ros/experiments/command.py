"""The command line of an experiment: common options and exit codes."""

import argparse
import re
import sys
from collections.abc import Callable, Sequence

import numpy as np

from rhs_isac_ros.executables import print_error
from rhs_isac_ros.experiments.jobs import JobError
from rhs_isac_ros.support.arguments import ArgumentParser, integer, output_folder
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.support.pictures import PICTURE_FORMATS

# Exit code that shells report after Ctrl-C.
_INTERRUPTED = 130


def parse_options(
        description: str, name: str, trials: int, quick_trials: int,
        arguments: Sequence[str] | None = None,
        add: Callable[[argparse.ArgumentParser], None] | None = None) -> argparse.Namespace:
    """Parse the command line of an experiment.

    Parameters
    ----------
    name
        Name of the experiment and of its results folder.
    trials, quick_trials
        Number of trials, and the number with ``--quick``.
    add
        Callable that adds the experiment's own options to a parser.

    Returns
    -------
    argparse.Namespace
        ``trials``, ``quick``, ``jobs``, ``dask``, ``output``, ``format`` of the pictures, and the
        experiment's own options.
    """
    parser = ArgumentParser(
        prog=f'scripts/reproduce {name}', description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    count = parser.add_mutually_exclusive_group()
    count.add_argument('--quick', action='store_true', help=f'run only {quick_trials} trials')
    count.add_argument('--trials', type=integer(1, 10**5), metavar='N',
                       help=f'number of trials (default: {trials})')
    if add:
        add(parser)
    add_run_options(parser, f'results/{name}')
    parser.add_argument('--format', choices=PICTURE_FORMATS, default=PICTURE_FORMATS[0],
                        help='format of the picture, and suffix of its name (default: '
                             '%(default)s); drawing again repeats no job')
    options = parser.parse_args(arguments)
    options.trials = quick_trials if options.quick else options.trials or trials
    return options


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
    """Check the address of a scheduler, for argparse."""
    if not re.fullmatch(r'(\w+://)?[^\s/:]+:\d{1,5}', text):
        raise argparse.ArgumentTypeError(f'{text!r}, expected HOST:PORT')
    return text


def run_command(experiment: Callable[[], None]) -> int:
    """Run an experiment and print the error that ended it early, if any.

    Return the exit code: 0, 1 after an error, 130 after Ctrl-C.
    """
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


def mean_and_std(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation of a sample.

    The mean is infinite if a value is. The deviation is NaN if it is undefined: for a single
    value, or an infinite mean.
    """
    mean = float(np.mean(values))
    if len(values) < 2 or not np.isfinite(mean):
        return mean, float('nan')
    return mean, float(np.std(values, ddof=1))


def plus_minus(mean: float, std: float, digits: int = 3) -> str:
    """Format a mean, to some significant digits, and its deviation to the same decimal place.

    A deviation of NaN is omitted.
    """
    if not np.isfinite(mean):
        return str(mean)
    magnitude = int(np.floor(np.log10(abs(mean)))) if mean else 0
    places = max(digits - 1 - magnitude, 0)
    return f'{mean:.{places}f}' + ('' if np.isnan(std) else f' ± {std:.{places}f}')


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table with aligned columns, the first to the left, others to the right.

    Each row is as long as the header.
    """
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ['-' * widths[0], *('-' * (width - 1) + ':' for width in widths[1:])]
    lines = [
        [entry.ljust(width) if column == 0 else entry.rjust(width)
         for column, (entry, width) in enumerate(zip(row, widths, strict=True))]
        for row in (header, rule, *rows)]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)
