"""What became of each cycle, put together from the messages on the bus."""

import dataclasses
import math

import numpy as np

from rhs_isac_ros.protocol import messages as m

# Cycles that may still lack a message; of older ones it does not come any more.
_MOST_OPEN = 16
# Messages that the log needs.
RECEIVES = (m.Beacon, m.GroundTruth, m.ReceivedSignals, m.PositionEstimate, m.Capacity,
            m.ProtocolState)


@dataclasses.dataclass
class CycleRecord:
    """One cycle, as seen from outside.

    Attributes
    ----------
    cycle_id, user
        Which cycle, and whose.
    began_s
        When the last beacon before the grant was seen [s].
    phase_s
        When each later phase was seen to begin [s].
    ended_s
        When the end was seen [s]; NaN before.
    outcome
        ``served``, or why the cycle was given up; empty while it runs.
    truth, signals, estimate, capacity
        The messages of the cycle, None if not seen.
    """

    cycle_id: int
    user: int = 0
    began_s: float = math.nan
    phase_s: dict[m.Phase, float] = dataclasses.field(default_factory=dict)
    ended_s: float = math.nan
    outcome: str = ''
    truth: m.GroundTruth | None = None
    signals: m.ReceivedSignals | None = None
    estimate: m.PositionEstimate | None = None
    capacity: m.Capacity | None = None

    @property
    def complete(self) -> bool:
        """Whether the cycle was served and every message of it was seen."""
        parts = (self.truth, self.signals, self.estimate, self.capacity)
        return self.outcome == 'served' and all(part is not None for part in parts)

    @property
    def error_m(self) -> float:
        """Distance of the estimate from the true position [m]; NaN if not known."""
        if self.truth is None or self.estimate is None:
            return math.nan
        return float(np.linalg.norm(self.estimate.position - self.truth.position))

    def durations_s(self) -> dict[m.Phase, float]:
        """Return how long each phase took.

        Returns
        -------
        dict
            Durations by phase [s]; phases that were not seen are left out.
        """
        marks = [(m.Phase.BEACONING, self.began_s), *sorted(self.phase_s.items())]
        ends = [start for _, start in marks[1:]] + [self.ended_s]
        return {phase: end - start for (phase, start), end in zip(marks, ends, strict=True)}


class CycleLog:
    """Collects the cycles of one network, also across restarts of its base station.

    Attributes
    ----------
    complete
        Cycles that were served and seen whole, in their order.
    given_up
        Cycles that ended without being served.
    """

    def __init__(self) -> None:
        self.complete: list[CycleRecord] = []
        self.given_up: list[CycleRecord] = []
        self._open: dict[int, CycleRecord] = {}

    def add(self, message: m.Message, now_s: float) -> None:
        """Take a message.

        Parameters
        ----------
        message
            One of `RECEIVES`.
        now_s
            When it was seen [s].
        """
        if message.cycle_id == 0:
            return
        if isinstance(message, m.Beacon):
            self._begin(message, now_s)
            return
        record = self._open.get(message.cycle_id)
        if record is None:
            return
        match message:
            case m.GroundTruth():
                record.truth = message
            case m.ReceivedSignals():
                record.signals = message
            case m.PositionEstimate():
                record.estimate = message
            case m.Capacity():
                record.capacity = message
            case m.ProtocolState() if message.outcome:
                record.outcome, record.ended_s = message.outcome, now_s
            case m.ProtocolState():
                record.user = message.user
                record.phase_s[message.phase] = now_s
        self._close(record)

    def _begin(self, beacon: m.Beacon, now_s: float) -> None:
        known = self._open.get(beacon.cycle_id)
        if known is None or known.outcome or not beacon.attempt:
            self._open[beacon.cycle_id] = CycleRecord(beacon.cycle_id, began_s=now_s)
        else:
            known.began_s = now_s
        while len(self._open) > _MOST_OPEN:
            del self._open[next(iter(self._open))]

    def _close(self, record: CycleRecord) -> None:
        """File a record once nothing of it is missing."""
        if record.complete:
            self.complete.append(record)
        elif record.outcome not in ('', 'served'):
            self.given_up.append(record)
        else:
            return
        del self._open[record.cycle_id]
