"""Counters and latencies of a role, for its diagnostics."""

import collections
import dataclasses
import types
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState
from rhs_isac_ros.protocol.events import Action, CodebookOffered, Event, Outcome, Send, kind_of

# Number of latest durations from which percentiles are computed.
_MAX_DURATIONS = 512
_PERCENTS = (50, 95, 99)
# Counters that do not indicate faults.
_NO_FAULTS = {Outcome.UNANSWERED.value}
# Maximum number of reasons in a summary.
_MAX_REASONS = 3


@dataclasses.dataclass(frozen=True)
class Report:
    """Diagnostics of a node: whether there is a fault, a one-line summary, and details.

    `fault` is True if a fault persists or has occurred since the last report.
    ``docs/interfaces.rst`` lists the keys of the details.
    """

    fault: bool
    summary: str
    details: Mapping[str, str]


class RoleStatistics:
    """Collects the statistics of a role from its events and the resulting actions.

    The role may use a codebook of a `library`, given by their ids, while none is pending.
    """

    def __init__(self, library: Collection[str] = ()) -> None:
        self._library = library
        # Descriptions of the roles that are missing.
        self.missing: tuple[str, ...] = ()
        # Number of messages by section of the report and by type; faults until the last report.
        self._messages: dict[str, collections.Counter[str]] = {
            'received': collections.Counter(), 'sent': collections.Counter()}
        self._faults: collections.Counter[str] = collections.Counter()
        self._served = 0
        self._codebook_id = ''
        self._durations_s: dict[str, collections.deque[float]] = collections.defaultdict(
            lambda: collections.deque(maxlen=_MAX_DURATIONS))

    def count_received(self, kind: type[m.Message]) -> None:
        """Count a received message, even if it is dropped later."""
        self._messages['received'][kind.__name__] += 1

    def record(self, event: Event, actions: Sequence[Action], handling_s: float) -> None:
        """Record an event, the actions that it caused, and the time taken to handle it [s]."""
        if isinstance(event, CodebookOffered):
            self._codebook_id = event.codebook.id
        self._durations_s['handling_ms'].append(handling_s)
        for action in actions:
            if not isinstance(action, Send):
                continue
            message = action.message
            self._messages['sent'][type(message).__name__] += 1
            if isinstance(message, m.PositionEstimate):
                self._durations_s['estimate_ms'].append(message.latency_s)
            elif isinstance(message, m.ProtocolState) and message.outcome == 'served':
                self._served += 1
                self._durations_s['cycle_ms'].append(message.elapsed_s)

    def report(
            self, phase: str, counters: Mapping[str, int], blocked: bool = False,
            status: Mapping[str, str] = types.MappingProxyType({})) -> Report:
        """Create a report, with the faults since the previous call.

        `phase` is the state of the role, and `blocked` whether the role lacks something in this
        state. `status` contains the status of the role and the conflicts of the node.
        """
        details = {'phase': phase} if phase else {}
        details |= self._codebook_ids(status.get('codebook_id', ''))
        details |= {name: value for name, value in status.items() if name != 'codebook_id'}
        if self._served:
            details['cycles.served'] = str(self._served)
        for reason, count in sorted(counters.items()):
            details[f'{kind_of(reason).value}.{reason}'] = str(count)
        for section, counts in self._messages.items():
            details |= {f'{section}.{name}': str(count) for name, count in sorted(counts.items())}
        for name, durations_s in self._durations_s.items():
            for percent, value_s in zip(
                    _PERCENTS, np.percentile(durations_s, _PERCENTS), strict=True):
                details[f'{name}.p{percent}'] = f'{1e3 * value_s:.3f}'
        faults = collections.Counter(
            {reason: count for reason, count in counters.items() if reason not in _NO_FAULTS})
        new_faults, self._faults = faults - self._faults, faults
        conflicts, warnings = ([text for name, text in status.items() if name.startswith(kind)]
                               for kind in ('conflict.', 'warning.'))
        # The most important one.
        fault = ('; '.join(conflicts)
                 or self.missing and f'waiting for {", ".join(self.missing)}'
                 or blocked and f'blocked: {phase}'
                 or '; '.join(warnings)
                 or new_faults and _summary(new_faults))
        summary = fault or ('paused' if phase == BsState.PAUSED.value else 'no fault')
        return Report(bool(fault), summary, details)

    def _codebook_ids(self, in_use: str) -> dict[str, str]:
        """Return the ids of the codebook in use (or else the latest one) and of a pending one."""
        if not self._codebook_id:
            return {}
        if in_use in ('', self._codebook_id, *self._library):
            return {'codebook_id': in_use or self._codebook_id}
        return {'codebook_id': in_use, 'pending.codebook_id': self._codebook_id}


def _summary(faults: collections.Counter[str]) -> str:
    """Return a line with the most frequent faults, such as ``new faults: late_ack 9, stale 1``."""
    # Equally frequent faults are in alphabetical order.
    ordered = sorted(faults.items(), key=lambda item: (-item[1], item[0]))
    shown = [f'{reason} {count}' for reason, count in ordered[:_MAX_REASONS]]
    others = sum(count for _, count in ordered[_MAX_REASONS:])
    return f'new faults: {", ".join([*shown, f"others {others}"] if others else shown)}'
