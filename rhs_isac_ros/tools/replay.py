"""``scripts/replay FILE``: feeds the received signals of a recording to estimators.

With ``--publish``, they are published again to running nodes; see
`rhs_isac_ros.tools.republish`.
"""

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.calibration import CalibrationError, load_surface
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.executables import exit_code_of, print_error
from rhs_isac_ros.model import Scenario, ScenarioError, plugins
from rhs_isac_ros.model.arguments import ArgumentParser, input_file, positive_float
from rhs_isac_ros.monitoring.cycle_log import RECEIVES, CompleteCycle, CycleLog
from rhs_isac_ros.positioning import (
    ESTIMATORS,
    BayesEstimator,
    Estimator,
    ModelError,
    Motion,
    file_options,
    make_estimator,
)
from rhs_isac_ros.positioning.store import default_folder
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.tracks import Tracks
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.command_line import parse
from rhs_isac_ros.ros.recording import RecordingError, read, read_scenario, recorded_topics
from rhs_isac_ros.tools.republish import RepublishError, republish, topic_prefix

# Topics that can be published again. The codebook is sent as a parameter instead, and diagnostics
# and announcements of nodes would contradict those of the running nodes.
_TOPICS = sorted(set(recorded_topics()) - {topics.CODEBOOK, topics.DIAGNOSTICS, topics.PRESENCE})

# Defaults of the options for running nodes.
_RATE = 1.0
_TIMEOUT_S = 60.0


@dataclasses.dataclass(frozen=True)
class Recording:
    """Complete cycles of one network, with its scenario and its codebooks by id."""

    scenario: Scenario
    cycles: list[CompleteCycle]
    codebooks: dict[str, Codebook]


def load(path: str | Path, namespace: str = '/', scenario: Scenario | None = None) -> Recording:
    """Load the cycles of a recording.

    Parameters
    ----------
    namespace
        Namespace of the network.
    scenario
        Scenario to use instead of the recorded one.

    Raises
    ------
    RecordingError
        If the file is not a recording, has no complete cycle in the namespace, or contains a
        malformed message.
    ScenarioError, CodebookError
        If the scenario or a recorded codebook is invalid.
    """
    scenario = scenario or read_scenario(path) or Scenario()
    prefix = topic_prefix(namespace)
    kinds = {f'{prefix}{topics.NAMES[kind]}': kind for kind in RECEIVES}
    log = CycleLog()
    codebooks: dict[str, Codebook] = {}
    for topic, ros_message, time_s in read(path):
        try:
            if topic in kinds:
                message = convert.from_ros(kinds[topic], ros_message)
                m.check(message, scenario.sizes)
                log.add(message, time_s)
            elif topic == f'{prefix}{topics.CODEBOOK}' and isinstance(ros_message, ros.Codebook):
                codebooks[ros_message.codebook_id] = convert.codebook_from_ros(ros_message)
        except m.MessageError as error:
            raise RecordingError(f'{path}: {topic}: {error}') from None
    if not log.complete:
        raise RecordingError(f'{path}: no complete cycle in the namespace {namespace}')
    return Recording(scenario, log.complete, codebooks)


def errors_m(cycles: Sequence[CompleteCycle], estimators: Mapping[str, Estimator]) -> np.ndarray:
    """Estimate the position of every cycle again, and return the errors.

    Parameters
    ----------
    cycles
        Complete cycles, with their received signals and true positions.
    estimators
        Estimators by the id of the codebook with which the signals were received.

    Returns
    -------
    numpy.ndarray
        Distances from the true positions, float64 [len(cycles)] [m]; NaN without a fix.
    """
    errors = []
    for cycle in cycles:
        signals = cycle.signals.signals
        estimate = estimators[cycle.signals.codebook_id].estimate(
            signals.reshape(len(signals), -1))
        errors.append(np.linalg.norm(estimate.mean - cycle.truth.position)
                      if estimate.fix else np.nan)
    return np.array(errors)


def tracked_errors_m(
        cycles: Sequence[CompleteCycle], estimators: Mapping[str, Estimator],
        speed_mps: float = Motion.speed_mps) -> np.ndarray:
    """Track the users over the cycles, and return the errors; see `errors_m`.

    Parameters
    ----------
    speed_mps
        Typical speed of the users [m/s].
    """
    tracks, errors = Tracks(), []
    for cycle in cycles:
        estimate = tracks.locate(
            cycle.signals, estimators[cycle.signals.codebook_id], speed_mps,
            cycle.phase_s.get(m.Phase.ESTIMATING, cycle.ended_s))
        errors.append(np.linalg.norm(estimate.mean - cycle.truth.position)
                      if estimate.fix else np.nan)
    return np.array(errors)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the recorded position errors and those of estimators applied to the same signals.

    Parameters
    ----------
    arguments
        Command line including ROS arguments; by default that of the process.

    Returns
    -------
    int
        Exit code: 0, including after a signal; 1 if the signals cannot be published to running
        nodes; 2 if an argument or a file is invalid.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = _parser()
    options = parse(parser, arguments)
    if options.publish and (
            options.estimator or options.model or options.calibration or options.track):
        parser.error('argument --publish: not allowed with --estimator, --model, --calibration or '
                     '--track, because running nodes estimate')
    if options.calibration and 'neural' in (options.estimator or ()):
        parser.error('argument --calibration: not allowed with --estimator neural, whose model '
                     'is trained for an ideal surface')
    if not options.publish and (options.topic, options.rate, options.timeout) != (
            None, _RATE, _TIMEOUT_S):
        parser.error('arguments --topic, --rate and --timeout: expected together with --publish')
    if options.track and BayesEstimator.name not in (options.estimator or ['bayes']):
        parser.error('argument --track: expected together with --estimator bayes')
    if options.model and 'neural' not in (options.estimator or ()):
        parser.error('argument --model: expected together with --estimator neural')
    try:
        if options.publish:
            return republish(options, ['replay', *arguments])
        _compare(options)
    except (RecordingError, ScenarioError, CodebookError, CalibrationError, ModelError,
            plugins.PluginError, OSError) as error:
        print_error(error, parser.prog)
        return 2
    except RepublishError as error:
        print_error(error, parser.prog)
        return 1
    return 0


def _compare(options: argparse.Namespace) -> None:
    """Print a table of the recorded errors and of those of estimators."""
    scenario = Scenario.from_yaml(options.config) if options.config else None
    recording = load(options.file, options.namespace, scenario)
    codebooks = _codebooks(recording, options.codebook)
    live = np.array([cycle.error_m for cycle in recording.cycles])
    names = sorted({cycle.estimate.estimator for cycle in recording.cycles})
    print(f'{len(live)} cycles\n{"":12s} median error  root mean square  no fix')
    print(_row(f'live {", ".join(names)}', live))
    known = {}
    if options.calibration:
        known['surface'] = load_surface(str(options.calibration), recording.scenario)
    for name in options.estimator or ['bayes']:
        estimators = {codebook_id: make_estimator(
            name, recording.scenario, codebook,
            **file_options(name, default_folder(), options.model or ''), **known)
            for codebook_id, codebook in codebooks.items()}
        print(_row(name, errors_m(recording.cycles, estimators)))
        if options.track and name == BayesEstimator.name:
            print(_row('track', tracked_errors_m(
                recording.cycles, estimators, options.track_speed)))


def _row(name: str, errors: np.ndarray) -> str:
    fixes = errors[~np.isnan(errors)]
    median, rms = ((np.median(fixes), np.sqrt(np.mean(fixes**2))) if len(fixes)
                   else (np.nan, np.nan))
    return f'{name:12s} {median:10.6f} m {rms:15.6f} m {len(errors) - len(fixes):7d}'


def _codebooks(recording: Recording, file: Path | None) -> dict[str, Codebook]:
    """Return the codebooks to assume, by the id of the codebook used for the signals."""
    used = sorted({cycle.signals.codebook_id for cycle in recording.cycles})
    if file:
        codebook = Codebook.load(file)
        for codebook_id in used:
            if codebook_id != codebook.id:
                print(f'signals received with codebook {codebook_id} are evaluated with '
                      f'{codebook.id}', file=sys.stderr)
        assumed = dict.fromkeys(used, codebook)
    else:
        missing = [codebook_id for codebook_id in used if codebook_id not in recording.codebooks]
        if missing:
            raise RecordingError(f'codebook {missing[0]}: not in the recording; give its file '
                                 'with --codebook FILE')
        assumed = {codebook_id: recording.codebooks[codebook_id] for codebook_id in used}
    for codebook in assumed.values():
        codebook.check(recording.scenario)
    return assumed


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='replay', description='Feed the received signals of a recording to estimators, and '
        'compare their errors with those of the recorded network.')
    parser.add_argument('file', type=input_file, help='recording')
    parser.add_argument('--estimator', action='append',
                        choices=(*ESTIMATORS, *plugins.names(plugins.ESTIMATORS)),
                        help='may be repeated (default: bayes)')
    parser.add_argument('--track', action='store_true',
                        help='also track the users with the estimator bayes')
    parser.add_argument('--track-speed', type=positive_float, default=Motion.speed_mps,
                        metavar='MPS', help='typical speed of the users (default: 1 m/s)')
    parser.add_argument('--codebook', type=input_file, metavar='FILE',
                        help='codebook to assume; by default the recorded one')
    parser.add_argument('--config', type=input_file, metavar='FILE',
                        help='scenario file; by default the recorded scenario')
    parser.add_argument('--calibration', type=input_file, metavar='FILE',
                        help='calibration of the surface; by default that of the scenario')
    parser.add_argument('--model', type=input_file, metavar='FILE',
                        help='model of the estimator neural')
    parser.add_argument('--namespace', default='/',
                        help='namespace of the recorded network (default: /)')
    live = parser.add_argument_group(
        'running nodes', 'Publish the recorded signals again, with their timing, in the namespace '
        'of --ros-args -r __ns:=... If the namespace has no optimizer, the replay provides the '
        'recorded codebook instead.')
    live.add_argument('--publish', action='store_true', help='publish instead of estimating')
    live.add_argument('--rate', type=positive_float, default=_RATE, metavar='R',
                      help='speed relative to the recording (default: 1)')
    live.add_argument('--topic', action='append', choices=_TOPICS, metavar='NAME',
                      help='relative name; may be repeated (default: '
                      f'{topics.NAMES[m.ReceivedSignals]})')
    live.add_argument('--timeout', type=positive_float, default=_TIMEOUT_S, metavar='S',
                      help='maximum time to wait for subscribers (default: 60 s)')
    return parser


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
