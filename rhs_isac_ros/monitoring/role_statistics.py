"""Counters and latencies of a role, for its diagnostics."""

import collections
import dataclasses
import types
from collections.abc import Mapping, Sequence

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import State
from rhs_isac_ros.protocol.events import Action, CodebookOffered, Event, Outcome, Send, kind_of

# Percentiles are computed over this number of latest durations.
_MAX_DURATIONS = 512
_PERCENTS = (50, 95, 99)
# Counters of what occurs without a fault.
_NO_FAULTS = {Outcome.UNANSWERED.value}
# Maximum number of reasons in a summary.
_MAX_REASONS = 3


@dataclasses.dataclass(frozen=True)
class Report:
    """Diagnostics of a node.

    Attributes
    ----------
    fault
        Whether something is missing, or something was dropped or given up since the last report.
    summary
        One line that describes the fault: what is missing, or the most frequent new faults.
    values
        Settings: ``parameter.<name>`` (in use), ``pending.<name>`` (not in use yet) and
        ``failed.<name>`` (why a change failed). Lasting faults: ``warning.<subject>``. Counts:
        ``cycles.<outcome>``, ``dropped.<reason>``, ``retries.<step>``, ``beacons.<reason>``,
        ``received.<message>`` and ``sent.<message>``. Also ``phase``, ``codebook_id`` and
        percentiles such as ``handling_ms.p95``.
    """

    fault: bool
    summary: str
    values: Mapping[str, str]


class RoleStatistics:
    """Collects the statistics of a role from its events and the resulting actions.

    Attributes
    ----------
    missing
        Descriptions of the roles that are missing.
    """

    def __init__(self) -> None:
        self._received: collections.Counter[str] = collections.Counter()
        self._sent: collections.Counter[str] = collections.Counter()
        self._served = 0
        self._codebook_id = ''
        self.missing: tuple[str, ...] = ()
        self._cycle_began_s: float | None = None
        self._durations_s: dict[str, collections.deque[float]] = collections.defaultdict(
            lambda: collections.deque(maxlen=_MAX_DURATIONS))
        self._faults: collections.Counter[str] = collections.Counter()

    def count_received(self, kind: type[m.Message]) -> None:
        """Count a received message, even if it is dropped later."""
        self._received[kind.__name__] += 1

    def record(
            self, event: Event, actions: Sequence[Action], now_s: float,
            handling_s: float) -> None:
        """Record an event and the actions with which the role responded.

        Parameters
        ----------
        event, actions
            The event, and the actions that the role returned for it.
        now_s
            Time of the event, on the clock of the role [s].
        handling_s
            Time that the role took [s].
        """
        if isinstance(event, CodebookOffered):
            self._codebook_id = event.codebook.id
        self._add_duration('handling_ms', handling_s)
        for action in actions:
            if isinstance(action, Send):
                self._sent[type(action.message).__name__] += 1
                self._record_message(action.message, now_s)

    def _record_message(self, message: m.Message, now_s: float) -> None:
        match message:
            case m.Beacon():
                self._cycle_began_s = now_s
            case m.PositionEstimate():
                self._add_duration('estimate_ms', message.latency_s)
            case m.ProtocolState(outcome='served'):
                self._served += 1
                if self._cycle_began_s is not None:
                    self._add_duration('cycle_ms', now_s - self._cycle_began_s)

    def _add_duration(self, name: str, duration_s: float) -> None:
        self._durations_s[name].append(duration_s)

    def report(
            self, phase: str, counters: Mapping[str, int], blocked: bool = False,
            status: Mapping[str, str] = types.MappingProxyType({})) -> Report:
        """Create a report; new faults are those since the previous call.

        Parameters
        ----------
        phase
            State of the role; empty if it has none.
        counters
            Counters of the role by reason.
        blocked
            Whether the role lacks something that it needs in this state.
        status
            Settings in use and pending, and lasting faults, by name.
        """
        values = {'phase': phase} if phase else {}
        values |= self._codebook_ids(status.get('codebook_id', ''))
        values |= {name: value for name, value in status.items() if name != 'codebook_id'}
        if self._served:
            values['cycles.served'] = str(self._served)
        for reason, count in sorted(counters.items()):
            values[f'{kind_of(reason).value}.{reason}'] = str(count)
        for section, counts in (('received', self._received), ('sent', self._sent)):
            values |= {f'{section}.{name}': str(count) for name, count in sorted(counts.items())}
        values |= self._percentiles()
        faults = collections.Counter(
            {reason: count for reason, count in counters.items() if reason not in _NO_FAULTS})
        new_faults, self._faults = faults - self._faults, faults
        if self.missing:
            return Report(True, f'waiting for {", ".join(self.missing)}', values)
        if blocked:
            return Report(True, f'blocked: {phase}', values)
        warnings = [text for name, text in status.items() if name.startswith('warning.')]
        if warnings:
            return Report(True, '; '.join(warnings), values)
        if new_faults:
            return Report(True, _summary(new_faults), values)
        return Report(False, 'paused' if phase == State.PAUSED.value else 'no fault', values)

    def _codebook_ids(self, in_use: str) -> dict[str, str]:
        """Return the ids of the codebook in use (at first, the offered one) and a pending one."""
        if not self._codebook_id:
            return {}
        if in_use in ('', self._codebook_id):
            return {'codebook_id': self._codebook_id}
        return {'codebook_id': in_use, 'pending.codebook_id': self._codebook_id}

    def _percentiles(self) -> dict[str, str]:
        """Return percentiles of the newest durations [ms]."""
        return {f'{name}.p{percent}': f'{1e3 * value:.3f}'
                for name, durations_s in self._durations_s.items()
                for percent, value in zip(
                    _PERCENTS, np.percentile(durations_s, _PERCENTS), strict=True)}


def _summary(faults: collections.Counter[str]) -> str:
    """Return a line with the most frequent faults, such as ``new faults: late_ack 9, stale 1``."""
    # Sorted, so that faults of equal number have a fixed order.
    ordered = sorted(faults.items(), key=lambda item: (-item[1], item[0]))
    shown = [f'{reason} {count}' for reason, count in ordered[:_MAX_REASONS]]
    others = sum(count for _, count in ordered[_MAX_REASONS:])
    return f'new faults: {", ".join([*shown, f"others {others}"] if others else shown)}'
