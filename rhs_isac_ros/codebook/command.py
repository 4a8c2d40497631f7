"""The optimiser as a command: options, progress, files."""

import argparse
import contextlib
import dataclasses
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.objective import OBJECTIVES
from rhs_isac_ros.codebook.optimize import (
    DEFAULT_POSITIONS,
    INTERRUPTED,
    METHODS,
    STARTS,
    OptimizeResult,
    optimize,
)
from rhs_isac_ros.codebook.plot import draw_optimisation
from rhs_isac_ros.codebook.sampling import SAMPLINGS
from rhs_isac_ros.codebook.search import Progress
from rhs_isac_ros.model import Scenario, ScenarioError, streams

# Positions on which the average bound of the result is measured; none of them is a sample.
HELD_OUT_POSITIONS = 2000
# What goes wrong for reasons that the user can mend, and that the message tells.
__all__ = ['ERRORS', 'HELD_OUT_POSITIONS', 'INTERRUPTED', 'add_options', 'run']
ERRORS = (ScenarioError, CodebookError, ValueError, OSError)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of an optimisation to a parser.

    Parameters
    ----------
    parser
        The parser.
    """
    add = parser.add_argument
    add('--output', type=Path, default=Path('codebook.yaml'),
        help='file to write; it is replaced at the end')
    add('--scenario', type=Path,
        help="YAML file of the scenario; the paper's Table I if none is given")
    add('--method', choices=sorted(METHODS), default='lbfgs', help='optimiser')
    add('--objective', choices=sorted(OBJECTIVES), default='crlb',
        help='the average bound, or confusions over distances that a bound does not see')
    add('--sampling', choices=sorted(SAMPLINGS), default='sobol',
        help='how to sample the region of interest')
    add('--positions', type=int, default=DEFAULT_POSITIONS, help='how many samples')
    add('--steps', type=int, help="limit of update steps (default: the method's)")
    add('--evaluations', type=int, help='limit of evaluations (default: none)')
    add('--seed', type=int, default=0, help='seeds samples, start and method')
    add('--start', help=f'{" or ".join(STARTS)} (default: random), or a codebook file')
    add('--resume', action='store_true',
        help='go on from OUTPUT.part, which a stopped run leaves, or from OUTPUT')
    add('--plot', type=Path, help='picture to draw: convergence, bound and beam patterns')
    add('--quiet', action='store_true', help='show no progress')


def run(options: argparse.Namespace) -> tuple[Codebook, str]:
    """Optimise as the options say, write the file, and say so.

    Ctrl-C ends the search; what is written then is the best codebook so far.

    Parameters
    ----------
    options
        What a parser with `add_options` returns.

    Returns
    -------
    codebook : Codebook
        The codebook that was written.
    reason : str
        Why the search stopped.

    Raises
    ------
    ScenarioError, CodebookError, ValueError, OSError
        If an option or a file is wrong; what was at the place of the output is still there.
    """
    output, partial = options.output, options.output.with_name(options.output.name + '.part')
    for path in filter(None, (output, options.plot)):
        if not os.access(path.parent, os.W_OK):
            raise OSError(f'{path}: expected a file in a directory that can be written')
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    with _bar(options) as show:
        result = optimize(
            scenario, method=options.method, objective=options.objective,
            sampling=options.sampling, n_positions=options.positions, seed=options.seed,
            start=_start(options.start, scenario, options.seed),
            resume=Codebook.load(partial if partial.exists() else output)
            if options.resume else None,
            max_steps=options.steps, max_evaluations=options.evaluations, progress=show,
            keep=lambda result: _keep(result, partial))
    held_out = scenario.sample_positions(
        HELD_OUT_POSITIONS, streams.generator(options.seed, streams.HELD_OUT))
    bounds = crlb(scenario, result.codebook, held_out)
    average, error = float(bounds.mean()), float(bounds.std() / HELD_OUT_POSITIONS**0.5)
    codebook = dataclasses.replace(result.codebook, average_crlb_m2=average)
    _save(codebook, output)
    partial.unlink(missing_ok=True)
    print(f'{output}: average CRLB {average:.5f} m^2 (standard error {error:.5f}) over '
          f'{HELD_OUT_POSITIONS} held-out positions; {result.reason}')
    if options.plot:
        draw_optimisation(scenario, codebook, result.history, options.plot)
    return codebook, result.reason


def _start(name: str | None, scenario: Scenario, seed: int) -> Codebook | None:
    if name is None:
        return None
    if name in STARTS:
        return STARTS[name](scenario, streams.generator(seed, streams.START))
    return Codebook.load(name)


def _keep(result: OptimizeResult, partial: Path) -> None:
    """Write what there is so far; a full disk now may have room at the end."""
    try:
        result.codebook.save(partial)
    except OSError as error:
        print(f'warning: {partial}: {error}', file=sys.stderr)


def _save(codebook: Codebook, output: Path) -> None:
    """Write the result, elsewhere if its place does not take it: it may have cost hours."""
    try:
        codebook.save(output)
    except OSError as error:
        rescue = Path(tempfile.mkdtemp(prefix='rhs_isac_ros.')) / output.name
        codebook.save(rescue)
        raise OSError(f'{output}: {error}; the codebook is in {rescue}') from error


@contextlib.contextmanager
def _bar(options: argparse.Namespace) -> Iterator[Callable[[Progress], None] | None]:
    """Function that shows progress: a bar with value, step and time left."""
    if options.quiet:
        yield None
        return
    try:
        from tqdm import tqdm
    except ImportError:
        yield _print
        return
    total = options.steps or METHODS[options.method].steps
    with tqdm(total=total, unit='step', disable=None if sys.stderr.isatty() else False,
              mininterval=0.2 if sys.stderr.isatty() else 10.0) as bar:
        def show(progress: Progress) -> None:
            bar.set_description(f'{progress.value_m2:.5f} m^2', refresh=False)
            bar.update(progress.step - bar.n)
        yield show


def _print(progress: Progress) -> None:
    if progress.step % 50 == 0:
        print(f'step {progress.step}: {progress.value_m2:.5f} m^2 after '
              f'{progress.elapsed_s:.0f} s', file=sys.stderr)
