"""``scripts/view``: shows a network or a recording in the browser, or writes it to a file."""

import argparse
import functools
import itertools
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.node import Node

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.network_view import RECEIVES, NetworkView
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.monitoring.shapes import Entry
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import endpoints, topics
from rhs_isac_ros.ros.convert import vector
from rhs_isac_ros.ros.diagnostics import subscribe_reports
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.ros.recording import RecordingError
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_path,
    integer,
    output_file,
    positive_int,
)
from rhs_isac_ros.support.exits import on_end_signals
from rhs_isac_ros.system import add_files
from rhs_isac_ros.tools import command
from rhs_isac_ros.tools.command import ToolError
from rhs_isac_ros.tools.rerun_stream import RerunStream

# Time to wait for the first cycle before the reason for its absence is logged [s].
_SILENCE_S = 5.0
# Maximum number of tracks that the view shows, because user numbers come from messages.
_MAX_TRACKS = 64
# Minimum time between two beams [s]: their patterns take most of the computing time of a view.
_BEAM_PERIOD_S = 0.2
_PROGRAM = 'view'
_PORT = 9090
_POLL_S = 0.2


class ViewNode(Node):
    """Converts the messages in its namespace to entries, and passes them to `write`.

    At high cycle rates, the beams of some cycles are left out. `mismatch` is the error of the last
    message that did not match the scenario, or ''.
    """

    def __init__(
            self, scenario: Scenario, write: Callable[[Iterable[Entry]], None]) -> None:
        super().__init__('view', **WITHOUT_SERVICES)
        self.view = NetworkView(scenario)
        self.mismatch = ''
        # Stored, because a destroyed node has no namespace.
        self._namespace = self.get_namespace()
        self._write = write
        self._users: set[int] = set()
        self._beam_s = -math.inf
        write(self.view.begin())
        subscribe_reports(self, lambda node, report: self._write(
            self.view.add_report(node, report)))
        endpoints.subscribe_messages(
            self, RECEIVES, scenario, self._on_message, self._on_mismatch,
            exchange=endpoints.OBSERVATION)
        endpoints.once(self, _SILENCE_S, self._log_silence)

    @property
    def silence(self) -> str:
        """The reason why no cycle is observed."""
        domain = os.environ.get('ROS_DOMAIN_ID', '0')
        return (f'the network uses another scenario ({self.mismatch})' if self.mismatch else
                f'no cycle in the domain {domain} and the namespace {self._namespace}')

    def _log_silence(self) -> None:
        if not self.view.n_cycles:
            self._warn(f'{self.silence}; still waiting')

    def _warn(self, text: str) -> None:
        endpoints.log(self, text, LoggingSeverity.WARN)

    def _on_message(self, message: m.Message, arrived_s: float) -> None:
        if isinstance(message, m.Beam):
            now_s = time.monotonic()
            if now_s < self._beam_s + _BEAM_PERIOD_S:
                return
            self._beam_s = now_s
        self._write(self.view.add(message, arrived_s))
        if isinstance(message, m.PositionEstimate):
            self._follow_track(message.user)

    def _on_mismatch(self, error: m.MessageError) -> None:
        if not self.mismatch:
            self._warn(f'{error}{command.OTHER_SCENARIO}')
        self.mismatch = str(error)

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
            self._write(self.view.add_track(user, *point))


def entries(path: Path, namespace: str, scenario: Scenario, max_cycles: int | None = None
            ) -> Iterator[Entry]:
    """Yield the entries for a recording.

    `max_cycles` limits the number of cycles. Raises RecordingError if the file is invalid, has
    another scenario, or has no cycle in the namespace.
    """
    view = NetworkView(scenario)
    yield from view.begin()
    for found, time_s in _by_cycle(
            command.recorded(path, namespace, scenario, [*RECEIVES, Report])):
        if isinstance(found, tuple):
            yield from view.add_report(*found)
            continue
        if found.scenario_id not in ('', scenario.id):
            raise RecordingError(
                f'{path}: recorded with scenario {found.scenario_id}, expected {scenario.id}')
        yield from view.add(found, time_s)
        if max_cycles and view.n_ended >= max_cycles:
            break
    if not view.n_cycles:
        raise command.nothing_recorded(path, 'cycle', namespace)


def _by_cycle(found: Iterable[tuple[Any, float]]) -> list[tuple[Any, float]]:
    """Sort messages by cycle, from its beacons on: the clock of a recording may have gone back."""
    keyed, latest = [], 0
    for message, time_s in found:
        latest = getattr(message, 'cycle_id', 0) or latest
        keyed.append(((latest, not isinstance(message, m.Beacon)), (message, time_s)))
    return [pair for _, pair in sorted(keyed, key=lambda one: one[0])]


def _conflict(options: argparse.Namespace) -> str:
    if options.file is None and options.namespace:
        return command.NO_NAMESPACE
    # Rerun recognises its files by this suffix.
    if options.save and options.save.suffix != '.rrd':
        return f"argument --save: '{options.save}', expected a name that ends with .rrd"
    return ''


def _view(options: argparse.Namespace, arguments: list[str]) -> int:
    stream = RerunStream()
    try:
        scenario = command.choose_scenario(options.config, options.file, options.namespace)
        _open(stream, options)
        if options.file:
            _show_recording(stream, scenario, options)
        else:
            _show_live(stream, scenario, options, arguments)
        stream.close()
        if options.save:
            print(options.save)
        return 0
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
        stream: RerunStream, scenario: Scenario, options: argparse.Namespace,
        arguments: Sequence[str]) -> None:
    node = command.observe(
        lambda: ViewNode(scenario, stream.write), arguments,
        lambda node: bool(options.cycles) and node.view.n_ended >= options.cycles)
    if options.save and not node.view.n_cycles:
        raise ToolError(f'{options.save} is not written: {node.silence}')


def _show_recording(
        stream: RerunStream, scenario: Scenario, options: argparse.Namespace) -> None:
    signals: list[int] = []
    on_end_signals(lambda number, _: signals.append(number))
    stream.write(itertools.takewhile(lambda _: not signals, entries(
        options.file, options.namespace or '/', scenario, options.cycles)))
    while not (signals or options.save):
        time.sleep(_POLL_S)


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog=_PROGRAM, description='Show a running network, or a recording, in three dimensions '
        'and in charts over the cycles: in the browser until Ctrl-C, or as a file for Rerun.')
    add = parser.add_argument
    add('file', nargs='?', type=input_path,
        help='recording, or folder of ros2 bag record; by default the running network')
    add('--save', type=output_file, metavar='FILE',
        help='write a file for Rerun, *.rrd, instead of serving the viewer')
    add('--cycles', type=positive_int, metavar='N',
        help='show N cycles; the view of a running network then ends')
    add_files(parser, 'config')
    add = parser.add_argument_group('browser').add_argument
    add('--port', type=integer(1, 65533), default=_PORT, metavar='P',
        help=f'port of the viewer; its data use the next two (default: {_PORT})')
    add('--bind', default='127.0.0.1', metavar='ADDRESS',
        help='address that the viewer listens on; by default only this machine can connect, '
        'with 0.0.0.0 any machine can')
    add = parser.add_argument_group('recording').add_argument
    add('--namespace', help='namespace of the recorded network (default: /)')
    return parser


main = command.entry(_view, _parser, _conflict)
