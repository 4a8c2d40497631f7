"""``scripts/calibrate``: estimates a surface, or the multipath, from pilots at known positions.

The pilots are the received signals of a recording, or of a running network, whose users
publish their true positions, or arrays in a file.
"""

import argparse
import dataclasses
import os
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rclpy.node import Node

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.calibration import (
    CalibrationError,
    Pilots,
    SurfacePrior,
    SurveyWarning,
    calibrate,
    load_surface,
    prior_of,
    report,
    survey,
    survey_report,
)
from rhs_isac_ros.codebook import Codebook, CodebookError, default_codebook_file
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import LATCHED, subscribe, subscribe_messages
from rhs_isac_ros.ros.recording import RecordingError, read, read_scenario
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.ros.startup import WITHOUT_SERVICES
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    integer,
    nonnegative_float,
    output_file,
    positive_float,
    positive_int,
)
from rhs_isac_ros.support.files import ArchiveError, read_arrays
from rhs_isac_ros.tools.command import ToolError, run_command
from rhs_isac_ros.tools.replay import topic_prefix

# Messages that the log needs.
RECEIVES = (m.GroundTruth, m.ReceivedSignals)


class PilotLog:
    """Collects received signals, the true positions of their users, and codebooks.

    Unlike in a `CycleLog`, cycles without a fix count: before a calibration, there may be no
    others.

    Parameters
    ----------
    user
        The only user whose signals are collected; 0 for all users.
    """

    def __init__(self, scenario: Scenario, user: int = 0) -> None:
        self._scenario, self._user = scenario, user
        self._truths: dict[tuple[int, int], list[m.GroundTruth]] = {}
        self._signals: dict[int, m.ReceivedSignals] = {}
        self._codebooks: dict[str, Codebook] = {}

    def add(self, message: m.Message) -> None:
        """Add a message of one of the types `RECEIVES`."""
        match message:
            case m.GroundTruth() if message.cycle_id:
                self._truths.setdefault((message.cycle_id, message.user), []).append(message)
            case m.ReceivedSignals() if self._user in (0, message.user):
                self._signals.setdefault(message.cycle_id, message)

    def add_codebook(self, codebook: Codebook, codebook_id: str = '') -> None:
        """Add a codebook; another one may be assumed for signals with an id.

        Raises
        ------
        CodebookError
            If the codebook does not fit the scenario.
        """
        codebook.check(self._scenario)
        self._codebooks[codebook_id or codebook.id] = codebook

    @property
    def n_signals(self) -> int:
        """Number of phases whose signals were received."""
        return len(self._signals)

    @property
    def n_pilots(self) -> int:
        """Number of pilots whose position and codebook are known."""
        return sum(len(group.positions) for group in self.pilots())

    @property
    def missing_codebooks(self) -> list[str]:
        """Ids of codebooks that are not known, although signals were received with them."""
        return sorted({signals.codebook_id for signals in self._signals.values()}
                      - self._codebooks.keys())

    def pilots(self) -> list[Pilots]:
        """Return the pilots of each codebook."""
        groups: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for signals in self._signals.values():
            truth = self._truth_of(signals)
            if truth is not None and signals.codebook_id in self._codebooks:
                groups.setdefault(signals.codebook_id, []).append(
                    (truth.position, signals.signals.reshape(len(signals.signals), -1)))
        return [Pilots(self._codebooks[codebook_id], *map(np.array, zip(*group, strict=True)))
                for codebook_id, group in groups.items()]

    def _truth_of(self, signals: m.ReceivedSignals) -> m.GroundTruth | None:
        known = self._truths.get((signals.cycle_id, signals.user), [])
        return next((truth for truth in reversed(known)
                     if m.same_instance(truth.sender, signals.user_instance)), None)


_CYCLES = 200
_TIMEOUT_S = 600.0
# Pilots whose positions are estimated for comparison.
_N_COMPARED = 200


class CalibratorNode(Node):
    """Collects the pilots of a running network."""

    def __init__(self, log: PilotLog, scenario: Scenario) -> None:
        super().__init__('calibrator', **WITHOUT_SERVICES)
        self._log = log
        subscribe_messages(self, RECEIVES, scenario.sizes, log.add, scenario_id=scenario.id)
        subscribe(self, ros.Codebook, topics.CODEBOOK, self._on_codebook, LATCHED)

    def _on_codebook(self, message: ros.Codebook) -> None:
        try:
            self._log.add_codebook(convert.codebook_from_ros(message))
        except (m.MessageError, CodebookError) as error:
            self.get_logger().warning(  # type: ignore[no-untyped-call]
                f'dropped codebook: {error}')


def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrate, print the result and write the file; 1 if there were too few pilots in time."""
    return run_command(
        _calibrate, _parser(), arguments, ['file', '--config', '--codebook', '--calibration'],
        ['--output'])


def _calibrate(options: argparse.Namespace, arguments: list[str]) -> int:
    try:
        scenario = _scenario(options)
        pilots = _pilots(options, scenario, arguments)
        if options.multipath:
            _survey(scenario, pilots, options)
            return 0
        calibration = calibrate(scenario, pilots, _prior(scenario, options))
        print(report(calibration, scenario), flush=True)
        for text, surface in (('before', None), ('after', calibration.surface)):
            print(f'position error of the pilots {text}: {_error(scenario, pilots, surface)}')
        calibration.save(options.output)
    except ValueError as error:
        raise CalibrationError(str(error)) from None
    print(f'{options.output}: calibration {calibration.id}')
    return 0


def _pilots(
        options: argparse.Namespace, scenario: Scenario, arguments: list[str]) -> list[Pilots]:
    """Return the pilots of a file, or of a running network."""
    if options.file and options.file.suffix == '.npz':
        return [_arrays(options)]
    log = PilotLog(scenario, options.user)
    if options.file:
        _read(options, scenario, log)
    elif not _listen(options, scenario, log, arguments):
        raise ToolError(
            f'{log.n_pilots} pilots within {options.timeout:g} s, expected '
            f'{options.cycles}, in the domain {os.environ.get("ROS_DOMAIN_ID", "0")} and '
            'this namespace')
    return _checked(log, options)


def _survey(scenario: Scenario, pilots: Sequence[Pilots], options: argparse.Namespace) -> None:
    """Estimate the multipath from the codebook with the most pilots."""
    group = max(pilots, key=lambda group: len(group.positions))
    n_other = sum(len(one.positions) for one in pilots) - len(group.positions)
    if n_other:
        print(f'{n_other} pilots with other codebooks have no effect')
    surface = load_surface(str(options.calibration or ''), scenario)
    with warnings.catch_warnings():
        # The report contains them.
        warnings.simplefilter('ignore', SurveyWarning)
        estimate = survey(scenario, group.beams, group.positions, group.received, surface)
    print(survey_report(estimate), flush=True)
    measured = dataclasses.replace(scenario, multipath=estimate)
    for text, known in (('before', scenario), ('after', measured)):
        print(f'position error of the pilots {text}: {_error(known, [group], surface)}')
    estimate.save(options.output)
    print(f'{options.output}: multipath {estimate.digest}; use it with the line '
          f'"multipath: {options.output.name}" in a scenario file beside it')


def _arrays(options: argparse.Namespace) -> Pilots:
    """Return the pilots of a file with the arrays ``positions`` and ``received``."""
    arrays = read_arrays(options.file)
    for name in ('positions', 'received'):
        if name not in arrays:
            raise ArchiveError(f'{options.file}: {name}: missing, expected an array of this name')
    codebook = Codebook.load(options.codebook or default_codebook_file())
    return Pilots(codebook, arrays['positions'], arrays['received'])


def _scenario(options: argparse.Namespace) -> Scenario:
    if options.config:
        return Scenario.from_yaml(options.config)
    is_recording = options.file and options.file.suffix != '.npz'
    return (read_scenario(options.file) if is_recording else None) or Scenario()


def _prior(scenario: Scenario, options: argparse.Namespace) -> SurfacePrior:
    given = {'element_error_rms': options.element_error_rms,
             'failed_element_share': options.failed_element_share,
             'band_gain_rms': options.band_gain_rms}
    return dataclasses.replace(
        prior_of(scenario), **{name: value for name, value in given.items() if value is not None})


def _read(options: argparse.Namespace, scenario: Scenario, log: PilotLog) -> None:
    """Add the pilots of a recording."""
    prefix = topic_prefix(options.namespace)
    kinds = {f'{prefix}{topics.NAMES[kind]}': kind for kind in RECEIVES}
    codebook_topic = f'{prefix}{topics.CODEBOOK}'
    for topic, message, _ in read(options.file, [*kinds, codebook_topic]):
        try:
            if topic == codebook_topic:
                log.add_codebook(convert.codebook_from_ros(message))
            else:
                plain = convert.from_ros(kinds[topic], message)
                m.check(plain, scenario.sizes)
                log.add(plain)
        except (m.MessageError, CodebookError) as error:
            raise RecordingError(f'{options.file}: {topic}: {error}') from None


def _listen(options: argparse.Namespace, scenario: Scenario, log: PilotLog,
            arguments: Sequence[str]) -> bool:
    """Collect pilots of a running network; return whether there are enough."""
    end_s = time.monotonic() + options.timeout
    run(lambda: [CalibratorNode(log, scenario)], arguments,
        lambda: log.n_signals >= options.cycles and log.n_pilots >= options.cycles
        or time.monotonic() > end_s)
    return log.n_pilots >= int(options.cycles)


def _checked(log: PilotLog, options: argparse.Namespace) -> list[Pilots]:
    """Return the pilots, or raise RecordingError if there are none or a codebook is missing."""
    if options.codebook:
        codebook = Codebook.load(options.codebook)
        for codebook_id in log.missing_codebooks:
            log.add_codebook(codebook, codebook_id)
    source = options.file or 'network'
    if log.missing_codebooks:
        raise RecordingError(f'{source}: codebook {log.missing_codebooks[0]}: not in the '
                             'recording; give its file with --codebook FILE')
    pilots = log.pilots()
    if not pilots:
        raise RecordingError(
            f'{source}: no received signals with a true position, expected at least one in the '
            f'namespace {options.namespace}')
    return pilots


def _error(scenario: Scenario, pilots: Sequence[Pilots], surface: SurfaceEstimate | None) -> str:
    """Return root mean square error and number of missing fixes as text."""
    errors: list[np.ndarray] = []
    left = _N_COMPARED
    for group in pilots:
        if not isinstance(group.beams, Codebook) or not left:
            continue
        estimator = make_estimator('bayes', scenario, group.beams, surface=surface)
        estimate = estimator.estimate(group.received[:left])
        errors.append(np.linalg.norm(estimate.mean - group.positions[:left], axis=1))
        left -= len(errors[-1])
    distances = np.concatenate(errors)
    fixes = distances[np.isfinite(distances)]
    rms = f'{np.sqrt(np.mean(fixes**2)):.3f} m rms' if len(fixes) else 'none'
    return f'{rms}, {len(distances) - len(fixes)} of {len(distances)} without a fix'


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='calibrate', description='Estimate errors and failures of the elements, and gains '
        'and phases of the bands, or the covariance of the multipath, from signals of users at '
        'known positions. Without a file, the signals are those of a running network; ROS '
        'arguments select its namespace: --ros-args -r __ns:=/lab')
    add = parser.add_argument
    add('file', type=input_file, nargs='?',
        help='recording made with record, or .npz file with the arrays positions [N, 3] (m) and '
        'received [N, N_B, N_SB F]')
    add('--multipath', action='store_true',
        help='estimate the multipath of the hall instead of the surface')
    add('--calibration', type=input_file, metavar='FILE',
        help='calibrated surface to assume with --multipath')
    add('--output', type=output_file, default=Path('calibration.npz'), metavar='FILE',
        help='calibration or multipath to write (default: calibration.npz)')
    add('--config', type=input_file, metavar='FILE',
        help="scenario file; by default the recorded scenario, or the paper's Table I")
    add('--codebook', type=input_file, metavar='FILE',
        help='codebook to assume if the recording contains none; of arrays, by default the '
        'default one')
    add('--user', type=integer(0), default=0, metavar='ID',
        help='use only the signals of this user (default: of all users)')
    add('--namespace', default='/', help='namespace of the recorded network (default: /)')
    add('--cycles', type=positive_int, default=_CYCLES, metavar='N',
        help=f'pilots to collect from a running network (default: {_CYCLES})')
    add('--timeout', type=positive_float, default=_TIMEOUT_S, metavar='S',
        help=f'maximum time to collect them (default: {_TIMEOUT_S:g} s)')
    prior = parser.add_argument_group(
        'prior', 'What is known of the surface before; by default what the scenario declares.')
    for name, text in (
            ('--element-error-rms', 'RMS of the relative errors of the elements'),
            ('--failed-element-share', 'probability that an element has failed'),
            ('--band-gain-rms', "RMS of the relative errors of the bands' gains (default: 1)")):
        prior.add_argument(name, type=nonnegative_float, metavar='X', help=text)
    return parser


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
