"""Optimise a library of codebooks, one for each cell of the region and uncertainty of a position.

The size of the cells follows from the loss. Results of an unfinished run are kept in OUTPUT.jobs;
repeat the command to continue it.
"""

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.codebook import library
from rhs_isac_ros.codebook.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support.arguments import ArgumentParser, input_file, output_file, positive_float
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.files import save_or_rescue
from rhs_isac_ros.support.job_commands import add_run_options, unfinished
from rhs_isac_ros.support.jobs import JobError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the code of `exit_code_of`."""
    parser = _parser()
    options = parser.parse_args(arguments)
    return exit_code_of(
        lambda: _run(options), (JobError, ValueError, ConnectionError, MemoryError), parser.prog)


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        prog='python3 -m rhs_isac_ros.codebook library', description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = parser.add_argument
    add('--output', type=output_file, default='library.npz', help='file to write')
    add('--scenario', '--config', type=input_file,
        help="YAML file of the scenario; the paper's Table I if omitted")
    add('--start', type=input_file,
        help='codebook of the whole region, from which each optimisation starts; '
             'config/codebook.yaml if omitted')
    # The bound alone ignores range ambiguities, which then return.
    add('--objective', choices=('ambiguity', 'error'), default='error',
        help='confusion of positions in the cell, or this confusion weighted almost as in the '
             'squared error')
    add('--spreads', type=positive_float, nargs='+', default=library.SPREADS_M, metavar='M',
        help='standard deviations of the coordinates of a predicted position [m]')
    add('--loss', type=positive_float, default=library.LOSS,
        help='largest relative loss due to the size of the cells')
    add('--quiet', action='store_true', help='show no progress')
    add_run_options(parser)
    return parser


def _run(options: argparse.Namespace) -> None:
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    start = Codebook.load(options.start or default_codebook_file())
    start.check(scenario)
    with unfinished(options.output, options, options.quiet) as workers:
        made = library.make_library(
            scenario, start, options.objective, sorted(options.spreads), options.loss,
            None if options.quiet else _print_loss, workers)
        save_or_rescue(made.save, options.output)
    numbers = ', '.join(f'{np.sum(made.spreads_m == spread_m)} for {spread_m:g} m'
                        for spread_m in made.plan.spreads_m)
    print(f'{options.output}: {made.id}, {len(made.codebooks)} codebooks: {numbers}')


def _print_loss(spread_m: float, pitch_m: float, loss: float) -> None:
    print(f'spread {spread_m:g} m, cells of {pitch_m:g} m: loss {100 * loss:.1f} %',
          file=sys.stderr)
