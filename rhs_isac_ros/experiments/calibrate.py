"""The command that estimates a surface, a hall or a board from pilots at known positions.

The pilots come from a file of arrays. The command ``calibrate`` of `tools` also takes them from
recordings and running networks.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from rhs_isac_ros.calibration import (
    Calibration,
    CalibrationError,
    Pilots,
    known_states,
    load_surface,
    report,
    survey_report,
)
from rhs_isac_ros.calibration.estimate import places_of
from rhs_isac_ros.calibration.survey import PLACE_WAVELENGTHS
from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.experiments.pilots import Found, PilotWork
from rhs_isac_ros.model import MultipathEstimate, Scenario
from rhs_isac_ros.model.boards import board_of
from rhs_isac_ros.support.arguments import check_distinct, input_path, output_file, typed
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.files import (
    ArchiveError,
    parse_yaml,
    read_arrays,
    save_or_rescue,
    write_whole,
)
from rhs_isac_ros.support.job_commands import add_run_options, unfinished
from rhs_isac_ros.support.jobs import JobError, Workers
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.system import add_files, fill_in

#: Suffix of a file of pilots as arrays.
ARRAYS = '.npz'
DESCRIPTION = (
    'Estimate errors and failures of the elements, and gains and phases of the bands, or the '
    'covariance of the multipath, from signals of users at known positions.')
_OUTPUT = Path('calibration.npz')


def main(parser: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """Run the command with the options of `add_options`; return the exit code.

    The code is 1 if a job or a library fails, 2 if a file is invalid, 130 after Ctrl-C.
    """
    def work() -> None:
        if problem := conflict(options):
            parser.error(problem)
        fill_in(options)
        check_distinct(parser, options)
        if not (options.states or options.file and options.file.suffix == ARRAYS):
            parser.error(f'argument file: {options.file}, expected a file of arrays, {ARRAYS}; '
                         'recordings and networks need scripts/calibrate, with ROS 2')
        estimate(options, Scenario.from_yaml(options.config) if options.config else Scenario())
    return exit_code_of(
        work, (ValueError,), parser.prog, failures=(JobError, MissingLibraryError))


def estimate(options: argparse.Namespace, scenario: Scenario,
             pilots: Sequence[Pilots] | None = None) -> None:
    """Estimate what the options name, write it to a file, and print a report.

    The pilots are those of the file of arrays unless they are given. Raises CalibrationError if
    they do not fit the scenario, and JobError if a job fails.
    """
    try:
        if options.states:
            calibration = known_states(scenario, *options.states)
            save_or_rescue(calibration.save, options.output)
            print(f'{options.output}: calibration {calibration.id}')
            return
        pilots = [_arrays(options, scenario)] if pilots is None else pilots
        with unfinished(options.output, options) as workers:
            if options.board is not None:
                _compare(scenario, pilots, workers, options)
            elif options.multipath:
                _survey(scenario, pilots, workers, options)
            else:
                found = PilotWork(workers, scenario, pilots).estimate(multipath=False)
                save_or_rescue(lambda path: write_whole(path, found.archive), options.output)
                calibration = Calibration.load(options.output)
                print(report(calibration, scenario), flush=True)
                _print_errors(found)
                print(f'{options.output}: calibration {calibration.id}')
    except JobError as error:
        raise JobError(f'{error}; repeat the command to resume') from None
    except ValueError as error:
        raise CalibrationError(str(error)) from None


def _compare(scenario: Scenario, pilots: Sequence[Pilots], workers: Workers,
             options: argparse.Namespace) -> None:
    """Print the evidence of boards, and fit parameters of the best one."""
    work = PilotWork(workers, scenario, pilots)
    boards = [*dict.fromkeys([scenario.board, *options.board])]
    found = dict(zip(boards, work.evidence([board.plain for board in boards]), strict=True))
    best = max(found, key=lambda board: found[board])
    for board, value in sorted(found.items(), key=lambda item: -item[1]):
        print(f'{_board_text(board.plain)}: log evidence {value - found[best]:.1f}', flush=True)
    if options.fit:
        fit = work.fit(best.plain, options.fit)
        std = np.sqrt(np.diagonal(fit['covariance']))
        for name, value, deviation, row in zip(
                fit['names'], fit['values'], std, fit['covariance'], strict=True):
            print(f'{name}: {value:.8g} +- {deviation:.3g}; row of the covariance: '
                  f'{", ".join(f"{entry:.3g}" for entry in row)}')
        gain = fit['log_evidence'] - found[best]
        print(f'log evidence {gain:.1f} with the line "board: {_board_text(fit["board"])}" in the '
              'scenario file')


def _board_text(plain: object) -> str:
    return yaml.safe_dump(plain, default_flow_style=True, width=10**6).split('\n')[0]


def _arrays(options: argparse.Namespace, scenario: Scenario) -> Pilots:
    """Return the pilots in a file with the arrays ``positions`` and ``received``."""
    arrays = read_arrays(options.file)
    for name in ('positions', 'received'):
        if name not in arrays:
            raise ArchiveError(f'{options.file}: {name}: missing, expected an array of this name')
    codebook = Codebook.load(options.codebook or default_codebook_file(), scenario)
    return Pilots(codebook, arrays['positions'], arrays['received'])


def _survey(scenario: Scenario, pilots: Sequence[Pilots], workers: Workers,
            options: argparse.Namespace) -> None:
    """Estimate the multipath from pilots with the codebook that was used at the most places."""
    group = max(pilots, key=lambda group: len(
        places_of(scenario, group.positions, PLACE_WAVELENGTHS)))
    n_other = sum(len(one.positions) for one in pilots) - len(group.positions)
    if n_other:
        print(f'{n_other} pilots with other codebooks have no effect')
    load_surface(str(options.calibration or ''), scenario)
    found = PilotWork(workers, scenario, [group]).estimate(True, options.calibration)
    save_or_rescue(lambda path: write_whole(path, found.archive), options.output)
    estimate = MultipathEstimate.load(str(options.output))
    print(survey_report(estimate), flush=True)
    _print_errors(found)
    print(f'{options.output}: multipath {estimate.digest}; use it with the line '
          f'"multipath: {options.output.name}" in a scenario file beside it')


def _print_errors(found: Found) -> None:
    """Print position errors at places that were left out, before and after a calibration."""
    for text, every in (('before', found.before_m), ('after', found.after_m)):
        fixes = every[np.isfinite(every)]
        rms = f'{np.sqrt(np.mean(fixes**2)):.3f} m rms' if len(fixes) else 'none'
        print(f'position error of left-out pilots {text}: {rms}, {len(every) - len(fixes)} of '
              f'{len(every)} without a fix', flush=True)
    if found.is_worse:
        print('warning: significantly more left-out pilots are located worse after it than better',
              flush=True)


def _states(text: str) -> tuple[complex, ...]:
    try:
        states = tuple(complex(word) for word in text.split(','))
    except ValueError:
        states = ()
    if len(states) != 2 or not np.isfinite(states).all():
        raise argparse.ArgumentTypeError(f'{text!r}, expected two numbers such as 1,-1')
    return states


def conflict(options: argparse.Namespace) -> str:
    """Return an error if options contradict each other, otherwise ''."""
    options.output = options.output or _OUTPUT
    if options.states and (others := given(options, ('file', 'codebook', 'jobs', 'dask'))):
        return f'argument --states: not allowed with {others}'
    if options.calibration and not options.multipath:
        return 'argument --calibration: expected together with --multipath'
    if options.fit and options.board is None:
        return 'argument --fit: expected together with --board'
    return ''


def given(options: argparse.Namespace, names: Sequence[str]) -> str:
    """Return those of some options that are given, separated by commas."""
    return ', '.join(name for name in names if getattr(options, name) not in (None, False, -1))


def add_options(parser: argparse.ArgumentParser, sources: str = '') -> None:
    """Add the options of the command; `sources` describes further sources of pilots."""
    add = parser.add_argument
    add('file', type=input_path, nargs='?',
        help=f'{sources}{ARRAYS} file with the arrays positions [N, 3] (m) and received '
        '[N, N_B, N_SB F], by default received with the default codebook')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--multipath', action='store_true',
        help='estimate the multipath of the hall instead of the surface, which --calibration '
        'describes')
    what.add_argument('--states', type=_states, metavar='OFF,ON',
        help='write a surface whose elements have these coefficients for 0 and 1, such as 1,-1 or '
        '0.5+0.1j,-0.6, without an estimation')
    what.add_argument('--board', type=typed(lambda text: board_of(parse_yaml(text))), nargs='*',
        metavar='BOARD',
        help='compare the board of the scenario with others by their evidence, such as paper or '
        '"{kind: resonant, quality_factor: 30}", instead of calibrating its elements')
    add('--fit', nargs='+', metavar='FIELD',
        help='fields of the most probable board to estimate, such as quality_factor')
    add('--output', type=output_file, metavar='FILE',
        help=f'file to write (default: {_OUTPUT})')
    add_files(parser, 'config', 'codebook', 'calibration', 'system')
    add_run_options(parser)
