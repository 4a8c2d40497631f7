"""``scripts/replay FILE``: passes the received signals in a recording to estimators.

With ``--publish``, it publishes the signals, or other topics, to running nodes instead.
"""

import argparse
import functools
import math
import posixpath
import sys
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import yaml
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient

from rhs_isac_ros.calibration import load_surface
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.cycle_log import ANSWERS, Key, SignalLog
from rhs_isac_ros.nodes.optimizer import OptimizerNode, ros_parameters
from rhs_isac_ros.positioning import (
    ESTIMATORS,
    BayesEstimator,
    Estimate,
    Estimator,
    EstimatorKind,
    Motion,
    Site,
    fuse,
)
from rhs_isac_ros.positioning.store import default_folder
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.positioner import Tracks
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import (
    create_publisher,
    full_name,
    steady_timer,
    subscribe_messages,
)
from rhs_isac_ros.ros.environment import is_secure
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.ros.recording import (
    Recorded,
    RecordingError,
    read,
    read_networks,
    recorded_topics,
)
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.support.arguments import ArgumentParser, input_file, positive_float
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.support.texts import text_table
from rhs_isac_ros.system import System
from rhs_isac_ros.tools import command
from rhs_isac_ros.tools.command import ToolError

# Positions, float64 [3] [m], some with velocities, [6] [m, m/s], by cycle and user.
_Positions: TypeAlias = dict[Key, np.ndarray]
_SIGNALS = topics.NAMES[m.ReceivedSignals]
_ESTIMATES = topics.NAMES[m.PositionEstimate]
# Period of looking for subscribers; maximum time to discover an optimizer, without and with DDS
# security [s].
_POLL_PERIOD_S = 0.05
_DISCOVERY_TIMEOUT_S = 2.0
_SECURE_DISCOVERY_TIMEOUT_S = 8.0
# All publishers and subscribers of a network are assumed to be known if none has appeared for this
# time [s]. Another publisher may be discovered after the first subscriber.
_SETTLING_TIME_S = 1.0
_ACK_TIMEOUT = Duration(seconds=5)
# Number of messages without answers after which acknowledgements are awaited, within the depth of
# the queues.
_BATCH = 64
# Period of publishing signals again that have no answer, because an estimator may still wait for
# the codebook; maximum time to wait for an answer after another one is missing [s].
_REPEAT_S, _SHORT_S = 2.0, 0.5
# A recorded pause that is longer than the first number is shortened to the second [s].
_MAX_GAP_S, _GAP_S = 10.0, 1.0
# Maximum time between two looks at the clock [s].
_MAX_WAIT_S = 1.0
# Topics that can be published again. The codebook is set as parameters; recorded diagnostics and
# announcements would contradict the running nodes.
_TOPICS = sorted(set(recorded_topics()) - {topics.CODEBOOK, topics.DIAGNOSTICS, topics.PRESENCE})
# Defaults of the options for running nodes.
_RATE = 1.0
_TIMEOUT_S = 60.0


class RepublisherNode(Node):
    """Publishes messages with their recorded timing, once all topics have subscribers.

    `messages` contains the topic, the content and the time [s] of each message, sorted by time.
    `names` are the relative names of the topics. `rate` is the speed relative to the recording.
    After signals, the node waits up to `timeout_s` for an estimate, so that no queue overflows.
    `optimizer`, unless it is None, receives the codebooks. `waits_for` is the first topic without
    the expected subscribers, or ''. `count` is the number of published messages, `unanswered` that
    of signals without an estimate, and `unconfirmed` contains topics with messages that were not
    acknowledged.
    """

    def __init__(
            self, messages: Iterable[tuple[str, bytes, float]], names: Collection[str],
            rate: float, timeout_s: float) -> None:
        super().__init__('replay', **WITHOUT_SERVICES)
        self.optimizer: OptimizerNode | None = None
        self.count, self.finished, self.waits_for = 0, False, next(iter(names))
        self.unanswered, self.unconfirmed = 0, set[str]()
        # Cycle and user of signals without an answer.
        self._pending: tuple[int, int] | None = None
        # Time of the first check [s]: the time to discover an optimizer does not count.
        self._begin_s = math.inf
        self._timeout_s = self._answer_timeout_s = timeout_s
        self._waits_s = self._publish(messages, rate)
        # Numbers of publishers and subscribers by topic, and the time of their last change [s].
        self._endpoints: list[tuple[int, int]] = []
        self._unchanged_since_s = time.monotonic()
        kinds = recorded_topics()
        self._message_publishers = {
            name: create_publisher(self, kinds[name][0], name, kinds[name][1]) for name in names}
        self._timer = steady_timer(self, _POLL_PERIOD_S, self._poll_subscribers)
        if _SIGNALS in names:
            subscribe_messages(self, ANSWERS, None, self._on_answer)

    def _on_answer(self, message: m.Message, _: float) -> None:
        if isinstance(message, m.PositionEstimate | m.NoFix) and self._pending == (
                message.cycle_id, message.user):
            self._pending = None
            self._continue()

    def _poll_subscribers(self) -> None:
        self.waits_for = next(
            (name for name in self._message_publishers if not self._has_subscribers(name)), '')
        if self._endpoints_settled() and not self.waits_for:
            self._timer.cancel()
            self._timer = steady_timer(self, _POLL_PERIOD_S, self._continue)
            self._continue()

    def _endpoints_settled(self) -> bool:
        """Return whether no endpoint of the topics has appeared or disappeared for some time."""
        now_s = time.monotonic()
        endpoints = [
            (self.count_publishers(name), self.count_subscribers(name))
            for name in (*self._message_publishers, _ESTIMATES)]
        if endpoints != self._endpoints:
            self._endpoints, self._unchanged_since_s = endpoints, now_s
        return now_s >= self._unchanged_since_s + _SETTLING_TIME_S

    def _has_subscribers(self, name: str) -> bool:
        publisher, n_expected = self._message_publishers[name], 1
        if name == _SIGNALS:
            # Observers may subscribe to the signals, too. Wait for the nodes that publish
            # estimates, which subscribe to the signals when their tables are complete.
            estimators = {*map(full_name, self.get_publishers_info_by_topic(
                self.resolve_topic_name(_ESTIMATES)))} - {self.get_fully_qualified_name()}
            subscribers = {*map(
                full_name, self.get_subscriptions_info_by_topic(publisher.topic_name))}
            if not estimators or not estimators <= subscribers:
                return False
            n_expected = len(subscribers)
        return publisher.get_subscription_count() >= n_expected

    def _continue(self) -> None:
        """Publish the messages that are due, and set the timer for the next one."""
        if (wait_s := next(self._waits_s, None)) is not None:
            self._timer.timer_period_ns = max(int(wait_s * 1e9), 1)
            self._timer.reset()
            return
        self._timer.cancel()
        for name in self._message_publishers:
            self._confirm(name)
        self.finished = True

    def _confirm(self, name: str) -> None:
        if not self._message_publishers[name].wait_for_all_acked(_ACK_TIMEOUT):
            self.unconfirmed.add(name)

    def _publish(
            self, messages: Iterable[tuple[str, bytes, float]], rate: float) -> Iterator[float]:
        """Publish each message when it is due; until then, yield times to wait [s]."""
        begin_s = time.monotonic()
        for name, content, due_s in _without_gaps(messages):
            while (wait_s := begin_s + due_s / rate - time.monotonic()) > 0:
                yield min(wait_s, _MAX_WAIT_S)
            if name == topics.CODEBOOK:
                if self.optimizer:
                    codebook = convert.from_bytes(convert.CodebookMessage, content).codebook()
                    self.optimizer.set_parameters_atomically(
                        ros_parameters(codebook.to_parameters()))
                continue
            self._message_publishers[name].publish(content)
            self.count += 1
            if name == _SIGNALS:
                yield from self._until_answered(content)
            elif self.count % _BATCH == 0:
                self._confirm(name)

    def _until_answered(self, content: bytes) -> Iterator[float]:
        """Yield times to wait [s] until published signals are answered; publish them again."""
        signals = convert.from_bytes(m.ReceivedSignals, content)
        self._pending = signals.cycle_id, signals.user
        begin_s = sent_s = time.monotonic()
        while self._pending and (now_s := time.monotonic()) < begin_s + self._answer_timeout_s:
            if now_s > sent_s + _REPEAT_S:
                self._message_publishers[_SIGNALS].publish(content)
                sent_s = now_s
            yield _POLL_PERIOD_S
        if self._pending:
            self.unanswered += 1
            self._answer_timeout_s = _SHORT_S

    def is_done(self) -> bool:
        """Return `finished`; raise ToolError for another publisher or missing subscribers."""
        self._begin_s = min(self._begin_s, time.monotonic())
        for name, publisher in self._message_publishers.items():
            if self.count_publishers(publisher.topic_name) > 1:
                raise ToolError(f'{name}: already published by another node')
        if self.waits_for and time.monotonic() > self._begin_s + self._timeout_s:
            raise ToolError(f'{self.waits_for}: no subscriber within {self._timeout_s:g} s')
        return self.finished


def _without_gaps(
        messages: Iterable[tuple[str, bytes, float]]) -> Iterator[tuple[str, bytes, float]]:
    """Replace recorded times by times since the first message that is no codebook [s].

    Long pauses are shortened, and printed. A codebook before the first other message is due at
    once.
    """
    last_s, due_s = math.nan, 0.0
    for name, content, time_s in messages:
        if math.isnan(last_s):
            if name != topics.CODEBOOK:
                last_s = time_s
            yield name, content, 0.0
            continue
        step_s, last_s = time_s - last_s, time_s
        if step_s > _MAX_GAP_S:
            print(f'replay: a pause of {step_s:.0f} s in the recording is shortened to '
                  f'{_GAP_S:.0f} s', file=sys.stderr)
            step_s = _GAP_S
        due_s += step_s
        yield name, content, due_s


def _republish(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    names = options.topic or [_SIGNALS]
    scenario = command.choose_scenario(
        options.config, options.file, options.namespace, options.site)
    first_codebook = _first_codebook(options) if _SIGNALS in names else None
    if first_codebook:
        first_codebook.check(scenario)
    nodes: list[RepublisherNode] = []

    def create() -> list[Node]:
        node = RepublisherNode(_messages(options, [*names, topics.CODEBOOK]), names,
                               options.rate, options.timeout)
        nodes.append(node)
        if first_codebook is None:
            return [node]
        if _optimizer_present(node):
            print(f'using the codebook of the {topics.OPTIMIZER_NODE} in the namespace',
                  file=sys.stderr)
            return [node]
        node.optimizer = _optimizer(scenario, first_codebook)
        return [node, node.optimizer]

    code = run(create, arguments, lambda: nodes[0].is_done())
    if nodes:
        print(f'{nodes[0].count} messages published')
        if nodes[0].unanswered:
            raise ToolError(f'{nodes[0].unanswered} signals without {_ESTIMATES} or no_fix')
        if nodes[0].unconfirmed:
            raise ToolError(f'not all acknowledged: {", ".join(sorted(nodes[0].unconfirmed))}')
    return code


def _messages(
        options: argparse.Namespace, names: Iterable[str]) -> Iterator[tuple[str, bytes, float]]:
    """Yield the topic (relative name), the bytes and the time [s] of each recorded message."""
    full_names = {f'{command.topic_prefix(options.namespace)}{name}': name for name in names}
    for topic, content, time_s in read(options.file, full_names):
        yield full_names[topic], content, time_s


def _first_codebook(options: argparse.Namespace) -> Codebook:
    """Return the codebook with which the first signals were received."""
    used = ''
    codebooks: dict[str, convert.CodebookMessage] = {}
    for name, content, _ in _messages(options, [_SIGNALS, topics.CODEBOOK]):
        if name == topics.CODEBOOK:
            message = convert.from_bytes(convert.CodebookMessage, content)
            codebooks.setdefault(message.codebook_id, message)
        else:
            used = used or convert.from_bytes(m.ReceivedSignals, content).codebook_id
    if not used:
        raise RecordingError(f'{options.file}: no {_SIGNALS} in the namespace '
                             f'{options.namespace}; see --namespace')
    if options.codebook:
        codebook = Codebook.load(options.codebook)
        if codebook.id != used:
            raise RecordingError(
                f'{options.codebook}: codebook {codebook.id}, but the signals were received with '
                f'{used}: running nodes would drop them')
        return codebook
    if used not in codebooks:
        raise RecordingError(f'codebook {used}: not in the recording, expected its file: '
                             '--codebook FILE')
    return codebooks[used].codebook()


def _optimizer(scenario: Scenario, codebook: Codebook) -> OptimizerNode:
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as folder:
        write_whole(file := f'{folder}/scenario.yaml', yaml.safe_dump(scenario.changes(folder)))
        return OptimizerNode(parameter_overrides=ros_parameters(
            {'scenario_file': file, **codebook.to_parameters()}))


def _optimizer_present(node: Node) -> bool:
    return AsyncParameterClient(node, topics.OPTIMIZER_NODE).wait_for_services(
        _SECURE_DISCOVERY_TIMEOUT_S if is_secure() else _DISCOVERY_TIMEOUT_S)


class Recording:
    """The signals of one or more surfaces in the same cycles, and their true positions.

    `logs` contains those of each surface by name, and '' for what answers the base station: the
    network itself or, in a site, the fusion. `truths` contains the positions of all cycles with
    signals and a true position, also of those without a fix, but without those of which the
    recorder, at its start or end, has missed the answer. Raises RecordingError if there are none.
    """

    def __init__(self, path: Path, namespace: str, scenarios: Mapping[str, Scenario]) -> None:
        self.logs = {name: SignalLog() for name in scenarios}
        for name, log in self.logs.items():
            for found in command.recorded(
                    path, posixpath.join(namespace, name), scenarios[name],
                    [*SignalLog.RECEIVES, Codebook]):
                log.add(*found)
        self.scenarios, leader = scenarios, next(iter(self.logs.values()))
        # In the order of the cycles: the clock of a recording may have gone back.
        found_in = dict(sorted({
            key: truth for log in self.logs.values() for key, signals in log.signals.items()
            if (truth := leader.truths.of(signals))}.items()))
        ended = self.logs[''].ended & found_in.keys()
        keys = [key for key in found_in if key >= min(ended, default=key)]
        self.truths: _Positions = {
            key: found_in[key].position for key in keys if key in ended or key != keys[-1]}
        self._velocities = {key: truth.velocity for key, truth in found_in.items()}
        if not self.truths:
            raise RecordingError(f'{path}: no received signals with a true position in the '
                                 f'namespace {namespace}; see --namespace and --site')

    def live(self, name: str = '') -> _Positions:
        """Return the recorded positions."""
        return {key: found.position for key, found in self.logs[name].estimates.items()}

    def errors_m(self, positions: _Positions) -> np.ndarray:
        """Return the errors of positions, float64 [N] [m]; NaN without a position."""
        return np.array([np.linalg.norm(positions.get(key, np.full(3, np.nan))[:3] - truth)
                         for key, truth in self.truths.items()])

    def velocity_errors_mps(self, positions: _Positions) -> np.ndarray:
        """Return the errors of the velocities, float64 [n] [m/s], where there are any."""
        return np.array([np.linalg.norm(found[3:] - self._velocities[key])
                         for key, found in positions.items() if found[3:].size])


def load(path: Path, namespace: str = '/', config: Path | None = None,
         site: Site | None = None) -> Recording:
    """Load a recording of a network; `config`, a file, or `site` replaces the recorded scenario.

    Raises ScenarioError if the scenario is invalid, RecordingError if the recording is.
    """
    return Recording(path, namespace, {
        '': command.choose_scenario(config, path, namespace, site)})


def _state(estimate: Estimate) -> np.ndarray:
    state = np.append(estimate.mean, estimate.velocity)
    return state[np.isfinite(state)]


def locate(
        recording: Recording, estimators: Mapping[str, Estimator],
        track_speed_mps: float | None = None) -> _Positions:
    """Locate the users of a network again; those without a fix have no position.

    The keys of `estimators` are ids of codebooks. If the typical speed `track_speed_mps` [m/s] is
    given, users are tracked over the cycles.
    """
    tracks, log, found = Tracks(), recording.logs[''], {}
    for key in recording.truths:
        signals = log.signals[key]
        estimator = estimators[signals.codebook_id]
        estimate = estimator.estimate(signals.stacked) if track_speed_mps is None else (
            tracks.locate(signals, estimator, track_speed_mps,
                          signals.time_s(log.arrived_s[key])))
        if estimate.fix:
            found[key] = _state(estimate.to_site(recording.scenarios[''].pose))
    return found


class SiteRecording(Recording):
    """The recording of a site."""

    def __init__(self, path: Path, namespace: str, networks: Recorded) -> None:
        self._path, self._networks = path, networks
        leader = next(iter(networks.surfaces.values()))
        super().__init__(path, namespace, {**networks.surfaces, '': leader})

    def located(self, table_folder: Path | None = None) -> dict[str, _Positions]:
        """Locate the users again from the recorded signals; return the positions by name."""
        find = functools.cache(functools.partial(self._estimator, table_folder))
        again: dict[str, _Positions] = {name: {} for name in self.logs}
        leader = next(iter(self._networks.surfaces.values()))
        for key in self.truths:
            sightings = []
            # In the order of the node `fusion`.
            for name, scenario in sorted(self._networks.surfaces.items()):
                signals = self.logs[name].signals.get(key)
                if signals is None:
                    continue
                posterior = find(name, signals.codebook_id).posterior(signals.stacked)
                if sighting := posterior.sighting:
                    sightings.append(sighting)
                if posterior.fix:
                    again[name][key] = _state(posterior.to_site(scenario.pose))
            if sightings and (fused := fuse(
                    sightings, self._networks.bounds_m, leader.outside_probability,
                    leader.user_speed_std_mps)).fix:
                again[''][key] = _state(fused)
        return again

    def _estimator(self, folder: Path | None, name: str, codebook_id: str) -> BayesEstimator:
        if codebook_id not in self.logs[name].codebooks:
            raise RecordingError(f'{self._path}: codebook {codebook_id} of {name}: not recorded')
        system = System(
            self._networks.surfaces[name], self.logs[name].codebooks[codebook_id])
        return BayesEstimator(system, folder, reject_outside=True)


def _replay_site(options: argparse.Namespace, networks: Recorded) -> int:
    """Compare the errors of each surface and of the fusion with the recorded errors."""
    given = [name for name in (
        'publish', 'system', 'codebook', 'config', 'calibration', 'model', 'track')
        if getattr(options, name)]
    if options.estimator and options.estimator != [BayesEstimator.name]:
        given.append('estimator')
    if given:
        # Only the leading surface has whole cycles.
        surfaces = [*networks.surfaces][:None if options.publish else 1]
        names = ', '.join(f'{options.namespace.rstrip("/")}/{name}' for name in surfaces)
        raise ToolError(f'--{given[0]}: not available for a whole site; select a surface with '
                        f'--namespace: {names}')
    recording = SiteRecording(options.file, options.namespace, networks)
    command.print_now(f'{len(recording.truths)} cycles')
    again = recording.located(default_folder())
    rows = [_row(f'{label}{name or "fusion"}', recording, positions)
            for name, found in again.items()
            for label, positions in (('live ', recording.live(name)), ('', found))]
    _print_table(rows)
    return 0


def _kinds(options: argparse.Namespace) -> list[EstimatorKind]:
    return [EstimatorKind(name) for name in options.estimator or [BayesEstimator.name]]


def _conflict(options: argparse.Namespace) -> str:
    kinds = _kinds(options)
    if options.publish and (
            options.estimator or options.model or options.calibration or options.track):
        return ('argument --publish: not allowed with --estimator, --model, --calibration or '
                '--track, because running nodes estimate')
    ideal = next((kind.name for kind in kinds if not kind.uses_surface), '')
    if options.calibration and ideal:
        return (f'argument --calibration: not allowed with --estimator {ideal}, which assumes the '
                'surface of the scenario')
    if not options.publish and (options.topic, options.rate, options.timeout) != (
            None, _RATE, _TIMEOUT_S):
        return 'arguments --topic, --rate and --timeout: expected together with --publish'
    if options.config and options.site:
        return 'argument --config: not allowed with --site'
    if options.track and not any(kind.uses_tracks for kind in kinds):
        return 'argument --track: expected together with --estimator bayes'
    if options.track_speed is not None and not options.track:
        return 'argument --track-speed: expected together with --track'
    if options.model and not any('model_file' in kind.options for kind in kinds):
        return 'argument --model: expected together with --estimator neural'
    return ''


def _replay(options: argparse.Namespace, arguments: list[str]) -> int:
    """Publish a recording, or compare the errors of estimators with the recorded errors."""
    if options.site:
        options.site = Site.from_yaml(options.site)
    networks = read_networks(options.file, options.site)
    if networks.is_site(options.namespace):
        return _replay_site(options, networks)
    if options.publish:
        return _republish(options, arguments)
    recording = load(options.file, options.namespace, options.config, options.site)
    (scenario,), (log,) = recording.scenarios.values(), recording.logs.values()
    codebooks = _codebooks(recording, options.codebook)
    names = sorted({estimate.estimator for estimate in log.estimates.values()})
    command.print_now(f'{len(recording.truths)} cycles')
    rows = [_row(f'live {", ".join(names)}', recording, recording.live())]
    surface = load_surface(str(options.calibration or ''), scenario)
    for kind in _kinds(options):
        accepted = kind.accepted(table_folder=default_folder(), model_file=options.model or '',
                                 reject_outside=True)
        estimators = {codebook_id: kind.create(System(scenario, codebook, surface), **accepted)
                      for codebook_id, codebook in codebooks.items()}
        rows.append(_row(kind.name, recording, locate(recording, estimators)))
        if options.track and kind.uses_tracks:
            rows.append(_row('track', recording, locate(
                recording, estimators, options.track_speed or Motion.speed_mps)))
    _print_table(rows)
    return 0


def _print_table(rows: Sequence[Sequence[str]]) -> None:
    heads = ['', 'median error', 'root mean square', 'no fix', 'velocity, rms']
    n = 5 if any(row[-1] for row in rows) else 4
    print(text_table(heads[:n], [row[:n] for row in rows], '<>>>>'[:n]))


def _row(name: str, recording: Recording, positions: _Positions) -> list[str]:
    errors, speeds = recording.errors_m(positions), recording.velocity_errors_mps(positions)
    fixes = errors[~np.isnan(errors)]
    median, rms = ((np.median(fixes), np.sqrt(np.mean(fixes**2))) if len(fixes)
                   else (np.nan, np.nan))
    return [name, f'{median:.6f} m', f'{rms:.6f} m', str(len(errors) - len(fixes)),
            f'{np.sqrt(np.mean(speeds**2)):.6f} m/s' if len(speeds) else '']


def _codebooks(recording: Recording, file: Path | None) -> dict[str, Codebook]:
    """Return the codebooks to assume, by the id of the recorded codebook."""
    log = recording.logs['']
    used = sorted({log.signals[key].codebook_id for key in recording.truths})
    if file:
        codebook = Codebook.load(file, recording.scenarios[''])
        for codebook_id in used:
            if codebook_id != codebook.id:
                print(f'signals received with codebook {codebook_id} are evaluated with '
                      f'{codebook.id}', file=sys.stderr)
        return dict.fromkeys(used, codebook)
    for codebook_id in used:
        if codebook_id not in log.codebooks:
            raise RecordingError(f'codebook {codebook_id}: not in the recording; give its file '
                                 'with --codebook FILE')
    return {codebook_id: log.codebooks[codebook_id] for codebook_id in used}


def _estimator(text: str) -> str:
    with translated(ValueError, argparse.ArgumentTypeError):
        return EstimatorKind(text).name


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='replay', description='Feed the received signals of a recording to estimators, and '
        'compare their errors with the errors of the recorded network.')
    add = parser.add_argument
    add('file', type=input_file, help='recording')
    add('--estimator', action='append', type=_estimator, metavar='NAME',
        help=f'{", ".join(ESTIMATORS)}, an installed plug-in or MODULE:NAME; may be repeated '
             '(default: bayes)')
    add('--track', action='store_true', help='also track the users with the estimator bayes')
    add('--track-speed', type=positive_float, metavar='MPS',
        help=f'typical speed of the users (default: {Motion.speed_mps:g} m/s)')
    command.add_files(parser, 'codebook', 'config', 'calibration', 'system')
    add('--model', type=input_file, metavar='FILE', help='model of the estimator neural')
    add('--site', type=input_file, metavar='FILE',
        help='site file; by default the recorded scenarios of the surfaces')
    add('--namespace', default='/', help='namespace of the recorded network (default: /)')
    add = parser.add_argument_group(
        'running nodes', 'Publish the recorded signals again, with their timing, in the namespace '
        'of --ros-args -r __ns:=... If the namespace has no optimizer, the replay provides the '
        'recorded codebook instead.').add_argument
    add('--publish', action='store_true', help='publish instead of estimating')
    add('--rate', type=positive_float, default=_RATE, metavar='R',
        help='speed relative to the recording (default: 1)')
    add('--topic', action='append', choices=_TOPICS, metavar='NAME',
        help=f'relative name; may be repeated (default: {_SIGNALS})')
    add('--timeout', type=positive_float, default=_TIMEOUT_S, metavar='S',
        help='maximum time to wait for subscribers, and for an estimate (default: 60 s)')
    return parser


main = command.entry(_replay, _parser, _conflict)
