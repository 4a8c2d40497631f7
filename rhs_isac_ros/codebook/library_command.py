"""Optimise a library of codebooks, one for each cell of the region and uncertainty of a position.

The size of the cells follows from the loss. An unfinished library is kept in OUTPUT.part.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rhs_isac_ros.codebook import library
from rhs_isac_ros.codebook.codebook import Codebook, default_codebook_file
from rhs_isac_ros.codebook.library import Library
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    output_file,
    positive_float,
)
from rhs_isac_ros.support.exits import print_error
from rhs_isac_ros.support.progress import progress_bar

# Smallest time between two writes of an unfinished library [s].
_KEEP_S = 10.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 2 after an error, or 130 after Ctrl-C."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        _run(options)
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, MemoryError) as error:
        print_error(error, parser.prog)
        return 2
    return 0


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        prog='python3 -m rhs_isac_ros.codebook library', description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = parser.add_argument
    add('--output', type=output_file, default='library.npz', help='file to write')
    add('--scenario', type=input_file,
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
    return parser


def _run(options: argparse.Namespace) -> None:
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    start = Codebook.load(options.start or default_codebook_file())
    start.check(scenario)
    partial = options.output.with_name(options.output.name + '.part')
    done = _resumed(partial, scenario, start, options)
    if done:
        plan = done.plan
    else:
        plan = library.plan_library(
            scenario, start, options.objective, sorted(options.spreads), options.loss,
            None if options.quiet else _print_loss)
    cells, kept_s = plan.cells(scenario), time.monotonic()
    with progress_bar(len(cells), 'codebook', quiet=options.quiet) as show:
        def keep(found: Library) -> None:
            nonlocal kept_s
            if show:
                show(len(found.codebooks), f'{found.spreads_m[-1]:g} m')
            if time.monotonic() >= kept_s + _KEEP_S:
                found.save(partial)
                kept_s = time.monotonic()

        complete = library.build(scenario, plan, start, done.codebooks if done else (), keep)
    complete.save(options.output)
    partial.unlink(missing_ok=True)
    numbers = ', '.join(f'{number} for {spread}'
                        for spread, number in library.describe(plan, scenario).items())
    print(f'{options.output}: {complete.id}, {len(cells)} codebooks: {numbers}')


def _resumed(partial: Path, scenario: Scenario, start: Codebook, options: argparse.Namespace
             ) -> Library | None:
    """Return an unfinished library of the same arguments, if there is one."""
    if not partial.exists():
        return None
    found = Library.load(partial)
    expected = (scenario.unplaced.id, start.id, options.objective, tuple(sorted(options.spreads)))
    plan = found.plan
    if (plan.scenario, plan.start, plan.objective, plan.spreads_m) != expected:
        raise ValueError(f'{partial}: made with other arguments, expected {expected}; '
                         'delete it to start anew')
    return found


def _print_loss(spread_m: float, pitch_m: float, loss: float) -> None:
    print(f'spread {spread_m:g} m, cells of {pitch_m:g} m: loss {100 * loss:.1f} %',
          file=sys.stderr)
