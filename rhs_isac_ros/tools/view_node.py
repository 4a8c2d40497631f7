"""The node of a view of a running network."""

import functools
import math
import os
import time
from collections.abc import Callable, Iterable

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.node import Node

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.entities import Entry
from rhs_isac_ros.monitoring.network_view import RECEIVES, NetworkView, TrackPoint
from rhs_isac_ros.positioning import WeightedModes
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, diagnostics, qos, topics
from rhs_isac_ros.ros.background import BackgroundWorker
from rhs_isac_ros.ros.early import WITHOUT_SERVICES
from rhs_isac_ros.ros.endpoints import steady_timer, subscribe, subscribe_messages
from rhs_isac_ros.tools.view_posteriors import Posteriors

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
        subscribe(self, ros.Codebook, topics.CODEBOOK, self._on_codebook, qos.LATCHED)
        subscribe(self, DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, qos.EXCHANGE)
        subscribe_messages(self, RECEIVES, scenario.sizes, self._on_message, self._on_mismatch,
                           exchange=qos.OBSERVATION)
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

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for node, report in diagnostics.from_ros(message):
            self._write(self.view.add_report(node, report))

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
                  functools.partial(self._on_track, user), qos.EXCHANGE)

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
