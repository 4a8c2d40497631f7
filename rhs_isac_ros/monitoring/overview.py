"""Current state of a network, assembled from its messages: the model behind the live view."""

import collections
import dataclasses
import math

import numpy as np

from rhs_isac_ros.monitoring import cycle_log
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle, CycleLog
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import State
from rhs_isac_ros.protocol.user_scheduler import MAX_USERS

# Messages that the overview needs.
RECEIVES = cycle_log.RECEIVES
RESTING = 'resting'
# The rate of cycles is averaged over this time [s].
_RATE_WINDOW_S = 10.0
# Nodes report once a second; a node is silent after three missing reports.
_REPORT_TIMEOUT_S = 3.5
_MAX_NODES = 4096
# Longer strings of digits in a report are not counts.
_MAX_DIGITS = 18


@dataclasses.dataclass(frozen=True)
class Fix:
    """The latest complete cycle of a user.

    Attributes
    ----------
    received_s
        Arrival of the cycle's last message [s].
    """

    cycle: CompleteCycle
    received_s: float

    @property
    def sigma_m(self) -> float:
        """Square root of the trace of the covariance [m], to compare with the error."""
        return math.sqrt(max(np.trace(self.cycle.estimate.covariance_m2), 0.0))


@dataclasses.dataclass(frozen=True)
class NodeStatus:
    """The latest report of a node.

    Attributes
    ----------
    received_s
        Time at which the report arrived [s].
    """

    report: Report
    received_s: float

    def silent(self, now_s: float) -> bool:
        """Return whether reports are missing at the time `now_s` [s]."""
        return now_s - self.received_s > _REPORT_TIMEOUT_S

    def counts(self, section: str) -> dict[str, int]:
        """Return the nonzero counts of a section, ``dropped`` or ``cycles``, by reason."""
        counts = {key.partition('.')[2]: int(value) for key, value in self.report.values.items()
                  if key.startswith(f'{section}.') and value.isdecimal()
                  and len(value) <= _MAX_DIGITS}
        return {reason: count for reason, count in counts.items() if count}


class Overview:
    """Phase, cycles, users and nodes of one network.

    Attributes
    ----------
    phase
        Phase of the base station, `RESTING` between cycles; empty before the first message.
    phase_began_s
        Time at which the phase began [s].
    cycle_id, user
        Current cycle and its user; 0 where unknown.
    codebook_id
        Codebook of the latest signals; empty before the first.
    served, given_up
        Numbers of cycles that ended.
    last_failure
        Description of the last cycle that was given up; empty if there was none.
    began_s
        Arrival of the first message [s]; infinite before.
    users
        Latest fix of each user by id; None before the first. At most `MAX_USERS`, because the ids
        come from messages.
    nodes
        Status of each node by name; at most 4096, for the same reason.
    """

    def __init__(self) -> None:
        self.phase = ''
        self.phase_began_s = math.nan
        self.cycle_id = self.user = self.served = self.given_up = 0
        self.codebook_id = self.last_failure = ''
        self.users: dict[int, Fix | None] = {}
        self.nodes: dict[str, NodeStatus] = {}
        self._log = CycleLog()
        self._served_s: collections.deque[float] = collections.deque()
        self.began_s = math.inf

    def add(self, message: m.Message, now_s: float) -> None:
        """Add a message of one of the types `RECEIVES` that arrived at `now_s` [s]."""
        self.began_s = min(self.began_s, now_s)
        match message:
            case m.Beacon():
                self._set_phase(m.Phase.BEACONING.name.lower(), message.cycle_id, 0, now_s)
            case m.ProtocolState():
                phase = RESTING if message.outcome else message.phase.name.lower()
                self._set_phase(phase, message.cycle_id, message.user, now_s)
                if message.outcome:
                    self._end_cycle(message, now_s)
            case m.GroundTruth():
                if len(self.users) < MAX_USERS:
                    self.users.setdefault(message.user, None)
            case m.ReceivedSignals():
                self.codebook_id = message.codebook_id
        self._log.add(message, now_s)
        for cycle in self._log.complete:
            if cycle.user in self.users or len(self.users) < MAX_USERS:
                self.users[cycle.user] = Fix(cycle, now_s)
        self._log.clear()

    def add_report(self, node: str, report: Report, now_s: float) -> None:
        """Add the report of a node that arrived at `now_s` [s]."""
        if node in self.nodes or len(self.nodes) < _MAX_NODES:
            self.nodes[node] = NodeStatus(report, now_s)

    def rate_hz(self, now_s: float) -> float:
        """Return the rate of served cycles [Hz].

        It is averaged over the last ten seconds, or since the first message if that is less.
        """
        begin_s = max(now_s - _RATE_WINDOW_S, self.began_s)
        while self._served_s and self._served_s[0] < begin_s:
            self._served_s.popleft()
        return len(self._served_s) / (now_s - begin_s) if now_s > begin_s else 0.0

    @property
    def fixes(self) -> list[Fix]:
        """The fixes of all users that have one, the latest first."""
        return sorted(filter(None, self.users.values()), key=lambda fix: -fix.received_s)

    @property
    def paused(self) -> bool:
        """Whether a base station has reported a pause since the current phase began."""
        return any(status.report.values.get('phase') == State.PAUSED.value
                   and not status.received_s < self.phase_began_s
                   for status in self.nodes.values())

    def _set_phase(self, phase: str, cycle_id: int, user: int, now_s: float) -> None:
        if (phase, cycle_id) != (self.phase, self.cycle_id):
            self.phase_began_s = now_s
        self.phase, self.cycle_id, self.user = phase, cycle_id, user

    def _end_cycle(self, state: m.ProtocolState, now_s: float) -> None:
        if state.outcome == 'served':
            self.served += 1
            self._served_s.append(now_s)
        else:
            self.given_up += 1
            user = f' of user {state.user}' if state.user else ''
            self.last_failure = f'cycle {state.cycle_id}{user}: {state.outcome}'
