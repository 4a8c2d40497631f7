"""``scripts/calibrate``: estimates a surface, or the multipath, from pilots at known positions.

The pilots come from a recording or a running network whose users publish their true positions, or
from arrays in a file.
"""

import argparse
import dataclasses
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rclpy.node import Node

from rhs_isac_ros.calibration import (
    CalibrationError,
    Pilots,
    SurveyWarning,
    calibrate,
    load_surface,
    report,
    survey,
    survey_report,
)
from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.endpoints import subscribe_messages
from rhs_isac_ros.ros.recording import RecordingError
from rhs_isac_ros.ros.startup import WITHOUT_SERVICES
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    integer,
    output_file,
    positive_float,
    positive_int,
)
from rhs_isac_ros.support.files import ArchiveError, read_arrays
from rhs_isac_ros.tools import command

# Types of the messages that the log uses.
RECEIVES = (m.GroundTruth, m.ReceivedSignals)
_CYCLES = 200
_TIMEOUT_S = 600.0
# Maximum number of pilots whose errors before and after the calibration are compared.
_N_COMPARED = 200


class PilotLog:
    """Collects codebooks, and signals and true positions of one user, or of all if `user` is 0.

    Unlike `CycleLog`, it keeps cycles without a fix, because a fix may require the calibration.
    """

    def __init__(self, user: int = 0) -> None:
        self._user = user
        self._truths: dict[tuple[int, int], list[m.GroundTruth]] = {}
        self._signals: dict[int, m.ReceivedSignals] = {}
        self.codebooks: dict[str, Codebook] = {}

    def add(self, found: m.Message | Codebook) -> None:
        """Add a codebook, or a message whose type is in `RECEIVES`."""
        match found:
            case Codebook():
                self.codebooks[found.id] = found
            case m.GroundTruth() if found.cycle_id:
                self._truths.setdefault((found.cycle_id, found.user), []).append(found)
            case m.ReceivedSignals() if self._user in (0, found.user):
                self._signals.setdefault(found.cycle_id, found)

    def has_pilots(self, n: int) -> bool:
        """Return whether the positions and codebooks of at least `n` pilots are known."""
        # Counting the signals is quicker, so it comes first.
        return len(self._signals) >= n and self.n_pilots >= n

    @property
    def n_pilots(self) -> int:
        """Number of pilots whose position and codebook are known."""
        return sum(len(group.positions) for group in self.pilots())

    @property
    def missing_codebooks(self) -> list[str]:
        """Ids of unknown codebooks with which signals were received."""
        return sorted({signals.codebook_id for signals in self._signals.values()}
                      - self.codebooks.keys())

    def pilots(self) -> list[Pilots]:
        """Return the pilots whose position and codebook are known, grouped by codebook."""
        groups: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for signals in self._signals.values():
            truth = self._truth_of(signals)
            if truth is not None and signals.codebook_id in self.codebooks:
                groups.setdefault(signals.codebook_id, []).append(
                    (truth.position, signals.signals.reshape(len(signals.signals), -1)))
        return [Pilots(self.codebooks[codebook_id], *map(np.array, zip(*group, strict=True)))
                for codebook_id, group in groups.items()]

    def _truth_of(self, signals: m.ReceivedSignals) -> m.GroundTruth | None:
        known = self._truths.get((signals.cycle_id, signals.user), [])
        return next((truth for truth in reversed(known)
                     if m.same_instance(truth.sender, signals.user_instance)), None)


class CalibratorNode(Node):
    """Collects the pilots of a running network."""

    def __init__(self, log: PilotLog, scenario: Scenario) -> None:
        super().__init__('calibrator', **WITHOUT_SERVICES)
        subscribe_messages(self, RECEIVES, scenario.sizes, log.add, scenario_id=scenario.id)
        command.subscribe_codebooks(self, scenario, log.add)


def _calibrate(options: argparse.Namespace, arguments: list[str]) -> int:
    has_arrays = options.file and options.file.suffix == '.npz'
    try:
        scenario = command.choose_scenario(options.config, None if has_arrays else options.file)
        pilots = ([_arrays(options)] if has_arrays
                  else _collected(options, scenario, arguments))
        if options.multipath:
            _survey(scenario, pilots, options)
            return 0
        calibration = calibrate(scenario, pilots)
        print(report(calibration, scenario), flush=True)
        for text, surface in (('before', None), ('after', calibration.surface)):
            print(f'position error of the pilots {text}: {_error(scenario, pilots, surface)}')
        calibration.save(options.output)
    except ValueError as error:
        raise CalibrationError(str(error)) from None
    print(f'{options.output}: calibration {calibration.id}')
    return 0


def _arrays(options: argparse.Namespace) -> Pilots:
    """Return the pilots in a file with the arrays ``positions`` and ``received``."""
    arrays = read_arrays(options.file)
    for name in ('positions', 'received'):
        if name not in arrays:
            raise ArchiveError(f'{options.file}: {name}: missing, expected an array of this name')
    codebook = Codebook.load(options.codebook or default_codebook_file())
    return Pilots(codebook, arrays['positions'], arrays['received'])


def _collected(
        options: argparse.Namespace, scenario: Scenario, arguments: list[str]) -> list[Pilots]:
    log = PilotLog(options.user)
    if options.file:
        for found, _ in command.recorded(
                options.file, options.namespace, scenario, [*RECEIVES, Codebook]):
            log.add(found)
    else:
        end_s = time.monotonic() + options.timeout
        command.observe(
            lambda: CalibratorNode(log, scenario), arguments,
            lambda _: log.has_pilots(options.cycles) or time.monotonic() > end_s)
        if not log.has_pilots(options.cycles):
            raise command.none_within(
                f'{log.n_pilots} of {options.cycles} pilots', options.timeout)
    if options.codebook:
        codebook = Codebook.load(options.codebook)
        codebook.check(scenario)
        log.codebooks.update(dict.fromkeys(log.missing_codebooks, codebook))
    source = options.file or 'network'
    if log.missing_codebooks:
        raise RecordingError(f'{source}: codebook {log.missing_codebooks[0]}: not in the '
                             'recording; give its file with --codebook FILE')
    if not (pilots := log.pilots()):
        raise RecordingError(
            f'{source}: no received signals with a true position, expected at least one in the '
            f'namespace {options.namespace}')
    return pilots


def _survey(scenario: Scenario, pilots: Sequence[Pilots], options: argparse.Namespace) -> None:
    """Estimate the multipath from the largest group of pilots with the same codebook."""
    group = max(pilots, key=lambda group: len(group.positions))
    n_other = sum(len(one.positions) for one in pilots) - len(group.positions)
    if n_other:
        print(f'{n_other} pilots with other codebooks have no effect')
    surface = load_surface(str(options.calibration or ''), scenario)
    with warnings.catch_warnings():
        # The report contains these warnings.
        warnings.simplefilter('ignore', SurveyWarning)
        estimate = survey(scenario, group.beams, group.positions, group.received, surface)
    print(survey_report(estimate), flush=True)
    measured = dataclasses.replace(scenario, multipath=estimate)
    for text, known in (('before', scenario), ('after', measured)):
        print(f'position error of the pilots {text}: {_error(known, [group], surface)}')
    estimate.save(options.output)
    print(f'{options.output}: multipath {estimate.digest}; use it with the line '
          f'"multipath: {options.output.name}" in a scenario file beside it')


def _error(scenario: Scenario, pilots: Sequence[Pilots], surface: SurfaceEstimate | None) -> str:
    """Return the rms error and the number of missing fixes, over the first pilots, as text."""
    distances = np.empty(0)
    for group in pilots:
        left = _N_COMPARED - len(distances)
        if isinstance(group.beams, Codebook) and left:
            estimator = make_estimator('bayes', scenario, group.beams, surface=surface)
            errors = estimator.estimate(group.received[:left]).mean - group.positions[:left]
            distances = np.append(distances, np.linalg.norm(errors, axis=1))
    fixes = distances[np.isfinite(distances)]
    rms = f'{np.sqrt(np.mean(fixes**2)):.3f} m rms' if len(fixes) else 'none'
    return f'{rms}, {len(distances) - len(fixes)} of {len(distances)} without a fix'


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='calibrate', description='Estimate errors and failures of the elements, and gains '
        'and phases of the bands, or the covariance of the multipath, from signals of users at '
        'known positions. Without a file, the signals come from a running network; ROS arguments '
        'select its namespace: --ros-args -r __ns:=/lab')
    add = parser.add_argument
    add('file', type=input_file, nargs='?',
        help='recording made with record, or .npz file with the arrays positions [N, 3] (m) and '
        'received [N, N_B, N_SB F], by default received with the default codebook')
    add('--multipath', action='store_true',
        help='estimate the multipath of the hall instead of the surface, which --calibration '
        'describes')
    add('--output', type=output_file, default=Path('calibration.npz'), metavar='FILE',
        help='calibration or multipath to write (default: calibration.npz)')
    command.add_files(parser, 'config', 'codebook', 'calibration')
    add('--user', type=integer(0), default=0, metavar='ID',
        help='use only the signals of this user (default: of all users)')
    add('--namespace', default='/', help='namespace of the recorded network (default: /)')
    add('--cycles', type=positive_int, default=_CYCLES, metavar='N',
        help=f'pilots to collect from a running network (default: {_CYCLES})')
    add('--timeout', type=positive_float, default=_TIMEOUT_S, metavar='S',
        help=f'maximum time to collect the pilots (default: {_TIMEOUT_S:g} s)')
    return parser


main = command.entry(_calibrate, _parser)
