"""``scripts/calibrate``: estimates a surface, or the multipath, from pilots at known positions.

The pilots come from a recording or a running network whose users publish their true positions, or
from arrays in a file. Poses of the surfaces of a site are estimated from users at unknown
positions.
"""

import argparse
import functools
import itertools
import posixpath
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import yaml
from rclpy.node import Node

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
from rhs_isac_ros.model.board import Board
from rhs_isac_ros.model.boards import board_of
from rhs_isac_ros.model.geometry import stands_still
from rhs_isac_ros.monitoring.cycle_log import SignalLog
from rhs_isac_ros.positioning import Sighting, Site
from rhs_isac_ros.positioning.alignment import PoseError, estimate_pose
from rhs_isac_ros.positioning.site import SiteError, site_text
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.fusion import sighting_of
from rhs_isac_ros.ros.endpoints import subscribe_messages
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.ros.recording import RecordingError, read_networks
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    output_file,
    positive_float,
    positive_int,
)
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.files import (
    ArchiveError,
    parse_yaml,
    read_arrays,
    save_or_rescue,
    write_whole,
)
from rhs_isac_ros.support.job_commands import add_run_options, unfinished
from rhs_isac_ros.support.jobs import JobError, Workers
from rhs_isac_ros.tools import command

# The messages that pilots consist of.
_RECEIVES = (m.GroundTruth, m.ReceivedSignals)
_CYCLES = 200
_OUTPUT, _SITE_OUTPUT = Path('calibration.npz'), Path('site_calibrated.yaml')
_TIMEOUT_S = 600.0


class PilotLog(SignalLog):
    """Collects pilots, also of cycles without a fix, which may require the calibration.

    Users have to stand still: the pilots of a cycle have one position.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__()
        self._scenario = scenario

    @property
    def n_pilots(self) -> int:
        """Number of pilots whose position and codebook are known."""
        return len(self._known())

    @property
    def missing_codebooks(self) -> list[str]:
        """Ids of unknown codebooks with which signals were received."""
        return sorted({signals.codebook_id for signals in self.signals.values()}
                      - self.codebooks.keys())

    def pilots(self) -> list[Pilots]:
        """Return the pilots whose position and codebook are known, grouped by codebook."""
        groups: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for signals, truth in self._known():
            groups.setdefault(signals.codebook_id, []).append(
                (self._scenario.pose.to_surface(truth.position), signals.stacked))
        return [Pilots(self.codebooks[codebook_id], *map(np.array, zip(*group, strict=True)))
                for codebook_id, group in groups.items()]

    @property
    def n_moving(self) -> int:
        """Number of cycles that are left out because their users moved too far."""
        return sum(not self._is_at_rest(truth) for signals in self.signals.values()
                   if (truth := self.truths.of(signals)))

    def _is_at_rest(self, truth: m.GroundTruth) -> bool:
        return stands_still(self._scenario, float(np.linalg.norm(truth.velocity)))

    def _known(self) -> list[tuple[m.ReceivedSignals, m.GroundTruth]]:
        return [(signals, truth) for signals in self.signals.values()
                if (truth := self.truths.of(signals)) and signals.codebook_id in self.codebooks
                and self._is_at_rest(truth)]


class CalibratorNode(Node):
    """Collects the pilots of a running network."""

    def __init__(self, log: PilotLog, scenario: Scenario) -> None:
        super().__init__('calibrator', **WITHOUT_SERVICES)
        subscribe_messages(self, _RECEIVES, scenario, log.add, on_foreign=lambda message: None)
        command.subscribe_codebooks(self, scenario, log.add)


class PosteriorLog:
    """Collects the posteriors of the surfaces of a site, by cycle and user."""

    def __init__(self, site: Site) -> None:
        self._names = [*site.surfaces]
        self._found: dict[tuple[int, int], dict[str, Sighting]] = {}

    def add(self, name: str, message: m.Message, *_: object) -> None:
        """Add a posterior of a surface."""
        assert isinstance(message, m.Posterior)
        self._found.setdefault((message.cycle_id, message.user), {})[name] = sighting_of(message)

    def pairs(self, one: str, other: str) -> tuple[list[Sighting], list[Sighting]]:
        """Return the sightings by both surfaces of users that they located in one cycle."""
        both = [found for found in self._found.values() if {one, other} <= found.keys()]
        return [found[one] for found in both], [found[other] for found in both]

    @property
    def n_pairs(self) -> int:
        """Smallest number of users that the first surface and another one located together."""
        first, *others = self._names
        return min(len(self.pairs(first, other)[0]) for other in others)


class AlignerNode(Node):
    """Collects the posteriors in the namespaces of the surfaces of a running site."""

    def __init__(self, log: PosteriorLog, site: Site) -> None:
        super().__init__('calibrator', **WITHOUT_SERVICES)
        for name, one in site.surfaces.items():
            subscribe_messages(
                self, [m.Posterior], one.scenario, functools.partial(log.add, name),
                on_foreign=lambda message: None, prefix=f'{name}/')


def _collect(make: Callable[[], Node], count: Callable[[], int], what: str,
             options: argparse.Namespace, arguments: list[str]) -> None:
    """Spin a node until `count` has reached the number in the options, or raise ToolError."""
    end_s = time.monotonic() + options.timeout
    command.observe(
        make, arguments, lambda _: count() >= options.cycles or time.monotonic() > end_s)
    if count() < options.cycles:
        raise command.none_within(f'{count()} of {options.cycles} {what}', options.timeout)


def _align(options: argparse.Namespace, arguments: list[str]) -> int:
    """Estimate the poses of all surfaces of a site but the first, and write a site file."""
    site = Site.from_yaml(options.site)
    if len(site.surfaces) < 2:
        raise SiteError(f'{options.site}: surfaces: one, expected at least two')
    log = PosteriorLog(site)
    _collect(lambda: AlignerNode(log, site), lambda: log.n_pairs,
             'users located by two surfaces', options, arguments)
    first, *others = site.surfaces
    poses = {}
    for name in others:
        try:
            pose = estimate_pose(*log.pairs(first, name), site.bounds_m)
        except PoseError as error:
            raise SiteError(f'{name}: {error}') from None
        change = site.surfaces[name].pose.error_of(pose)
        std = np.sqrt(np.diagonal(pose.covariance))
        print(f'{name}: moved by {change[:3].round(3)} m, turned by '
              f'{np.degrees(change[3:]).round(2)} deg; standard deviations {std[:3].round(3)} m, '
              f'{np.degrees(std[3:]).round(2)} deg', flush=True)
        poses[name] = pose
    save_or_rescue(
        lambda path: write_whole(path, site_text(options.site, poses, path.parent)),
        options.output)
    print(options.output)
    return 0


def _calibrate(options: argparse.Namespace, arguments: list[str]) -> int:
    if options.site:
        return _align(options, arguments)
    has_arrays = options.file and options.file.suffix == '.npz'
    try:
        scenario = command.choose_scenario(
            options.config, None if has_arrays else options.file, options.namespace)
        if options.states:
            if options.file:
                raise CalibrationError(f'{options.file}: expected no file with --states')
            return _save(known_states(scenario, *options.states), options.output)
        pilots = ([_arrays(options, scenario)] if has_arrays
                  else _collected(options, scenario, arguments))
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
        return 0
    except JobError as error:
        raise command.ToolError(f'{error}; repeat the command to resume') from None
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


def _save(calibration: Calibration, output: Path) -> int:
    save_or_rescue(calibration.save, output)
    print(f'{output}: calibration {calibration.id}')
    return 0


def _arrays(options: argparse.Namespace, scenario: Scenario) -> Pilots:
    """Return the pilots in a file with the arrays ``positions`` and ``received``."""
    arrays = read_arrays(options.file)
    for name in ('positions', 'received'):
        if name not in arrays:
            raise ArchiveError(f'{options.file}: {name}: missing, expected an array of this name')
    codebook = Codebook.load(options.codebook or default_codebook_file(), scenario)
    return Pilots(codebook, arrays['positions'], arrays['received'])


def _collected(
        options: argparse.Namespace, scenario: Scenario, arguments: list[str]) -> list[Pilots]:
    log = PilotLog(scenario)
    if options.file:
        # Only the leading surface of a site records true positions, in the frame of the site.
        others = read_networks(options.file).surfaces
        for found, _ in itertools.chain(
                command.recorded(
                    options.file, options.namespace, scenario, [*_RECEIVES, Codebook]),
                *(command.recorded(options.file, posixpath.join(posixpath.dirname(
                    options.namespace.rstrip('/')), name), other, [m.GroundTruth])
                  for name, other in others.items())):
            log.add(found)
    else:
        _collect(lambda: command.expecting_cycles(CalibratorNode(log, scenario)),
                 lambda: log.n_pilots, 'pilots', options, arguments)
    if options.codebook:
        codebook = Codebook.load(options.codebook, scenario)
        log.codebooks.update(dict.fromkeys(log.missing_codebooks, codebook))
    source = options.file or 'network'
    if log.missing_codebooks:
        raise command.missing_codebook(source, log.missing_codebooks[0])
    if log.n_moving:
        print(f'calibrate: {source}: {log.n_moving} cycles of users who moved are left out',
              file=sys.stderr)
    if not (pilots := log.pilots()):
        what = 'received signals with a true position'
        raise (command.nothing_recorded(options.file, what, options.namespace) if options.file
               else RecordingError(f'network: no {what}'))
    return pilots


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


def _board(text: str) -> Board:
    with translated(ValueError, argparse.ArgumentTypeError):
        return board_of(parse_yaml(text))


def _states(text: str) -> tuple[complex, ...]:
    try:
        states = tuple(complex(word) for word in text.split(','))
    except ValueError:
        states = ()
    if len(states) != 2 or not np.isfinite(states).all():
        raise argparse.ArgumentTypeError(f'{text!r}, expected two numbers such as 1,-1')
    return states


def _conflict(options: argparse.Namespace) -> str:
    if (options.site or options.states) and (options.jobs != -1 or options.dask):
        return 'arguments --jobs and --dask: not allowed with --site or --states'
    options.output = options.output or (_SITE_OUTPUT if options.site else _OUTPUT)
    others = [name for name in (
        'file', 'multipath', 'states', 'board', 'system', 'config', 'codebook', 'calibration',
        'namespace')
        if getattr(options, name) not in (None, False, '/')]
    if options.site and others:
        return f'argument --site: not allowed with {", ".join(others)}'
    if options.calibration and not options.multipath:
        return 'argument --calibration: expected together with --multipath'
    if options.fit and options.board is None:
        return 'argument --fit: expected together with --board'
    if options.states and options.codebook:
        return 'argument --codebook: not allowed with --states'
    if options.namespace != '/' and not options.file:
        return command.NO_NAMESPACE
    if (options.file or options.states) and (options.cycles, options.timeout) != (
            _CYCLES, _TIMEOUT_S):
        return 'arguments --cycles and --timeout: expected for a running network'
    return ''


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='calibrate', description='Estimate errors and failures of the elements, and gains '
        'and phases of the bands, or the covariance of the multipath, from signals of users at '
        'known positions. Without a file, the signals come from a running network.')
    add = parser.add_argument
    add('file', type=input_file, nargs='?',
        help='recording made with record, or .npz file with the arrays positions [N, 3] (m) and '
        'received [N, N_B, N_SB F], by default received with the default codebook')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--multipath', action='store_true',
        help='estimate the multipath of the hall instead of the surface, which --calibration '
        'describes')
    what.add_argument('--states', type=_states, metavar='OFF,ON',
        help='write a surface whose elements have these coefficients for 0 and 1, such as 1,-1 or '
        '0.5+0.1j,-0.6, without an estimation')
    what.add_argument('--board', type=_board, nargs='*', metavar='BOARD',
        help='compare the board of the scenario with others by their evidence, such as paper or '
        '"{kind: resonant, quality_factor: 30}", instead of calibrating its elements')
    add('--fit', nargs='+', metavar='FIELD',
        help='fields of the most probable board to estimate, such as quality_factor')
    add('--site', type=input_file, metavar='FILE',
        help='estimate the poses of the surfaces of a running site, except for the first one, '
        'from users that two surfaces locate; write a site file')
    add('--output', type=output_file, metavar='FILE',
        help=f'file to write (default: {_OUTPUT}, or {_SITE_OUTPUT} with --site)')
    command.add_files(parser, 'config', 'codebook', 'calibration', 'system')
    add('--namespace', default='/', help='namespace of the recorded network (default: /)')
    add('--cycles', type=positive_int, default=_CYCLES, metavar='N',
        help='pilots, or users that two surfaces locate, to collect from a running network '
        f'(default: {_CYCLES})')
    add('--timeout', type=positive_float, default=_TIMEOUT_S, metavar='S',
        help=f'maximum time to collect the pilots (default: {_TIMEOUT_S:g} s)')
    add_run_options(parser)
    return parser


main = command.entry(_calibrate, _parser, _conflict)
