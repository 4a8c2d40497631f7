"""Command lines of programs that run jobs: their options, their unfinished results, their end."""

import argparse
import contextlib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from rhs_isac_ros.support.arguments import integer, output_folder
from rhs_isac_ros.support.exits import print_error
from rhs_isac_ros.support.jobs import JobError, Workers
from rhs_isac_ros.support.optional import MissingLibraryError


def add_run_options(parser: argparse.ArgumentParser, output: str = '') -> None:
    """Add the options of `run_jobs`; `output` is the default folder of the results, if any."""
    parser.add_argument('--jobs', type=integer(1, 1024), default=-1, metavar='N',
                        help='number of parallel jobs (default: one per core)')
    parser.add_argument('--dask', type=_address, metavar='ADDRESS',
                        help='scheduler of a Dask cluster to use instead of this machine; '
                             'its workers need this package, and one thread each for '
                             'accurate timing')
    if output:
        parser.add_argument('--output', type=output_folder, default=output, metavar='DIR',
                            help='folder of the results (default: %(default)s); jobs that have '
                                 'results there are not repeated')


@contextlib.contextmanager
def unfinished(output: Path, options: argparse.Namespace, quiet: bool = False
               ) -> Iterator[Workers]:
    """Yield workers whose results are kept in OUTPUT.jobs until the block succeeds.

    Those in a new folder are also removed if there is nothing to continue: an input is refused, or
    no job is done. Results of other runs remain, because these may still need them. The options
    are those of `add_run_options`.
    """
    folder = output.with_name(output.name + '.jobs')
    is_new, is_over = not folder.exists(), False
    workers = Workers(options.jobs, options.dask, folder, quiet=quiet)
    try:
        yield workers
        is_over = True
    except BaseException as error:
        is_over = is_new and (isinstance(error, ValueError) or not any(folder.glob('*.json')))
        raise
    finally:
        for file in workers.files if is_over else ():
            file.unlink(missing_ok=True)
        # It contains results of other runs, or does not exist.
        with contextlib.suppress(OSError):
            folder.rmdir()


def _address(text: str) -> str:
    if not re.fullmatch(r'(\w+://)?[^\s/:]+:\d{1,5}', text):
        raise argparse.ArgumentTypeError(f'{text!r}, expected HOST:PORT')
    return text


def run_command(experiment: Callable[[], None]) -> int:
    """Run an experiment; return 0, 130 after Ctrl-C, or 1 after a job, file or library error."""
    try:
        experiment()
    except KeyboardInterrupt:
        print('interrupted: finished jobs are kept; repeat the command to resume',
              file=sys.stderr)
        # The exit code by which shells report Ctrl-C.
        return 130
    except (JobError, MissingLibraryError, OSError) as error:
        print_error(f'{error}; finished jobs are kept; repeat the command to resume')
        return 1
    return 0
