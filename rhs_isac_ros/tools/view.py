"""``scripts/view``: shows a running network or a recording in the browser."""

import argparse
import functools
import itertools
import math
import os
import signal
import sys
import time
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.bounds import global_bound
from rhs_isac_ros.calibration import load_surface
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.monitoring.network_view import RECEIVES, NetworkView, TrackPoint
from rhs_isac_ros.monitoring.shapes import Entry
from rhs_isac_ros.positioning import (
    BayesEstimator,
    Estimate,
    Motion,
    SignalError,
    TrackEstimate,
    WeightedModes,
    weighted_modes,
)
from rhs_isac_ros.positioning.store import default_folder
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.positioner import Tracks
from rhs_isac_ros.protocol.role import NewestDict
from rhs_isac_ros.ros import convert, diagnostics, topics
from rhs_isac_ros.ros.diagnostics import subscribe_reports
from rhs_isac_ros.ros.endpoints import (
    EXCHANGE,
    LATCHED,
    OBSERVATION,
    BackgroundWorker,
    steady_timer,
    subscribe,
    subscribe_messages,
)
from rhs_isac_ros.ros.recording import RecordingError, read, read_scenario
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.ros.startup import WITHOUT_SERVICES
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    integer,
    output_file,
    positive_float,
    positive_int,
)
from rhs_isac_ros.tools.command import ToolError, print_now, run_command
from rhs_isac_ros.tools.replay import topic_prefix
from rhs_isac_ros.tools.rerun_stream import RerunStream

# Number of codebooks, each with tables of some megabytes; more are unusual even in a recording.
_MAX_CODEBOOKS = 32
# With Table I, the bound on the root mean squared error then has a standard error of 2.4 %.
_N_PHASES = 256


class Posteriors:
    """The posteriors of received signals, for the latest codebooks that were added.

    The messages of the network do not contain the modes: sending them would lengthen every cycle.

    Parameters
    ----------
    surface
        What is known of the surface, as in `make_estimator`.
    """

    def __init__(
            self, scenario: Scenario, surface: Surface | None = None,
            table_folder: Path | None = None) -> None:
        self._scenario, self._surface = scenario, surface
        self._table_folder = table_folder or default_folder()
        self._estimators: NewestDict[str, BayesEstimator] = NewestDict(_MAX_CODEBOOKS)
        self._tracks = Tracks()

    @property
    def codebooks(self) -> Mapping[str, object]:
        """The codebooks that were added, by id, up to 32."""
        return self._estimators

    def add(self, codebook: Codebook) -> None:
        """Prepare for signals received with a codebook.

        Raises
        ------
        CodebookError
            If the codebook does not fit the scenario.
        """
        codebook.check(self._scenario)
        self._estimators.put(codebook.id, BayesEstimator(
            self._scenario, codebook, self._table_folder, surface=self._surface))

    def bound_m2(self, codebook: Codebook) -> float:
        """Compute the global bound on the mean squared error with a codebook [m^2].

        This takes some seconds.
        """
        return global_bound(
            self._scenario, codebook, np.random.default_rng(0), _N_PHASES).value

    def modes(self, received: m.ReceivedSignals) -> WeightedModes | None:
        """Return the modes of the posterior; None without a position or a known codebook."""
        estimator = self._estimators.get(received.codebook_id)
        if estimator is None:
            return None
        try:
            return weighted_modes(estimator, received.signals)
        except SignalError:
            return None

    def track(
            self, received: m.ReceivedSignals, now_s: float, speed_mps: float) -> Estimate | None:
        """Continue the track of a user.

        Parameters
        ----------
        now_s
            Time at which the signals arrived [s].
        speed_mps
            Typical speed of the users [m/s].

        Returns
        -------
        Estimate or None
            A `TrackEstimate` from the second position on; None without a known codebook.
        """
        estimator = self._estimators.get(received.codebook_id)
        if estimator is None:
            return None
        try:
            return self._tracks.locate(received, estimator, speed_mps, now_s)
        except SignalError:
            return None


# If no cycle is observed for this time, the reason is logged.
_SILENCE_S = 5.0
# Maximum number of users whose tracks are followed, because their numbers come from messages.
_MAX_TRACKS = 64
# Beam patterns take most of the time of a view, so that of a fast network shows fewer of them.
_BEAM_PERIOD_S = 0.2


class ViewNode(Node):
    """Converts the messages of its namespace to entries.

    Modes and bounds are computed in the background. If cycles are faster, the modes and the beam
    of some are left out.

    Parameters
    ----------
    write
        Called with the entries.

    Attributes
    ----------
    view
        The view, with times of `time.monotonic`.
    mismatch
        Error of the last message that does not match the scenario; empty if there was none.
    """

    def __init__(
            self, scenario: Scenario, posteriors: Posteriors,
            write: Callable[[Iterable[Entry]], None]) -> None:
        super().__init__('view', **WITHOUT_SERVICES)
        self.view, self._scenario_id = NetworkView(scenario), scenario.id
        self.mismatch = ''
        # Names of a destroyed node are not available.
        self._namespace = self.get_namespace()
        self._posteriors, self._write = posteriors, write
        self._worker, self._bounds = BackgroundWorker(self), BackgroundWorker(self)
        self._requested: set[str] = set()  # ids of codebooks that are being prepared
        self._is_searching = False
        self._waiting: m.ReceivedSignals | None = None
        self._users: set[int] = set()
        self._beam_s = -math.inf
        write(self.view.begin())
        subscribe(self, ros.Codebook, topics.CODEBOOK, self._on_codebook, LATCHED)
        subscribe_reports(self, lambda node, report: self._write(
            self.view.add_report(node, report)))
        subscribe_messages(self, RECEIVES, scenario.sizes, self._on_message, self._on_mismatch,
                           exchange=OBSERVATION)
        self._silence_timer = steady_timer(self, _SILENCE_S, self._log_silence)

    @property
    def silence(self) -> str:
        """Reason why no cycle is observed."""
        domain = os.environ.get('ROS_DOMAIN_ID', '0')
        return (f'the network uses another scenario ({self.mismatch})' if self.mismatch else
                f'no cycle in the domain {domain} and the namespace {self._namespace}')

    def _log_silence(self) -> None:
        self._silence_timer.cancel()
        if not self.view.n_cycles:
            self.get_logger().warning(  # type: ignore[no-untyped-call]
                f'{self.silence}; still waiting')

    def _on_message(self, message: m.Message) -> None:
        now_s = time.monotonic()
        if message.scenario_id not in ('', self._scenario_id):
            self._on_mismatch(m.MessageError(
                f'{type(message).__name__} of scenario {message.scenario_id}, expected '
                f'{self._scenario_id}'))
            return
        if isinstance(message, m.Beam):
            if now_s < self._beam_s + _BEAM_PERIOD_S:
                return
            self._beam_s = now_s
        self._write(self.view.add(message, now_s))
        match message:
            case m.ReceivedSignals():
                self._waiting = message
                self._search()
            case m.PositionEstimate():
                self._follow_track(message.user)

    def _on_mismatch(self, error: m.MessageError) -> None:
        if not self.mismatch:
            self.get_logger().warning(  # type: ignore[no-untyped-call]
                f'{error}; if the network uses another scenario, pass it with --config FILE')
        self.mismatch = str(error)

    def _on_codebook(self, message: ros.Codebook) -> None:
        try:
            codebook = convert.codebook_from_ros(message)
        except (m.MessageError, CodebookError) as error:
            self._no_modes(error)
            return
        if codebook.id not in self._requested | self._posteriors.codebooks.keys():
            self._requested.add(codebook.id)
            self._worker.run(functools.partial(self._add, codebook),
                             functools.partial(self._on_added, codebook))

    def _add(self, codebook: Codebook) -> CodebookError | None:
        try:
            self._posteriors.add(codebook)
        except CodebookError as error:
            return error
        return None

    def _on_added(self, codebook: Codebook, error: CodebookError | None) -> None:
        self._requested.discard(codebook.id)
        if error:
            self._no_modes(error)
            return
        self._bounds.run(functools.partial(self._posteriors.bound_m2, codebook),
                         functools.partial(self.view.set_bound, codebook.id))
        self._search()

    def _no_modes(self, error: Exception) -> None:
        self.get_logger().warning(  # type: ignore[no-untyped-call]
            f'no modes: {error}')

    def _search(self) -> None:
        """Start the search for the modes of the latest signals, unless one is running."""
        received = self._waiting
        if received is None or self._is_searching or (
                received.codebook_id not in self._posteriors.codebooks):
            return
        self._waiting, self._is_searching = None, True
        self._worker.run(functools.partial(self._posteriors.modes, received),
                         functools.partial(self._on_modes, received))

    def _on_modes(self, received: m.ReceivedSignals, found: WeightedModes | None) -> None:
        self._is_searching = False
        self._write(self.view.add_modes(received, found))
        self._search()

    def _follow_track(self, user: int) -> None:
        """Subscribe to the track of a user, published if the positioner has ``prior:=track``."""
        if user in self._users or len(self._users) >= _MAX_TRACKS:
            return
        self._users.add(user)
        subscribe(self, Odometry, topics.ODOMETRY.format(user=user),
                  functools.partial(self._on_track, user), EXCHANGE)

    def _on_track(self, user: int, message: Odometry) -> None:
        position, velocity = message.pose.pose.position, message.twist.twist.linear
        point = TrackPoint(
            user, np.array([position.x, position.y, position.z]),
            np.reshape(message.pose.covariance, (6, 6))[:3, :3],
            np.array([velocity.x, velocity.y, velocity.z]))
        if all(np.isfinite(field).all() for field in (
                point.position, point.covariance_m2, point.velocity)):
            self._write(self.view.add_track(0, point))

    def destroy_node(self) -> None:
        """End the background threads, then destroy the node."""
        self._worker.close()
        self._bounds.close()
        super().destroy_node()  # type: ignore[no-untyped-call]


def entries(
        path: Path, namespace: str, scenario: Scenario, posteriors: Posteriors,
        track_speed_mps: float | None = None, max_cycles: int = 0) -> Iterator[Entry]:
    """Yield the entries of a recording.

    Parameters
    ----------
    namespace
        Namespace of the network.
    posteriors
        Receives the recorded codebooks.
    track_speed_mps
        Typical speed of the users [m/s], to track them; None: no tracks.
    max_cycles
        Number of cycles after which to end; 0: read all.

    Raises
    ------
    RecordingError
        If the file is not a recording, has no messages in the namespace, or contains a message
        that is malformed or does not fit the scenario.
    """
    prefix = topic_prefix(namespace)
    view = NetworkView(scenario)
    for topic, found, _ in read(path, [f'{prefix}{topics.CODEBOOK}']):
        try:
            codebook = convert.codebook_from_ros(found)
            if codebook.id in posteriors.codebooks:
                continue
            posteriors.add(codebook)
        except (m.MessageError, CodebookError) as error:
            raise RecordingError(f'{path}: {topic}: {error}') from None
        view.set_bound(codebook.id, posteriors.bound_m2(codebook))
    yield from view.begin()
    kinds = {f'{prefix}{topics.NAMES[kind]}': kind for kind in RECEIVES}
    # Before version 1.0, the topic was in the namespace.
    reports = {topics.DIAGNOSTICS, f'{prefix}{topics.DIAGNOSTICS.lstrip("/")}'}
    for topic, found, time_s in read(path, [*kinds, *reports]):
        if topic in reports:
            for node, report in diagnostics.from_ros(found, namespace):
                yield from view.add_report(node, report)
            continue
        try:
            message = convert.from_ros(kinds[topic], found)
            _check_scenario(message, scenario)
            m.check(message, scenario.sizes)
        except m.MessageError as error:
            raise RecordingError(f'{path}: {topic}: {error}') from None
        yield from view.add(message, time_s)
        if isinstance(message, m.ReceivedSignals):
            yield from view.add_modes(message, posteriors.modes(message))
            if track_speed_mps is not None:
                yield from _track(view, message, posteriors.track(
                    message, time_s, track_speed_mps))
        if max_cycles and view.n_ended >= max_cycles:
            break
    if not view.n_cycles:
        raise RecordingError(f'{path}: no cycle in the namespace {namespace}')


def _check_scenario(message: m.Message, scenario: Scenario) -> None:
    if message.scenario_id not in ('', scenario.id):
        raise m.MessageError(
            f'recorded with scenario {message.scenario_id}, expected {scenario.id}')


def _track(
        view: NetworkView, received: m.ReceivedSignals,
        estimate: Estimate | None) -> list[Entry]:
    if not isinstance(estimate, TrackEstimate) or not estimate.fix:
        return []
    return view.add_track(received.cycle_id, TrackPoint(
        received.user, estimate.mean, estimate.covariance, estimate.velocity))


_PROGRAM = 'view'
_PORT = 9090
_POLL_S = 0.2
_SWITCH_INTERVAL_S = 5e-4


def main(arguments: Sequence[str] | None = None) -> int:
    """Show a network or a recording until a signal arrives, or write a file."""
    return run_command(
        _view, _parser(), arguments, ['file', '--config', '--calibration'], ['--save'],
        _conflict)


def _conflict(options: argparse.Namespace) -> str:
    if options.file is None and (options.track or options.namespace):
        return ('arguments --track and --namespace: expected together with a recording; '
                'for a running network, --ros-args -r __ns:=/lab selects the namespace')
    if options.track_speed and not options.track:
        return 'argument --track-speed: expected together with --track'
    return ''


def _view(options: argparse.Namespace, arguments: list[str]) -> int:
    stream = RerunStream()
    try:
        scenario = _scenario(options)
        surface = (load_surface(str(options.calibration), scenario) if options.calibration
                   else None)
        posteriors = Posteriors(scenario, surface)
        _open(stream, options)
        if options.file is None:
            return _show_live(stream, scenario, posteriors, options, arguments)
        return _show_recording(stream, scenario, posteriors, options)
    finally:
        # After `close`, there is nothing left to discard.
        stream.discard()


def _scenario(options: argparse.Namespace) -> Scenario:
    if options.config:
        return Scenario.from_yaml(options.config)
    return (options.file and read_scenario(options.file)) or Scenario()


def _open(stream: RerunStream, options: argparse.Namespace) -> None:
    """Open the file, or serve the viewer and print its address."""
    if options.save:
        stream.save(options.save)
        return
    try:
        address = stream.serve(options.port, options.bind)
    except (OSError, RuntimeError) as error:
        raise ToolError(f'{options.bind}, ports {options.port} to {options.port + 2}: {error}; '
                         'choose others with --port') from None
    print_now(address)
    if options.open:
        webbrowser.open(address)


def _show_live(
        stream: RerunStream, scenario: Scenario, posteriors: Posteriors,
        options: argparse.Namespace, arguments: Sequence[str]) -> int:
    # With many messages, the background threads would otherwise wait 5 ms for each step.
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    nodes: list[ViewNode] = []

    def create() -> list[ViewNode]:
        nodes.append(ViewNode(scenario, posteriors, stream.write))
        return nodes

    def done() -> bool:
        return bool(options.cycles) and nodes[0].view.n_ended >= options.cycles
    code = run(create, arguments, done)
    if options.save and nodes and not nodes[0].view.n_cycles:
        raise ToolError(f'{options.save} is not written: {nodes[0].silence}')
    if not code:
        _finish(stream, options)
    return code


def _show_recording(
        stream: RerunStream, scenario: Scenario, posteriors: Posteriors,
        options: argparse.Namespace) -> int:
    # A list, because a handler must not take a lock.
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
    stream.write(itertools.takewhile(lambda _: not signals, entries(
        options.file, options.namespace or '/', scenario, posteriors,
        (options.track_speed or Motion.speed_mps) if options.track else None,
        options.cycles)))
    while not (signals or options.save):
        time.sleep(_POLL_S)
    _finish(stream, options)
    return 0


def _finish(stream: RerunStream, options: argparse.Namespace) -> None:
    """End the service, or complete the file and print its name."""
    stream.close()
    if options.save:
        print(options.save)


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog=_PROGRAM, description='Show a running network, or a recording, in three dimensions '
        'and in charts over the cycles: in the browser until Ctrl-C, or as a file for Rerun. ROS '
        'arguments select the namespace of a running network: --ros-args -r __ns:=/lab')
    parser.add_argument('file', nargs='?', type=input_file,
                        help='recording; by default the running network')
    parser.add_argument('--save', type=_recording_file, metavar='FILE',
                        help='write a file for Rerun, *.rrd, instead of serving the viewer')
    parser.add_argument('--cycles', type=positive_int, default=0, metavar='N',
                        help='show N cycles; the view of a running network then ends')
    parser.add_argument('--config', type=input_file, metavar='FILE',
                        help="scenario file; by default that of the recording, or the paper's "
                        'Table I')
    parser.add_argument('--calibration', type=input_file, metavar='FILE',
                        help='calibration of the surface, for the modes of the posterior; by '
                        'default that of the scenario')
    server = parser.add_argument_group('browser')
    server.add_argument('--port', type=integer(1, 65533), default=_PORT, metavar='P',
                        help=f'port of the viewer; its data use the next two (default: {_PORT})')
    server.add_argument('--bind', default='127.0.0.1', metavar='ADDRESS',
                        help='address that the viewer listens on; by default only this machine '
                        'can connect, with 0.0.0.0 any other')
    server.add_argument('--open', action='store_true', help='open the browser')
    recording = parser.add_argument_group('recording')
    recording.add_argument('--namespace', help='namespace of the recorded network (default: /)')
    recording.add_argument('--track', action='store_true',
                           help='track the users, as positioner does with prior:=track')
    recording.add_argument('--track-speed', type=positive_float, metavar='MPS',
                           help='typical speed of the users for --track (default: '
                           f'{Motion.speed_mps:g} m/s)')
    return parser


def _recording_file(text: str) -> Path:
    """Parse the path of a file that Rerun recognises by its suffix, for argparse."""
    path = output_file(text)
    if path.suffix != '.rrd':
        raise argparse.ArgumentTypeError(f'{text!r}, expected a name that ends with .rrd')
    return path


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
