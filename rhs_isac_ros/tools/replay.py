"""``scripts/replay FILE``: what estimators make of the received signals of a recording.

With ``--publish``, live nodes get them again: see `rhs_isac_ros.tools.republish`.
"""

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rclpy.utilities import remove_ros_args

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError, plugins
from rhs_isac_ros.monitoring.cycle_log import RECEIVES, CycleLog, CycleRecord
from rhs_isac_ros.positioning import (
    ESTIMATORS,
    Estimator,
    ModelError,
    file_options,
    make_estimator,
)
from rhs_isac_ros.positioning.store import default_folder
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.recording import RecordingError, read, read_scenario, recorded_topics
from rhs_isac_ros.tools.republish import RepublishError, republish, root_of

# What can be published again: the codebook is a parameter first, and diagnostics are of nodes.
_TOPICS = sorted(set(recorded_topics()) - {topics.CODEBOOK, topics.DIAGNOSTICS})


@dataclasses.dataclass(frozen=True)
class Recording:
    """What a recording holds of one network.

    Attributes
    ----------
    scenario
        Its scenario.
    cycles
        Its complete cycles.
    codebooks
        Its codebooks, by their ids.
    """

    scenario: Scenario
    cycles: list[CycleRecord]
    codebooks: dict[str, Codebook]


def load(path: str | Path, namespace: str = '/', scenario: Scenario | None = None) -> Recording:
    """Read the cycles of a recording.

    Parameters
    ----------
    path
        The file.
    namespace
        Namespace of the network.
    scenario
        Scenario in place of the recording's.

    Returns
    -------
    Recording
        What it holds.

    Raises
    ------
    RecordingError
        If the file is no recording, has no complete cycle in the namespace, or a message is
        malformed.
    ScenarioError, CodebookError
        If the scenario or a codebook in it is wrong.
    """
    scenario = scenario or read_scenario(path) or Scenario()
    root = root_of(namespace)
    kinds = {f'{root}{topics.NAMES[kind]}': kind for kind in RECEIVES}
    log, codebooks = CycleLog(), {}
    for topic, message, time_s in read(path):
        try:
            if topic in kinds:
                plain = convert.from_ros(kinds[topic], message)
                m.check(plain, scenario.sizes)
                log.add(plain, time_s)
            elif topic == f'{root}{topics.CODEBOOK}' and isinstance(message, ros.Codebook):
                codebooks[message.codebook_id] = convert.codebook_from_ros(message)
        except m.MessageError as error:
            raise RecordingError(f'{path}: {topic}: {error}') from None
    if not log.complete:
        raise RecordingError(f'{path}: no complete cycle in the namespace {namespace}')
    return Recording(scenario, log.complete, codebooks)


def errors_m(cycles: Sequence[CycleRecord], estimators: Mapping[str, Estimator]) -> np.ndarray:
    """Estimate every cycle's position anew and return the distances from the true ones.

    Parameters
    ----------
    cycles
        Complete cycles.
    estimators
        Estimators by the id of the codebook with which the signals were taken.

    Returns
    -------
    numpy.ndarray
        Errors, float64 [len(cycles)] [m]; NaN where the signals tell no position.
    """
    errors = []
    for cycle in cycles:
        signals = cycle.signals.signals
        estimate = estimators[cycle.signals.codebook_id].estimate(
            signals.reshape(len(signals), -1))
        errors.append(np.linalg.norm(estimate.mean - cycle.truth.position)
                      if estimate.fix else np.nan)
    return np.array(errors)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the errors of the live network and of estimators that see its signals again.

    Parameters
    ----------
    arguments
        Command line, ROS arguments among it; by default the process's.

    Returns
    -------
    int
        Exit code: 0, also after a signal; 1 if live nodes cannot be served; 2 if an argument or a
        file is wrong.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = _parser()
    options = parser.parse_args(remove_ros_args(['replay', *arguments])[1:])
    if options.publish and (options.estimator or options.model):
        parser.error('argument --publish: live nodes estimate, expected no --estimator, --model')
    try:
        if options.publish:
            return republish(options, ['replay', *arguments])
        scenario = Scenario.from_yaml(options.config) if options.config else None
        recording = load(options.file, options.namespace, scenario)
        codebooks = _codebooks(recording, options.codebook)
        live = np.array([cycle.error_m for cycle in recording.cycles])
        names = sorted({cycle.estimate.estimator for cycle in recording.cycles})
        print(f'{len(live)} cycles\n{"":12s} median error  root mean square  no fix')
        print(_row(f'live {", ".join(names)}', live))
        for name in options.estimator or ['bayes']:
            made = {key: make_estimator(
                name, recording.scenario, codebook,
                **file_options(name, default_folder(), options.model or ''))
                for key, codebook in codebooks.items()}
            print(_row(name, errors_m(recording.cycles, made)))
    except (RecordingError, ScenarioError, CodebookError, ModelError, plugins.PluginError,
            OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    except RepublishError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    return 0


def _row(name: str, errors: np.ndarray) -> str:
    fixes = errors[~np.isnan(errors)]
    median, rms = ((np.median(fixes), np.sqrt(np.mean(fixes**2))) if len(fixes)
                   else (np.nan, np.nan))
    return f'{name:12s} {median:10.6f} m {rms:15.6f} m {len(errors) - len(fixes):7d}'


def _codebooks(recording: Recording, file: Path | None) -> dict[str, Codebook]:
    """Return the codebook for the signals of every cycle, checked."""
    used = sorted({cycle.signals.codebook_id for cycle in recording.cycles})
    if file:
        given = Codebook.load(file)
        for key in used:
            if key != given.id:
                print(f'signals taken with codebook {key} are read as if with {given.id}',
                      file=sys.stderr)
        chosen = dict.fromkeys(used, given)
    else:
        missing = [key for key in used if key not in recording.codebooks]
        if missing:
            raise RecordingError(f'codebook {missing[0]}: not in the recording, expected its '
                                 'file: --codebook FILE')
        chosen = {key: recording.codebooks[key] for key in used}
    for codebook in chosen.values():
        codebook.check(recording.scenario)
    return chosen


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='replay', description='Feed the received signals of a recording to estimators, and '
        'compare their errors with those of the live network.')
    parser.add_argument('file', type=Path, help='recording')
    parser.add_argument('--estimator', action='append',
                        choices=(*ESTIMATORS, *plugins.names(plugins.ESTIMATORS)),
                        help='may be given more than once (default: bayes)')
    parser.add_argument('--codebook', type=Path, metavar='FILE',
                        help="codebook to assume; the recording's if none")
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help="scenario file; the recording's if none")
    parser.add_argument('--model', type=Path, metavar='FILE', help='model of the estimator neural')
    parser.add_argument('--namespace', default='/', help='network of the recording (default: /)')
    live = parser.add_argument_group(
        'live nodes', 'Publish the recorded signals again, with their timing, in the namespace '
        'of --ros-args -r __ns:=... The codebook goes with them: unless the namespace has an '
        'optimizer, the replay holds it as one would.')
    live.add_argument('--publish', action='store_true', help='publish instead of estimating')
    live.add_argument('--rate', type=_positive, default=1.0, metavar='R',
                      help='how many times as fast as recorded (default: 1)')
    live.add_argument('--topic', action='append', choices=_TOPICS, metavar='NAME',
                      help='relative name; may be given more than once (default: '
                      f'{topics.NAMES[m.ReceivedSignals]})')
    live.add_argument('--timeout', type=_positive, default=60.0, metavar='S',
                      help='how long to wait for listeners (default: 60 s)')
    return parser


def _positive(text: str) -> float:
    if not 0 < float(text) < float('inf'):
        raise argparse.ArgumentTypeError(f'{text}, expected a positive number')
    return float(text)


if __name__ == '__main__':
    sys.exit(main())
