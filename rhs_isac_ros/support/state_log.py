"""Limits on log lines about states that begin and end, and about events that repeat."""

import dataclasses
import re
from collections.abc import Mapping
from typing import NamedTuple

from rhs_isac_ros.support.texts import counted

# Time in which repeated changes of a state, or repetitions of an event, are only counted [s].
PERIOD_S = 60.0
# Maximum number of states and events, which bounds the memory, and maximum number of texts of a
# state that are logged in a period.
_MAX_RECORDS, _MAX_TEXTS = 1024, 8
_NUMBER = re.compile(r'[\d.]+')


class Line(NamedTuple):
    """A line of a log, which is a warning, an error or, by default, information."""

    text: str
    warning: bool
    error: bool = False


@dataclasses.dataclass
class _Record:
    """What was logged about a state or an event in a period."""

    until_s: float  # end of the period [s]
    holds: bool | None = None  # whether the state holds; None for an event
    # Kinds of logged lines: texts without numbers, or '' for the end of a state and for an event.
    logged: set[str] = dataclasses.field(default_factory=set)
    suppressed: Line | None = None  # latest line, if it was not logged
    n: int = 0  # number of changes or repetitions that were not logged


class StateLog:
    """Decides which lines about states and events a log contains.

    The log contains the first begin and the first end of a state, and the first occurrence of an
    event. Within a minute after that, it also contains a text of the state that differs from those
    before by more than numbers. Other changes and occurrences are only counted. At the end
    of the minute, if there were any, one line contains the latest text and their number, and the
    next minute begins. After a minute without any, the state or event counts as new.

    Each method returns the lines to log. Times `now_s` [s] are on a steady clock.
    """

    def __init__(self) -> None:
        self._records: dict[str, _Record] = {}
        # Texts of the states passed to `update`, by key.
        self._states: dict[str, str] = {}

    def state(self, key: str, line: Line, now_s: float, *, holds: bool = True) -> list[Line]:
        """Log that a state begins or has another text (`holds`), or that it ends."""
        return self._add(key, line, now_s, holds, _NUMBER.sub('', line.text) if holds else '')

    def event(self, key: str, line: Line, now_s: float) -> list[Line]:
        """Log an event."""
        return self._add(key, line, now_s, None)

    def update(self, states: Mapping[str, str], now_s: float) -> list[Line]:
        """Log the changes of a group of states; `states` contains the texts of those that hold."""
        before, self._states = self._states, dict(states)
        lines = []
        for key, text in before.items() - states.items():
            if key not in states:
                lines += self.state(key, Line(f'no longer: {text}', False), now_s, holds=False)
        for key, text in states.items() - before.items():
            # The names of nodes in the text arrive one after the other.
            lines += self._add(key, Line(text, True), now_s, True, key)
        return [*self.due(now_s), *sorted(lines)]

    def due(self, now_s: float) -> list[Line]:
        """Return the lines about what was not logged in the periods that have ended."""
        lines = []
        for key, record in list(self._records.items()):
            if now_s < record.until_s:
                continue
            if record.suppressed is None:
                del self._records[key]
                continue
            text, *severity = record.suppressed
            what = 'time' if record.holds is None else 'change'
            times = f' ({counted(record.n, what)} in {PERIOD_S:.0f} s)' if record.n else ''
            lines.append(Line(text + times, *severity))
            record.until_s, record.suppressed, record.n = now_s + PERIOD_S, None, 0
        return lines

    @property
    def due_s(self) -> float | None:
        """Time at which the next period ends [s]; None if nothing has been logged in any."""
        return min((record.until_s for record in self._records.values()), default=None)

    def renew(self) -> None:
        """Treat states and events as new, because their cause is new.

        States of the group that hold are older than the cause, and remain known.
        """
        self._records = {key: record for key, record in self._records.items()
                         if record.holds and key in self._states}

    def _add(self, key: str, line: Line, now_s: float, holds: bool | None, kind: str = ''
             ) -> list[Line]:
        lines = self.due(now_s)
        record = self._records.get(key)
        if record is None:
            while len(self._records) >= _MAX_RECORDS:
                del self._records[next(iter(self._records))]
            record = self._records[key] = _Record(now_s + PERIOD_S)
        is_change = holds is None or holds != record.holds
        record.holds = holds
        if kind not in record.logged and len(record.logged) < _MAX_TEXTS:
            record.logged.add(kind)
            # The line also shows the current state, so nothing else remains to be logged.
            if not record.n:
                record.suppressed = None
            return [*lines, line]
        record.suppressed = line
        record.n += is_change
        return lines
