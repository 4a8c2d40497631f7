"""The options that all experiments share, and the files of their results."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rhs_isac_ros.experiments.jobs import add_run_options
from rhs_isac_ros.support.arguments import ArgumentParser, integer
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.support.pictures import PICTURE_FORMATS, write_picture


def parse_options(
        description: str, name: str, trials: int, quick_trials: int,
        arguments: Sequence[str] | None = None,
        add: Callable[[argparse.ArgumentParser], Any] | None = None) -> argparse.Namespace:
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


def write_results(options: argparse.Namespace, name: str, title: str, report: str, figure: Any,
                  data: Mapping[str, str]) -> None:
    """Print the report of an experiment, and write it with its picture and files of data."""
    picture, files = f'{name}.{options.format}', [f'{name}.md', *data]
    write_picture(options.output / picture, figure)
    for file, text in data.items():
        write_whole(options.output / file, text)
    write_whole(options.output / f'{name}.md',
                f'# {title}\n\n![{title}]({picture})\n\n{report}\n')
    print(f'{report}\n\nwritten: {options.output}/{picture}, {", ".join(files[:-1])} and '
          f'{files[-1]}')
