"""Optimise a codebook and write it as a ROS 2 parameter file."""

import argparse
import dataclasses
import importlib.util
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rhs_isac_ros.bounds import crlb_of
from rhs_isac_ros.calibration import Calibration
from rhs_isac_ros.codebook import band_plan, library
from rhs_isac_ros.codebook.codebook import Codebook, default_codebook_file
from rhs_isac_ros.codebook.objective import OBJECTIVES, SAMPLINGS
from rhs_isac_ros.codebook.optimize import (
    DEFAULT_POSITIONS,
    METHODS,
    OptimizeResult,
    optimize,
    restarted,
)
from rhs_isac_ros.codebook.plot import plot_optimization
from rhs_isac_ros.codebook.problem import Progress
from rhs_isac_ros.codebook.unoptimised import STARTS
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    check_distinct,
    check_effect,
    input_file,
    integer,
    interval,
    output_file,
    picture_file,
    positive_float,
    positive_int,
    seed,
)
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.files import save_or_rescue
from rhs_isac_ros.support.job_commands import add_run_options, unfinished
from rhs_isac_ros.support.jobs import JobError, Workers
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.support.pictures import write_picture
from rhs_isac_ros.support.progress import progress_bar

# Number of positions, independent of the samples, for the average bound of the result.
HELD_OUT_POSITIONS = 2000
# With more positions, the samples would fill the memory.
_MAX_POSITIONS = 10**5
_LIBRARY = (
    'Optimise a library of codebooks, one for each cell of the region and uncertainty of a '
    'position. The size of the cells follows from the loss. Results of an unfinished run are kept '
    'in OUTPUT.jobs; repeat the command to continue it.')
# Errors that the user can correct; the command prints their messages.
ERRORS = (JobError, MissingLibraryError, ValueError, ConnectionError, MemoryError)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the code of `exit_code_of`, 0 even if Ctrl-C ends the search.

    The exit code is 130 if Ctrl-C ends jobs, which writes no codebook. If the first argument is
    ``library``, the others are the options of a library.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    is_library = arguments[:1] == ['library']
    parser = ArgumentParser(
        prog='python3 -m rhs_isac_ros.codebook' + is_library * ' library',
        description=_LIBRARY if is_library else __doc__)
    (_add_library_options if is_library else add_options)(parser)
    options = parser.parse_args(arguments[is_library:])
    (check_distinct if is_library else check)(parser, options)

    def work() -> None:
        if is_library:
            _run_library(options)
        else:
            run(options)
    return exit_code_of(work, ERRORS, parser.prog)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of an optimisation to a parser."""
    add = parser.add_argument
    add('--output', type=output_file, default='codebook.yaml',
        help='file to write; an existing file is replaced at the end')
    add('--scenario', '--config', type=input_file,
        help="YAML file of the scenario; the paper's Table I if omitted")
    add('--calibration', type=input_file,
        help="calibration file of the surface; the scenario's surface if omitted")
    add('--method', choices=sorted(METHODS), default='lbfgs', help='optimiser')
    add('--objective', choices=sorted(OBJECTIVES),
        help='crlb: the average bound; ambiguity: the confusion of distant positions, which a '
             'local bound ignores; error: this confusion, weighted almost as in the squared '
             'error; nuisance: the bound with unknown phases of the bands and the region as '
             'prior; crlb if omitted, or error with --spectrum')
    add('--sampling', choices=sorted(SAMPLINGS), default='sobol',
        help='how the region of interest is sampled')
    add('--positions', type=integer(1, _MAX_POSITIONS), default=DEFAULT_POSITIONS,
        help='number of samples')
    add('--steps', type=positive_int,
        help='maximum number of update steps; the default of the method if omitted')
    add('--seed', type=seed, default=0, help='seed of the samples, the start and the method')
    add('--start', type=_start_name, metavar='START',
        help=f'{", ".join(STARTS)} or a codebook file; random if omitted')
    add('--restarts', type=positive_int, default=1, metavar='N',
        help='number of searches, from different random starts, of which the best one counts')
    add('--resume', action='store_true',
        help='continue from OUTPUT.part, which an unfinished run leaves, or from OUTPUT')
    add('--plot', type=picture_file,
        help='file for a plot of convergence, bound and beam patterns: PNG, PDF or SVG')
    add('--spectrum', type=interval, nargs='+', metavar='LOW:HIGH',
        help='choose the centre frequencies of the bands within these intervals [Hz]')
    add('--bands', type=positive_int, help='number of bands to choose')
    add('--raster', type=positive_float, default=band_plan.DEFAULT_RASTER_HZ,
        help='spacing of possible centre frequencies [Hz]')
    add('--min-gap', type=positive_float,
        help='smallest distance between centre frequencies [Hz]; the width of a band if omitted')
    add('--plan', type=output_file, default='bandplan.yaml',
        help='file to write, with the scenario of the chosen bands')
    add('--quiet', action='store_true', help='show no progress')
    add_run_options(parser)


def check(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Exit with a usage error if options conflict, or a library or a file is missing."""
    check_distinct(parser, options, '' if options.spectrum else 'plan')
    if options.spectrum and not options.bands:
        parser.error('argument --spectrum: expected together with --bands')
    check_effect(parser, options, ('bands', 'raster', 'min_gap', 'plan'), options.spectrum,
                 'together with --spectrum')
    if options.spectrum and (options.start or options.resume):
        parser.error('argument --spectrum: not allowed with --start or --resume; to resume, '
                     'repeat the command')
    if options.spectrum and options.calibration:
        parser.error('argument --calibration: not allowed with --spectrum, because a calibration '
                     'belongs to one scenario')
    if options.restarts > 1 and (options.spectrum or options.start):
        parser.error('argument --restarts: not allowed with --spectrum or --start')
    if options.resume and (options.restarts > 1 or options.dask):
        parser.error('argument --resume: not allowed with --restarts or --dask; to resume jobs, '
                     'repeat the command')
    if options.resume and options.start:
        parser.error('argument --start: not allowed with --resume, which continues from a file')
    partial = _partial(options.output)
    if options.resume and not (partial.exists() or options.output.exists()):
        parser.error(f'argument --resume: expected {partial} or {options.output}')
    if options.plot and not importlib.util.find_spec('matplotlib'):
        parser.error('argument --plot: drawing needs matplotlib, which is not installed '
                     "(pip install 'rhs_isac_ros[plot]')")


def run(options: argparse.Namespace) -> tuple[Codebook, str]:
    """Optimise according to the options of `add_options`, write the file and print a summary.

    If Ctrl-C ends a search in this process, the best codebook so far is written. With jobs, Ctrl-C
    raises KeyboardInterrupt; the same call then continues with the unfinished jobs. Returns the
    codebook in the file and the reason why the search stopped. Raises one of `ERRORS` if an option
    or a file is invalid, or a library is missing, and OSError if a file cannot be written; an
    existing output file is then kept, unless only the plot fails.
    """
    output, partial = options.output, _partial(options.output)
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    objective = options.objective or ('error' if options.spectrum else 'crlb')
    calibration = Calibration.load(options.calibration) if options.calibration else None
    start = _start(options.start, scenario, options.seed, calibration)
    resumed = Codebook.load(partial if partial.exists() else output) if options.resume else None
    for codebook in filter(None, (start, resumed)):
        codebook.check(scenario, discrete=False)

    given: dict[str, Any] = {
        'method': options.method, 'objective': objective, 'sampling': options.sampling,
        'n_positions': options.positions, 'max_steps': options.steps}
    if options.spectrum:
        with unfinished(options.output, options, options.quiet) as workers:
            plan = _choose_bands(options, scenario, given, workers)
        scenario, result = plan.scenario, plan.result
    elif options.restarts > 1 or options.dask:
        with unfinished(options.output, options, options.quiet) as workers:
            (result,) = workers.run([restarted(
                scenario, options.restarts, options.seed, start=start,
                calibration=options.calibration, **given)])
    else:
        with progress_bar(options.steps or METHODS[options.method].steps, 'step',
                          quiet=options.quiet) as show:
            result = optimize(
                scenario, seed=options.seed, start=start, resume=resumed, calibration=calibration,
                progress=show and (lambda progress: show(progress.step, _value(progress))),
                keep=lambda result: _save_partial(result, partial), **given)
    held_out = scenario.sample_positions(
        HELD_OUT_POSITIONS, streams.generator(options.seed, streams.HELD_OUT))
    bounds = crlb_of(MeasurementModel(
        scenario, result.codebook, calibration.surface if calibration else None), held_out)
    average, error = float(bounds.mean()), float(bounds.std() / HELD_OUT_POSITIONS**0.5)
    codebook = dataclasses.replace(result.codebook, average_crlb_m2=average)
    save_or_rescue(codebook.save, output)
    partial.unlink(missing_ok=True)
    print(f'{output}: average CRLB {average:.5f} m^2 (standard error {error:.5f}) over '
          f'{HELD_OUT_POSITIONS} held-out positions; {result.reason}')
    if options.plot:
        write_picture(options.plot, plot_optimization(scenario, codebook, result.history))
    return codebook, result.reason


def _choose_bands(
        options: argparse.Namespace, scenario: Scenario, given: Mapping[str, Any],
        workers: Workers) -> band_plan.BandPlan:
    """Choose the bands and the codebook, and write the scenario with these bands."""
    def report(candidate: band_plan.Candidate) -> None:
        if not options.quiet:
            print(f'{_in_ghz(candidate.frequencies_hz)}: {candidate.error_m2:.4f} m^2 expected',
                  file=sys.stderr)

    candidates = band_plan.choose_bands(
        scenario, options.spectrum, options.bands, raster_hz=options.raster,
        min_gap_hz=options.min_gap, seed=options.seed, report=report, workers=workers)
    best = band_plan.best_of(scenario, candidates, given, options.seed, report, workers=workers)
    best.scenario.to_yaml(options.plan, 'Chosen by python3 -m rhs_isac_ros.codebook --spectrum. '
                          'Omitted fields have the values of Table I.')
    print(f'{options.plan}: {_in_ghz(best.scenario.center_frequencies_hz)}, '
          f'{best.scenario.n_frames} frames each')
    return best


def _in_ghz(frequencies_hz: Sequence[float]) -> str:
    return ', '.join(f'{frequency / 1e9:g}' for frequency in frequencies_hz) + ' GHz'


def _partial(output: Path) -> Path:
    """Return the file for the result of an unfinished search."""
    return output.with_name(output.name + '.part')


def _start_name(text: str) -> str:
    return text if text in STARTS else str(input_file(text))


def _start(name: str | None, scenario: Scenario, seed: int,
           calibration: Calibration | None) -> Codebook | None:
    if name is None:
        return None
    if name in STARTS:
        return STARTS[name](scenario, streams.generator(seed, streams.START),
                            calibration.surface if calibration else None)
    return Codebook.load(name)


def _save_partial(result: OptimizeResult, partial: Path) -> None:
    """Save an unfinished result; a failure causes only a warning, as a later write may succeed."""
    try:
        result.codebook.save(partial)
    except OSError as error:
        print(f'warning: {partial}: {error}', file=sys.stderr)


def _value(progress: Progress) -> str:
    return ('setting up the objective' if math.isinf(progress.value_m2)
            else f'{progress.value_m2:.5f} m^2')


def _add_library_options(parser: argparse.ArgumentParser) -> None:
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


def _run_library(options: argparse.Namespace) -> None:
    """Optimise a library of codebooks, write its file and print a summary."""
    def print_loss(spread_m: float, pitch_m: float, loss: float) -> None:
        if not options.quiet:
            print(f'spread {spread_m:g} m, cells of {pitch_m:g} m: loss {100 * loss:.1f} %',
                  file=sys.stderr)

    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    start = Codebook.load(options.start or default_codebook_file(), scenario)
    with unfinished(options.output, options, options.quiet) as workers:
        made = library.make_library(scenario, start, options.objective, sorted(options.spreads),
                                    options.loss, print_loss, workers)
        save_or_rescue(made.save, options.output)
    numbers = ', '.join(f'{(made.spreads_m == spread_m).sum()} for {spread_m:g} m'
                        for spread_m in made.plan.spreads_m)
    print(f'{options.output}: {made.id}, {len(made.codebooks)} codebooks: {numbers}')


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
