"""How a role fares: what it has done, what it has dropped, and how long that took."""

import collections
import dataclasses
import types
from collections.abc import Mapping, Sequence

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, CodebookOffered, Event, PeersChanged, Send
from rhs_isac_ros.protocol.outcomes import Outcome, kind_of

# Durations of which percentiles are told: the newest so many.
_NEWEST = 512
_PERCENTS = (50, 95, 99)


@dataclasses.dataclass(frozen=True)
class Report:
    """How a role fares.

    Attributes
    ----------
    fault
        Whether something is missing, or was dropped or given up since the last report.
    summary
        The same in words.
    values
        Everything by name: ``phase``, ``codebook_id``, ``parameter.<name>`` in use,
        ``pending.<name>`` that waits, ``failed.<name>`` that came to nothing,
        ``cycles.<outcome>``, ``dropped.<reason>``, ``retries.<step>``, ``beacons.<reason>``,
        ``received.<message>``, ``sent.<message>`` and percentiles such as ``handling_ms.p95``.
    """

    fault: bool
    summary: str
    values: Mapping[str, str]


class RoleStatistics:
    """Keeps the books of a role, from outside: it sees each event and what comes of it."""

    def __init__(self) -> None:
        self._received: collections.Counter[str] = collections.Counter()
        self._sent: collections.Counter[str] = collections.Counter()
        self._served = 0
        self._codebook_id = ''
        self._missing: tuple[str, ...] = ()
        self._lacks: set[str] = set()
        self._began_s: float | None = None
        self._durations_s: dict[str, collections.deque[float]] = {}
        self._faults = 0

    def lack(self, what: str, lacks: bool) -> None:
        """Enter something that the role can do without, for a while.

        Parameters
        ----------
        what
            Its name.
        lacks
            Whether it is missing now.
        """
        (self._lacks.add if lacks else self._lacks.discard)(what)

    def receive(self, kind: type[m.Message]) -> None:
        """Count a message that has come, whatever becomes of it.

        Parameters
        ----------
        kind
            Its class.
        """
        self._received[kind.__name__] += 1

    def note(
            self, event: Event, actions: Sequence[Action], now_s: float,
            handling_s: float) -> None:
        """Enter an event and what a role answers to it.

        Parameters
        ----------
        event
            The event.
        actions
            The answer.
        now_s
            The time of the event, on the clock of the role [s].
        handling_s
            How long the role took [s].
        """
        match event:
            case CodebookOffered(codebook):
                self._codebook_id = codebook.id
            case PeersChanged(missing):
                self._missing = missing
        self._add('handling_ms', handling_s)
        for action in actions:
            if isinstance(action, Send):
                self._sent[type(action.message).__name__] += 1
                self._note_message(action.message, now_s)

    def _note_message(self, message: m.Message, now_s: float) -> None:
        match message:
            case m.Beacon():
                self._began_s = now_s
            case m.PositionEstimate():
                self._add('estimate_ms', message.latency_s)
            case m.ProtocolState(outcome='served'):
                self._served += 1
                if self._began_s is not None:
                    self._add('cycle_ms', now_s - self._began_s)

    def _codebooks(self, in_use: str) -> dict[str, str]:
        """Tell the codebook in use, or the one to begin with, and the one that waits."""
        if not self._codebook_id:
            return {}
        if in_use in ('', self._codebook_id):
            return {'codebook_id': self._codebook_id}
        return {'codebook_id': in_use, 'pending.codebook_id': self._codebook_id}

    def _add(self, name: str, duration_s: float) -> None:
        self._durations_s.setdefault(name, collections.deque(maxlen=_NEWEST)).append(duration_s)

    def report(
            self, phase: str, counters: Mapping[str, int], lacking: bool = False,
            standing: Mapping[str, str] = types.MappingProxyType({})) -> Report:
        """Tell how the role fares; what is new is what came after the last call.

        Parameters
        ----------
        phase
            The present state of the role; empty if it has none.
        counters
            What it has counted, by reason.
        lacking
            Whether it misses something in this state.
        standing
            What it has in use and what waits, by name.

        Returns
        -------
        Report
            The report.
        """
        values: dict[str, str] = {}
        if phase:
            values['phase'] = phase
        values |= self._codebooks(standing.get('codebook_id', ''))
        values |= {name: value for name, value in standing.items() if name != 'codebook_id'}
        if self._served:
            values['cycles.served'] = str(self._served)
        for reason, n in sorted(counters.items()):
            values[f'{kind_of(reason).value}.{reason}'] = str(n)
        for section, books in (('received', self._received), ('sent', self._sent)):
            values |= {f'{section}.{name}': str(n) for name, n in sorted(books.items())}
        for name, durations_s in self._durations_s.items():
            percentiles = 1e3 * np.percentile(durations_s, _PERCENTS)
            values |= {f'{name}.p{percent}': f'{value:.3f}'
                       for percent, value in zip(_PERCENTS, percentiles, strict=True)}
        faults = sum(n for reason, n in counters.items() if reason != Outcome.UNANSWERED.value)
        new, self._faults = faults - self._faults, faults
        if self._missing:
            return Report(True, f'waiting for {", ".join(self._missing)}', values)
        if self._lacks:
            return Report(True, f'without {", ".join(sorted(self._lacks))}', values)
        if lacking:
            return Report(True, f'cannot work: {phase}', values)
        if new:
            return Report(True, f'{new} faults just now', values)
        return Report(False, 'no fault', values)
