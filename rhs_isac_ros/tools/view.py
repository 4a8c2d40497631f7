"""``scripts/view``: shows a network or a recording in the browser, or writes it to a file."""

import argparse
import contextlib
import functools
import itertools
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node

from rhs_isac_ros.bounds import global_bound
from rhs_isac_ros.calibration import load_surface
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.monitoring.network_view import RECEIVES, NetworkView
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.monitoring.shapes import Entry
from rhs_isac_ros.positioning import (
    BayesEstimator,
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
from rhs_isac_ros.ros import endpoints, topics
from rhs_isac_ros.ros.diagnostics import subscribe_reports
from rhs_isac_ros.ros.frames import vector
from rhs_isac_ros.ros.recording import RecordingError
from rhs_isac_ros.ros.run import collect_signals
from rhs_isac_ros.ros.startup import WITHOUT_SERVICES
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    integer,
    output_file,
    positive_float,
    positive_int,
)
from rhs_isac_ros.tools import command
from rhs_isac_ros.tools.command import ToolError
from rhs_isac_ros.tools.rerun_stream import RerunStream

# Maximum number of codebooks, whose tables take some megabytes each.
_MAX_CODEBOOKS = 32
# Number of positioning phases for a bound. With Table I, its root has a standard error of 2.4 %.
_N_PHASES = 256
# Time to wait for the first cycle before the reason for its absence is logged [s].
_SILENCE_S = 5.0
# Maximum number of tracks that the view shows, because user numbers come from messages.
_MAX_TRACKS = 64
# Minimum time between two beams [s]: their patterns take most of the computing time of a view.
_BEAM_PERIOD_S = 0.2
_PROGRAM = 'view'
_PORT = 9090
_POLL_S = 0.2
_SWITCH_INTERVAL_S = 5e-4


class Posteriors:
    """Computes tracks and the modes of posteriors from signals, for the latest codebooks.

    Messages do not contain the modes, because computing them would lengthen every cycle.
    `surface` is as in `make_estimator`.
    """

    def __init__(self, scenario: Scenario, surface: Surface | None = None) -> None:
        self._scenario, self._surface = scenario, surface
        self._estimators: NewestDict[str, BayesEstimator] = NewestDict(_MAX_CODEBOOKS)
        self._tracks = Tracks()

    def __contains__(self, codebook_id: str) -> bool:
        """Return whether a codebook is among the latest that were added."""
        return codebook_id in self._estimators

    def add(self, codebook: Codebook) -> None:
        """Prepare for signals that are received with a codebook, which must fit the scenario."""
        self._estimators.put(codebook.id, BayesEstimator(
            self._scenario, codebook, default_folder(), surface=self._surface))

    def bound_m2(self, codebook: Codebook) -> float:
        """Compute the global bound on the mean squared error [m^2], which takes a few seconds."""
        return global_bound(
            self._scenario, codebook, np.random.default_rng(0), _N_PHASES).value

    def modes(self, received: m.ReceivedSignals) -> WeightedModes | None:
        """Return the modes; None without a fix, with unusable signals or an unknown codebook."""
        estimator = self._estimators.get(received.codebook_id)
        with contextlib.suppress(SignalError):
            return weighted_modes(estimator, received.signals) if estimator else None
        return None

    def track(
            self, received: m.ReceivedSignals, now_s: float, speed_mps: float
    ) -> TrackEstimate | None:
        """Continue the track of a user with signals that arrived at `now_s` [s].

        The typical speed of users is `speed_mps` [m/s]. Returns None if the signals are late or
        unusable, without a fix, or with an unknown codebook.
        """
        estimator = self._estimators.get(received.codebook_id)
        with contextlib.suppress(SignalError):
            estimate = estimator and self._tracks.locate(received, estimator, speed_mps, now_s)
            if isinstance(estimate, TrackEstimate) and estimate.fix:
                return estimate
        return None


class ViewNode(Node):
    """Converts the messages in its namespace to entries, and passes them to `write`.

    Modes and bounds are computed in the background. At high cycle rates, the modes and the beams
    of some cycles are left out. `mismatch` is the error of the last message that did not match the
    scenario, or ''.
    """

    def __init__(
            self, scenario: Scenario, posteriors: Posteriors,
            write: Callable[[Iterable[Entry]], None]) -> None:
        super().__init__('view', **WITHOUT_SERVICES)
        self.view, self._scenario_id = NetworkView(scenario), scenario.id
        self.mismatch = ''
        # Stored, because a destroyed node has no namespace.
        self._namespace = self.get_namespace()
        self._posteriors, self._write = posteriors, write
        self._worker, self._bounds = (endpoints.BackgroundWorker(self) for _ in range(2))
        self._requested: set[str] = set()  # ids of codebooks that are being prepared
        self._is_searching = False
        self._waiting: m.ReceivedSignals | None = None
        self._users: set[int] = set()
        self._beam_s = -math.inf
        write(self.view.begin())
        command.subscribe_codebooks(self, scenario, self._on_codebook)
        subscribe_reports(self, lambda node, report: self._write(
            self.view.add_report(node, report)))
        endpoints.subscribe_messages(
            self, RECEIVES, scenario.sizes, self._on_message, self._on_mismatch,
            exchange=endpoints.OBSERVATION)
        self._silence_timer = endpoints.steady_timer(self, _SILENCE_S, self._log_silence)

    @property
    def silence(self) -> str:
        """The reason why no cycle is observed."""
        domain = os.environ.get('ROS_DOMAIN_ID', '0')
        return (f'the network uses another scenario ({self.mismatch})' if self.mismatch else
                f'no cycle in the domain {domain} and the namespace {self._namespace}')

    def _log_silence(self) -> None:
        self._silence_timer.cancel()
        if not self.view.n_cycles:
            self._warn(f'{self.silence}; still waiting')

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)  # type: ignore[no-untyped-call]

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
            self._warn(f'{error}{command.OTHER_SCENARIO}')
        self.mismatch = str(error)

    def _on_codebook(self, codebook: Codebook) -> None:
        if codebook.id not in self._requested and codebook.id not in self._posteriors:
            self._requested.add(codebook.id)
            self._worker.run(functools.partial(self._posteriors.add, codebook),
                             lambda _: self._on_added(codebook))

    def _on_added(self, codebook: Codebook) -> None:
        self._requested.discard(codebook.id)
        self._bounds.run(functools.partial(self._posteriors.bound_m2, codebook),
                         functools.partial(self.view.set_bound, codebook.id))
        self._search()

    def _search(self) -> None:
        """Start the search for the modes of the latest signals, unless one is running."""
        received = self._waiting
        if (received is None or self._is_searching
                or received.codebook_id not in self._posteriors):
            return
        self._waiting, self._is_searching = None, True
        self._worker.run(functools.partial(self._posteriors.modes, received),
                         functools.partial(self._on_modes, received))

    def _on_modes(self, received: m.ReceivedSignals, found: WeightedModes | None) -> None:
        self._is_searching = False
        self._write(self.view.add_modes(received, found))
        self._search()

    def _follow_track(self, user: int) -> None:
        """Subscribe to the track of a user, which the positioner may publish."""
        if user in self._users or len(self._users) >= _MAX_TRACKS:
            return
        self._users.add(user)
        endpoints.subscribe(self, Odometry, topics.ODOMETRY.format(user=user),
                            functools.partial(self._on_track, user), endpoints.EXCHANGE)

    def _on_track(self, user: int, message: Odometry) -> None:
        point = (vector(message.pose.pose.position),
                 np.reshape(message.pose.covariance, (6, 6))[:3, :3],
                 vector(message.twist.twist.linear))
        if all(np.isfinite(field).all() for field in point):
            self._write(self.view.add_track(0, user, *point))

    def destroy_node(self) -> None:
        """End the background threads, then destroy the node."""
        self._worker.close()
        self._bounds.close()
        super().destroy_node()  # type: ignore[no-untyped-call]


def entries(
        path: Path, namespace: str, scenario: Scenario, posteriors: Posteriors,
        track_speed_mps: float | None = None, max_cycles: int = 0) -> Iterator[Entry]:
    """Yield the entries for a recording, whose codebooks are added to `posteriors`.

    If the typical speed `track_speed_mps` [m/s] is given, users are tracked. `max_cycles` limits
    the number of cycles unless it is 0. Raises RecordingError if the file is invalid, has another
    scenario, or has no cycle in the namespace.
    """
    view = NetworkView(scenario)
    for codebook, _ in command.recorded(path, namespace, scenario, [Codebook]):
        if codebook.id not in posteriors:
            posteriors.add(codebook)
            view.set_bound(codebook.id, posteriors.bound_m2(codebook))
    yield from view.begin()
    for found, time_s in command.recorded(path, namespace, scenario, [*RECEIVES, Report]):
        if isinstance(found, tuple):
            yield from view.add_report(*found)
            continue
        if found.scenario_id not in ('', scenario.id):
            raise RecordingError(
                f'{path}: recorded with scenario {found.scenario_id}, expected {scenario.id}')
        yield from view.add(found, time_s)
        if isinstance(found, m.ReceivedSignals):
            yield from view.add_modes(found, posteriors.modes(found))
            if track_speed_mps is not None and (
                    track := posteriors.track(found, time_s, track_speed_mps)):
                yield from view.add_track(
                    found.cycle_id, found.user, track.mean, track.covariance, track.velocity)
        if max_cycles and view.n_ended >= max_cycles:
            break
    if not view.n_cycles:
        raise RecordingError(f'{path}: no cycle in the namespace {namespace}')


def _conflict(options: argparse.Namespace) -> str:
    if options.file is None and (options.track or options.namespace):
        return ('arguments --track and --namespace: expected together with a recording; '
                'for a running network, --ros-args -r __ns:=/lab selects the namespace')
    if options.track_speed and not options.track:
        return 'argument --track-speed: expected together with --track'
    # Rerun recognises its files by this suffix.
    if options.save and options.save.suffix != '.rrd':
        return f"argument --save: '{options.save}', expected a name that ends with .rrd"
    return ''


def _view(options: argparse.Namespace, arguments: list[str]) -> int:
    stream = RerunStream()
    try:
        scenario = command.choose_scenario(options.config, options.file)
        posteriors = Posteriors(scenario, load_surface(str(options.calibration or ''), scenario))
        _open(stream, options)
        if options.file:
            code = _show_recording(stream, scenario, posteriors, options)
        else:
            code = _show_live(stream, scenario, posteriors, options, arguments)
        if not code:
            stream.close()
            if options.save:
                print(options.save)
        return code
    finally:
        # This has no effect after `close`.
        stream.discard()


def _open(stream: RerunStream, options: argparse.Namespace) -> None:
    if options.save:
        stream.save(options.save)
        return
    try:
        address = stream.serve(options.port, options.bind)
    except (OSError, RuntimeError) as error:
        raise ToolError(f'{options.bind}, ports {options.port} to {options.port + 2}: {error}; '
                         'choose others with --port and --bind') from None
    command.print_now(address)


def _show_live(
        stream: RerunStream, scenario: Scenario, posteriors: Posteriors,
        options: argparse.Namespace, arguments: Sequence[str]) -> int:
    # At the default of 5 ms, many messages would delay every step of the background threads.
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    code, node = command.observe(
        lambda: ViewNode(scenario, posteriors, stream.write), arguments,
        lambda node: bool(options.cycles) and node.view.n_ended >= options.cycles)
    if options.save and node and not node.view.n_cycles:
        raise ToolError(f'{options.save} is not written: {node.silence}')
    return code


def _show_recording(
        stream: RerunStream, scenario: Scenario, posteriors: Posteriors,
        options: argparse.Namespace) -> int:
    signals = collect_signals()
    stream.write(itertools.takewhile(lambda _: not signals, entries(
        options.file, options.namespace or '/', scenario, posteriors,
        (options.track_speed or Motion.speed_mps) if options.track else None,
        options.cycles)))
    while not (signals or options.save):
        time.sleep(_POLL_S)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog=_PROGRAM, description='Show a running network, or a recording, in three dimensions '
        'and in charts over the cycles: in the browser until Ctrl-C, or as a file for Rerun. ROS '
        'arguments select the namespace of a running network: --ros-args -r __ns:=/lab')
    add = parser.add_argument
    add('file', nargs='?', type=input_file, help='recording; by default the running network')
    add('--save', type=output_file, metavar='FILE',
        help='write a file for Rerun, *.rrd, instead of serving the viewer')
    add('--cycles', type=positive_int, default=0, metavar='N',
        help='show N cycles; the view of a running network then ends')
    command.add_files(parser, 'config', 'calibration')
    add = parser.add_argument_group('browser').add_argument
    add('--port', type=integer(1, 65533), default=_PORT, metavar='P',
        help=f'port of the viewer; its data use the next two (default: {_PORT})')
    add('--bind', default='127.0.0.1', metavar='ADDRESS',
        help='address that the viewer listens on; by default only this machine can connect, '
        'with 0.0.0.0 any machine can')
    add = parser.add_argument_group('recording').add_argument
    add('--namespace', help='namespace of the recorded network (default: /)')
    add('--track', action='store_true',
        help='track the users, as positioner does with prior:=track')
    add('--track-speed', type=positive_float, metavar='MPS',
        help=f'typical speed of the users for --track (default: {Motion.speed_mps:g} m/s)')
    return parser


main = command.entry(_view, _parser, _conflict)
