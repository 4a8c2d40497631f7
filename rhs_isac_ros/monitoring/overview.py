"""What a network is doing, put together from the messages on the bus: the model of a live view."""

import collections
import dataclasses
import math

import numpy as np

from rhs_isac_ros.monitoring import cycle_log
from rhs_isac_ros.monitoring.cycle_log import CycleLog, CycleRecord
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.protocol import messages as m

# Messages that the overview needs.
RECEIVES = cycle_log.RECEIVES
RESTING = 'resting'
# Cycles in a second are those that ended in the newest so many seconds.
_WINDOW_S = 10.0
# A node tells of itself once a second; one that misses three reports is silent.
_SILENT_S = 3.5
# A longer number is no count.
_MOST_DIGITS = 18


@dataclasses.dataclass(frozen=True)
class Fix:
    """The newest complete cycle of a user.

    Attributes
    ----------
    record
        The cycle.
    seen_s
        When it was complete [s].
    """

    record: CycleRecord
    seen_s: float

    @property
    def sigma_m(self) -> float:
        """Root of the trace of the covariance [m], to which the error compares."""
        return math.sqrt(max(np.trace(self.record.estimate.covariance_m2), 0.0))


@dataclasses.dataclass(frozen=True)
class NodeHealth:
    """What a node told of itself.

    Attributes
    ----------
    report
        The newest report.
    seen_s
        When it came [s].
    """

    report: Report
    seen_s: float

    def silent(self, now_s: float) -> bool:
        """Tell whether reports are missing.

        Parameters
        ----------
        now_s
            The time [s].

        Returns
        -------
        bool
            True if it should have told of itself again.
        """
        return now_s - self.seen_s > _SILENT_S

    def counts(self, section: str) -> dict[str, int]:
        """Return what the node counted.

        Parameters
        ----------
        section
            ``dropped`` or ``cycles``.

        Returns
        -------
        dict
            Counts by reason, without those that are 0.
        """
        found = {name.partition('.')[2]: int(value) for name, value in self.report.values.items()
                 if name.startswith(f'{section}.') and value.isdecimal()
                 and len(value) <= _MOST_DIGITS}
        return {reason: n for reason, n in found.items() if n}


class Overview:
    """Phase, cycles, users and nodes of one network.

    Attributes
    ----------
    phase
        Phase of the base station, `RESTING` between cycles; empty before anything was heard.
    since_s
        When that phase was seen to begin [s].
    cycle_id, user
        The cycle, and whose it is; 0 where not known.
    codebook_id
        Codebook of the newest signals; empty before the first.
    served, given_up
        How many cycles ended.
    failure
        Why a cycle was given up last; empty if none was.
    began_s
        When the first message was heard [s]; infinite before.
    users
        Newest fix of each user by number; None before the first.
    nodes
        RoleStatistics of each node by its name.
    """

    def __init__(self) -> None:
        self.phase = ''
        self.since_s = math.nan
        self.cycle_id = self.user = self.served = self.given_up = 0
        self.codebook_id = self.failure = ''
        self.users: dict[int, Fix | None] = {}
        self.nodes: dict[str, NodeHealth] = {}
        self._log = CycleLog()
        self._ends_s: collections.deque[float] = collections.deque()
        self.began_s = math.inf

    def add(self, message: m.Message, now_s: float) -> None:
        """Take a message.

        Parameters
        ----------
        message
            One of `RECEIVES`.
        now_s
            When it was heard [s].
        """
        self.began_s = min(self.began_s, now_s)
        match message:
            case m.Beacon():
                self._enter(m.Phase.BEACONING.name.lower(), message.cycle_id, 0, now_s)
            case m.ProtocolState():
                phase = RESTING if message.outcome else message.phase.name.lower()
                self._enter(phase, message.cycle_id, message.user, now_s)
                if message.outcome:
                    self._end(message, now_s)
            case m.GroundTruth():
                self.users.setdefault(message.user, None)
            case m.ReceivedSignals():
                self.codebook_id = message.codebook_id
        self._log.add(message, now_s)
        self._file(now_s)

    def _enter(self, phase: str, cycle_id: int, user: int, now_s: float) -> None:
        if (phase, cycle_id) != (self.phase, self.cycle_id):
            self.since_s = now_s
        self.phase, self.cycle_id, self.user = phase, cycle_id, user

    def _end(self, state: m.ProtocolState, now_s: float) -> None:
        if state.outcome == 'served':
            self.served += 1
            self._ends_s.append(now_s)
        else:
            self.given_up += 1
            whose = f' of user {state.user}' if state.user else ''
            self.failure = f'cycle {state.cycle_id}{whose}: {state.outcome}'

    def _file(self, now_s: float) -> None:
        """Take what the log has completed, so that it does not grow."""
        for record in self._log.complete:
            self.users[record.user] = Fix(record, now_s)
        self._log.complete.clear()
        self._log.given_up.clear()

    def hear(self, node: str, report: Report, now_s: float) -> None:
        """Take what a node tells of itself.

        Parameters
        ----------
        node
            Its name.
        report
            The report.
        now_s
            When it was heard [s].
        """
        self.nodes[node] = NodeHealth(report, now_s)

    def rate_hz(self, now_s: float) -> float:
        """Return how many cycles are served in a second.

        Parameters
        ----------
        now_s
            The time [s].

        Returns
        -------
        float
            Mean over the newest ten seconds, or over all since the first message [Hz].
        """
        begin_s = max(now_s - _WINDOW_S, self.began_s)
        while self._ends_s and self._ends_s[0] < begin_s:
            self._ends_s.popleft()
        return len(self._ends_s) / (now_s - begin_s) if now_s > begin_s else 0.0

    @property
    def fixes(self) -> list[Fix]:
        """The fixes of all users that have one, the newest first."""
        return sorted(filter(None, self.users.values()), key=lambda fix: -fix.seen_s)
