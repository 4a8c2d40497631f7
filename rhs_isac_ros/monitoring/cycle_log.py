"""Records of the cycles of a network, and of its signals, assembled from messages."""

import dataclasses
import math
from typing import TypeAlias

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Outcome
from rhs_isac_ros.protocol.ground_truth import TruePositions
from rhs_isac_ros.support.fields import finite

# Maximum number of incomplete cycles; the missing messages of older ones will not arrive.
_MAX_OPEN_CYCLES = 16
# Types of the messages that the log uses.
RECEIVES = (m.Beacon, m.GroundTruth, m.ReceivedSignals, m.PositionEstimate, m.Capacity,
            m.ProtocolState)
# Types of the messages that answer received signals.
ANSWERS = (m.PositionEstimate, m.NoFix)
# Cycle and user.
Key: TypeAlias = tuple[int, int]


@dataclasses.dataclass
class CycleTimes:
    """Start and end of a cycle, as received by a subscriber [s]; NaN if missing."""

    cycle_id: int
    user: int = 0  # 0 before the grant
    began_s: float = math.nan  # last beacon before the grant
    ended_s: float = math.nan  # outcome
    # The latest state, with the times that the base station measured.
    state: m.ProtocolState | None = None

    @property
    def duration_s(self) -> float:
        """Time from the last beacon to the outcome at the base station [s]; NaN if unknown."""
        return self.state.elapsed_s if self.state and self.state.outcome else math.nan

    def durations_s(self) -> dict[m.Phase, float]:
        """Return the duration of each phase that began, as measured by the base station [s].

        The sum of the durations is `duration_s`. Without a state, the result is empty.
        """
        if self.state is None:
            return {}
        starts_s = {phase: float(start_s) for phase, start_s in zip(
            m.Phase, self.state.began_s, strict=True) if math.isfinite(start_s)}
        return dict(zip(starts_s, np.diff([*starts_s.values(), self.duration_s]).tolist(),
                        strict=True))


@dataclasses.dataclass
class CompleteCycle(CycleTimes):
    """A cycle that was served, with all its messages."""

    _: dataclasses.KW_ONLY
    truth: m.GroundTruth
    signals: m.ReceivedSignals
    estimate: m.PositionEstimate
    capacity: m.Capacity

    @property
    def error_m(self) -> float:
        """Distance of the estimate from the true position [m]."""
        return float(np.linalg.norm(self.estimate.position - self.truth.position))

    @property
    def sigma_m(self) -> float:
        """Square root of the trace of the covariance [m], comparable with the error."""
        return math.sqrt(max(np.trace(self.estimate.covariance_m2), 0.0))


@dataclasses.dataclass
class CycleRecord(CycleTimes):
    """A cycle that may be running, given up or incomplete; missing messages are None."""

    outcome: str = ''  # served, or the reason why it was given up; empty while it runs
    truths: TruePositions = dataclasses.field(default_factory=TruePositions)
    signals: m.ReceivedSignals | None = None
    estimate: m.PositionEstimate | None = None
    capacity: m.Capacity | None = None

    @property
    def truth(self) -> m.GroundTruth | None:
        """True position, as sent by the node of the located user; None if unknown."""
        return self.truths.of(self.estimate or self.signals)

    def completed(self) -> CompleteCycle | None:
        """Return the complete cycle, or None if it was not served or a message is missing."""
        truth = self.truth
        if (self.outcome != 'served' or truth is None or self.signals is None
                or self.estimate is None or self.capacity is None):
            return None
        return CompleteCycle(
            self.cycle_id, self.user, self.began_s, self.ended_s, self.state,
            truth=truth, signals=self.signals, estimate=self.estimate, capacity=self.capacity)


class CycleLog:
    """Collects the cycles of one network, even if its base station restarts.

    `ended` lists the cycles that have ended, in order; `complete` lists the served cycles whose
    messages have all arrived. `clear` empties both lists.
    """

    def __init__(self) -> None:
        self.complete: list[CompleteCycle] = []
        self.ended: list[CycleRecord] = []
        self._open: dict[int, CycleRecord] = {}

    @property
    def given_up(self) -> list[CycleRecord]:
        """Cycles that ended without being served."""
        return [record for record in self.ended if record.outcome != 'served']

    @property
    def failed(self) -> list[CycleRecord]:
        """Cycles that were given up for any reason except ``no_fix``, which is not a fault."""
        return [record for record in self.given_up if record.outcome != Outcome.NO_FIX.value]

    def add(self, message: m.Message, now_s: float) -> None:
        """Add a message of a type in `RECEIVES`, which arrived at `now_s` [s], to its cycle."""
        now_s = finite('now_s', now_s)
        if not message.cycle_id:
            return
        if isinstance(message, m.Beacon):
            self._begin(message, now_s)
            return
        record = self._open.get(message.cycle_id)
        if record is None:
            return
        match message:
            case m.GroundTruth():
                record.truths.add(message)
            case m.ReceivedSignals():
                record.signals = message
            case m.PositionEstimate():
                record.estimate = message
            case m.Capacity():
                record.capacity = message
            case m.ProtocolState():
                record.user, record.state = message.user, message
                if message.outcome:
                    if not record.outcome:
                        self.ended.append(record)
                    record.outcome, record.ended_s = message.outcome, now_s
        if cycle := record.completed():
            self.complete.append(cycle)
        if cycle or record.outcome not in ('', 'served'):
            del self._open[record.cycle_id]

    def cut(self, end_s: float) -> None:
        """Remove the cycles that ended after `end_s` [s] from both lists."""
        self.complete[:] = [cycle for cycle in self.complete if cycle.ended_s <= end_s]
        self.ended[:] = [record for record in self.ended if record.ended_s <= end_s]

    def clear(self) -> None:
        """Empty the lists `complete` and `ended`."""
        self.complete.clear()
        self.ended.clear()

    def _begin(self, beacon: m.Beacon, now_s: float) -> None:
        record = self._open.get(beacon.cycle_id)
        if record is None or record.outcome or not beacon.attempt:
            self._open[beacon.cycle_id] = CycleRecord(beacon.cycle_id, began_s=now_s)
        else:
            record.began_s = now_s
        while len(self._open) > _MAX_OPEN_CYCLES:
            del self._open[next(iter(self._open))]


class SignalLog:
    """Collects the signals of one network, with true positions, answers and codebooks.

    Unlike `CycleLog`, it keeps cycles without a fix, and cycles whose other messages are missing.
    The arrival of a message or a codebook is a time as in `CycleLog.add`.
    """

    #: Types of the messages that the log uses.
    RECEIVES = (m.GroundTruth, m.ReceivedSignals, *ANSWERS, m.ProtocolState)

    def __init__(self) -> None:
        self.signals: dict[Key, m.ReceivedSignals] = {}
        self.arrived_s: dict[Key, float] = {}  # Arrival of the signals.
        self.estimates: dict[Key, m.PositionEstimate] = {}
        self.codebooks: dict[str, Codebook] = {}
        #: Cycles that were answered, or that ended without being served.
        self.ended: set[Key] = set()
        self.truths = TruePositions()

    def add(self, found: m.Message | Codebook, arrived_s: float = math.nan) -> None:
        """Add a codebook, or a message whose type is in `RECEIVES`."""
        if isinstance(found, Codebook):
            self.codebooks[found.id] = found
            return
        key = found.cycle_id, getattr(found, 'user', 0)
        match found:
            case m.GroundTruth():
                self.truths.add(found)
            case m.ReceivedSignals():
                self.signals[key], self.arrived_s[key] = found, arrived_s
            case m.PositionEstimate():
                self.estimates[key] = found
        if isinstance(found, ANSWERS) or isinstance(
                found, m.ProtocolState) and found.outcome not in ('', 'served'):
            self.ended.add(key)
