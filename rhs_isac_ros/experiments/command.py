"""What the commands of all experiments share: options, and how they end."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from rhs_isac_ros.experiments.jobs import JobError
from rhs_isac_ros.experiments.libraries import MissingLibraryError

# As a shell reports a command that Ctrl-C ended.
_INTERRUPTED = 130


def parse_options(
        description: str, name: str, trials: int, quick_trials: int,
        arguments: Sequence[str] | None = None,
        add: Callable[[argparse.ArgumentParser], None] | None = None) -> argparse.Namespace:
    """Read the command line of an experiment.

    Parameters
    ----------
    description
        What the experiment is.
    name
        Its name, and that of its folder.
    trials, quick_trials
        How many trials there are, and how many with ``--quick``.
    arguments
        Command line; by default the process's.
    add
        Adds options that only this experiment has.

    Returns
    -------
    argparse.Namespace
        ``trials``, ``quick``, ``jobs``, ``dask`` and ``output``, and what `add` adds.
    """
    parser = argparse.ArgumentParser(
        prog=f'scripts/reproduce {name}', description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    count = parser.add_mutually_exclusive_group()
    count.add_argument('--quick', action='store_true', help=f'{quick_trials} trials only')
    count.add_argument('--trials', type=positive, metavar='N',
                       help=f'how many trials (default: {trials})')
    if add:
        add(parser)
    parser.add_argument('--jobs', type=positive, default=-1, metavar='N',
                        help='how many at a time (default: one on each core)')
    parser.add_argument('--dask', metavar='ADDRESS',
                        help='scheduler of a Dask cluster to use instead of this machine; '
                             'each worker needs this package, and one thread for true times')
    parser.add_argument('--output', type=Path, default=Path('results', name), metavar='DIR',
                        help='folder of the results (default: %(default)s); a run goes on from '
                             'what is there')
    options = parser.parse_args(arguments)
    options.trials = quick_trials if options.quick else options.trials or trials
    return options


def run_command(experiment: Callable[[], None]) -> int:
    """Run an experiment, and tell people what ended it early.

    Parameters
    ----------
    experiment
        The experiment.

    Returns
    -------
    int
        Exit code: 0, 1 after an error, 130 after Ctrl-C.
    """
    try:
        experiment()
    except KeyboardInterrupt:
        print('interrupted: finished jobs are kept, the same command resumes', file=sys.stderr)
        return _INTERRUPTED
    except (JobError, MissingLibraryError, OSError) as error:
        print(f'error: {error}\nfinished jobs are kept, the same command resumes',
              file=sys.stderr)
        return 1
    return 0


def positive(text: str) -> int:
    """Read a whole number above 0 from a command line.

    Parameters
    ----------
    text
        The argument.

    Returns
    -------
    int
        Its value.

    Raises
    ------
    argparse.ArgumentTypeError, ValueError
        If it is something else.
    """
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f'{text}, expected at least 1')
    return number
