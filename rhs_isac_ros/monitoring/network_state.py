"""State of a network from its messages: `Overview` for the terminal, `SceneState` for pictures."""

import collections
import dataclasses
import math
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.monitoring.cycle_log import CompleteCycle, CycleLog
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState
from rhs_isac_ros.protocol.ground_truth import TruePositions
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.support.fields import finite

RESTING = BsState.RESTING.value
# Time over which the rate of cycles is averaged [s].
_RATE_WINDOW_S = 10.0
# Nodes report once a second. A node counts as silent after three missing reports.
_REPORT_TIMEOUT_S = 3.5
_MAX_NODES = 4096
# Longer strings of digits in a report are not counts.
_MAX_DIGITS = 18


class NodeStatus(NamedTuple):
    """The latest report of a node, and the time of its arrival [s]."""

    report: Report
    received_s: float

    def silent(self, now_s: float) -> bool:
        """Return whether the node has stopped reporting, at the time `now_s` [s]."""
        return now_s - self.received_s > _REPORT_TIMEOUT_S

    def counts(self, section: str) -> dict[str, int]:
        """Return the nonzero counts of a section, ``dropped`` or ``cycles``, by reason."""
        counts = {key.partition('.')[2]: int(value) for key, value in self.report.details.items()
                  if key.startswith(f'{section}.') and value.isdecimal()
                  and len(value) <= _MAX_DIGITS}
        return {reason: count for reason, count in counts.items() if count}


class Overview:
    """Phase, cycles, users and nodes of one network; unknown values are 0, NaN, empty or None.

    `phase` is the phase of the base station, or `RESTING` between cycles. `codebook_id` belongs to
    the latest signals. `users` holds the latest complete cycle of each user by id, and `nodes` the
    status of each node by name. Both are limited in size, because the keys come from messages.
    """

    def __init__(self) -> None:
        self.phase = ''
        self.phase_began_s = math.nan
        self.cycle_id = self.user = self.served = self.given_up = 0
        self.codebook_id = self.last_failure = ''
        self.users: dict[int, CompleteCycle | None] = {}
        self.nodes: dict[str, NodeStatus] = {}
        self._log = CycleLog()
        self._served_s: collections.deque[float] = collections.deque()
        # Arrival of the first message [s]; infinite before it.
        self.began_s = math.inf

    def add(self, message: m.Message, now_s: float) -> None:
        """Add a message whose type is in `cycle_log.RECEIVES`; it arrived at `now_s` [s]."""
        self.began_s = min(self.began_s, finite('now_s', now_s))
        match message:
            case m.Beacon():
                self._set_phase(m.Phase.BEACONING.name.lower(), message.cycle_id, 0, now_s)
            case m.ProtocolState():
                phase = RESTING if message.outcome else message.phase.name.lower()
                self._set_phase(phase, message.cycle_id, message.user, now_s)
                if message.outcome == 'served':
                    self.served += 1
                    self._served_s.append(now_s)
                elif message.outcome:
                    self.given_up += 1
                    user = f' of user {message.user}' if message.user else ''
                    self.last_failure = f'cycle {message.cycle_id}{user}: {message.outcome}'
            case m.GroundTruth():
                if len(self.users) < MAX_USERS:
                    self.users.setdefault(message.user, None)
            case m.ReceivedSignals():
                self.codebook_id = message.codebook_id
        self._log.add(message, now_s)
        for cycle in self._log.complete:
            if cycle.user in self.users:
                self.users[cycle.user] = cycle
        self._log.clear()

    def add_report(self, node: str, report: Report, now_s: float) -> None:
        """Add a report of a node; the report arrived at `now_s` [s]."""
        if node in self.nodes or len(self.nodes) < _MAX_NODES:
            self.nodes[node] = NodeStatus(report, finite('now_s', now_s))

    def rate_hz(self, now_s: float) -> float:
        """Return the rate of served cycles over the last 10 s, or since the first message [Hz]."""
        begin_s = max(now_s - _RATE_WINDOW_S, self.began_s)
        while self._served_s and self._served_s[0] < begin_s:
            self._served_s.popleft()
        return len(self._served_s) / (now_s - begin_s) if now_s > begin_s else 0.0

    @property
    def paused(self) -> bool:
        """Whether a base station has reported a pause since the current phase began."""
        return any(status.report.details.get('phase') == BsState.PAUSED.value
                   and not status.received_s < self.phase_began_s
                   for status in self.nodes.values())

    def _set_phase(self, phase: str, cycle_id: int, user: int, now_s: float) -> None:
        if (phase, cycle_id) != (self.phase, self.cycle_id):
            self.phase_began_s = now_s
        self.phase, self.cycle_id, self.user = phase, cycle_id, user


# Types of the messages that the state of the scene uses.
SCENE_RECEIVES = (m.RhsConfiguration, m.GroundTruth, m.GroundTruths, m.PositionEstimate, m.Beam)
# Maximum number of positions in a path; minimum distance between consecutive true ones [m].
_MAX_PATH_LENGTH = 200
_MIN_STEP_M = 0.05


def new_path() -> collections.deque[np.ndarray]:
    """Return an empty path, which keeps the latest 200 positions."""
    return collections.deque(maxlen=_MAX_PATH_LENGTH)


@dataclasses.dataclass
class SceneUser:
    """True position, estimate and paths of one user; a path lists positions from old to new."""

    user: int
    updated_s: float  # arrival of the latest message about the user [s]
    truth: m.GroundTruth | None = None
    estimate: m.PositionEstimate | None = None
    true_path: collections.deque[np.ndarray] = dataclasses.field(default_factory=new_path)
    estimated_path: collections.deque[np.ndarray] = dataclasses.field(default_factory=new_path)
    # Those of the latest cycle.
    _truths: TruePositions = dataclasses.field(default_factory=lambda: TruePositions(1))

    @property
    def error_m(self) -> float:
        """Distance of the estimate from the true position of the cycle [m]; NaN if unknown."""
        truth, estimate = self._truths.of(self.estimate), self.estimate
        if truth is None or estimate is None:
            return math.nan
        return float(np.linalg.norm(estimate.position - truth.position))

    def add(self, message: m.GroundTruth | m.PositionEstimate, now_s: float) -> None:
        """Add a true position or an estimate that arrived at `now_s` [s]."""
        self.updated_s = now_s
        if isinstance(message, m.PositionEstimate):
            self.estimate = message
            self.estimated_path.append(message.position)
            return
        self.truth = message
        self._truths.add(message)
        if not self.true_path or math.dist(self.true_path[-1], message.position) > _MIN_STEP_M:
            self.true_path.append(message.position)


class SceneState:
    """The configuration of the surface, the latest beam, and the users by id.

    There are at most `MAX_USERS` users, because their ids come from messages. Further users are
    ignored until others are discarded.
    """

    def __init__(self) -> None:
        self.configuration: m.RhsConfiguration | None = None
        self.beam: m.Beam | None = None
        self.users: dict[int, SceneUser] = {}
        self._beam_s = math.nan

    def add(self, message: m.Message, now_s: float) -> None:
        """Add a message whose type is in `SCENE_RECEIVES`; it arrived at `now_s` [s]."""
        now_s = finite('now_s', now_s)
        match message:
            case m.RhsConfiguration():
                self.configuration = message
            case m.Beam():
                self.beam, self._beam_s = message, now_s
            case m.GroundTruths():
                for truth in message.each():
                    self.add(truth, now_s)
            case m.GroundTruth() | m.PositionEstimate():
                if message.user in self.users or len(self.users) < MAX_USERS:
                    self.users.setdefault(message.user, SceneUser(message.user, now_s)).add(
                        message, now_s)

    def discard_stale(self, before_s: float) -> list[int]:
        """Discard users without a message since `before_s` [s], and return their ids.

        Also discard the beam if it is as old, or if it is directed to one of these users.
        """
        stale = [user for user, state in self.users.items() if state.updated_s < before_s]
        for user in stale:
            del self.users[user]
        if self.beam is not None and (self.beam.user in stale or self._beam_s < before_s):
            self.beam = None
        return stale

    @property
    def drawable(self) -> bool:
        """Whether the configuration of the surface, an estimate and its beam are known."""
        return self.configuration is not None and self.shown_beam is not None

    @property
    def complete(self) -> bool:
        """Whether the scene is drawable and every user has an estimate."""
        return self.drawable and not self.without_estimate

    @property
    def without_estimate(self) -> list[int]:
        """Sorted ids of the users without an estimate."""
        return sorted(user for user, state in self.users.items() if not state.estimate)

    @property
    def shown_user(self) -> SceneUser | None:
        """User of the latest beam if its cycle has an estimate, else of the latest estimate."""
        state = self.users.get(self.beam.user) if self.beam else None
        if state and state.estimate and self.beam and (
                state.estimate.cycle_id == self.beam.cycle_id):
            return state
        cycles = [(state.estimate.cycle_id, user) for user, state in self.users.items()
                  if state.estimate]
        return self.users[max(cycles)[1]] if cycles else None

    @property
    def shown_beam(self) -> m.Beam | None:
        """The beam of the cycle that located the shown user; None if it is unknown."""
        shown, beam = self.shown_user, self.beam
        if shown and shown.estimate and beam and (
                (shown.user, shown.estimate.cycle_id) == (beam.user, beam.cycle_id)):
            return beam
        return None
