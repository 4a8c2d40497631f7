"""What roles have in common: their interface, bounded memory, and state machines with tables."""

import collections
import dataclasses
import enum
import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, Generic, TypeVar

from rhs_isac_ros.protocol.events import Action, Event, LogMessage, Outcome, Send
from rhs_isac_ros.protocol.messages import Message


class Role:
    """A role of the protocol. It maps events to actions and does not read a clock.

    A subclass defines `react`, which appends actions with `send`, `log` and `act`.
    """

    # Messages that the role sends, and those that it handles.
    SENDS: ClassVar[tuple[type[Message], ...]] = ()
    RECEIVES: ClassVar[tuple[type[Message], ...]] = ()
    # States in which something that the role needs is missing.
    BLOCKED_STATES: ClassVar[frozenset[enum.Enum]] = frozenset()
    # States whose timeouts are on the clock of the emulated world, and not of the protocol.
    WORLD_STATES: ClassVar[frozenset[enum.Enum]] = frozenset()

    def __init__(self) -> None:
        # Number of occurrences of each outcome and of each kind of unexpected event.
        self.counters: collections.Counter[str] = collections.Counter()
        # Time of the latest event [s].
        self.now_s = 0.0
        # None if the role has no state machine.
        self.state: enum.Enum | None = None
        self._actions: list[Action] = []

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Process an event at a time [s] of a monotonic clock and return actions, in order."""
        self.now_s, self._actions = now_s, []
        self.react(event)
        return self._actions

    def react(self, event: Event) -> None:
        """Process an event at the time `now_s`."""
        raise NotImplementedError

    def act(self, action: Action) -> None:
        """Append an action to those that `handle` returns."""
        self._actions.append(action)

    def send(self, message: Message) -> None:
        """Append an action that publishes a message."""
        self.act(Send(message))

    def log(self, text: str, warning: bool = False) -> None:
        """Append an action that logs a text, unless it is empty."""
        if text:
            self.act(LogMessage(text, warning))

    def count(self, outcome: Outcome, n: int = 1) -> None:
        """Add `n` occurrences of an outcome."""
        if n:
            self.counters[outcome.value] += n

    def next_deadline(self) -> float | None:
        """Return when the role expects a `Timeout` [s], on the clock of `handle`, or None."""
        return None

    def status(self) -> Mapping[str, str]:
        """Return values for the diagnostics by name, such as ``parameter.policy``."""
        return {}


# Number of cycles whose messages roles remember; no message of an older cycle is in transit.
REMEMBERED_CYCLES = 8

Key = TypeVar('Key')
Value = TypeVar('Value')


class NewestDict(dict[Key, Value]):
    """A dictionary that keeps only its newest `max_size` entries; `put` adds them.

    The entry with the key `pinned`, if any, is neither discarded nor counted.
    """

    def __init__(self, max_size: int) -> None:
        super().__init__()
        self.max_size = max_size
        self.pinned: Key | None = None

    def put(self, key: Key, value: Value) -> int:
        """Store an entry as the newest; return how many beyond the limit were discarded."""
        self.pop(key, None)
        self[key] = value
        # Stops at the last entry to discard, because most calls discard none.
        n_surplus = len(self) - (self.pinned in self) - self.max_size
        surplus = list(itertools.islice(
            (known for known in self if known != self.pinned), max(n_surplus, 0)))
        for known in surplus:
            del self[known]
        return len(surplus)


# Maximum number of codebooks offered during a cycle before the oldest one is discarded.
_MAX_OFFERED = 3


class CodebookCache(NewestDict[str, Value]):
    """Items by codebook id; the item in use, which was taken last, is never discarded."""

    def __init__(self) -> None:
        super().__init__(_MAX_OFFERED)

    @property
    def in_use(self) -> str:
        """Id of the item that was taken last; empty at first."""
        return self.pinned or ''

    def take(self, codebook_id: str) -> Value:
        """Return the item of a codebook, which must be known, and mark it as in use."""
        item = self[codebook_id]
        self.pinned = codebook_id
        return item


RoleT = TypeVar('RoleT')
EventT = TypeVar('EventT', contravariant=True)

# As a source: any state. As a target: the current state, which is not entered again.
ANY = None
SAME = None


def always(role: object, event: object) -> bool:
    """Accept every event; this is the guard of a row without a condition."""
    return True


@dataclasses.dataclass(frozen=True, eq=False)
class Row(Generic[RoleT, EventT]):
    """One row of a table."""

    source: tuple[enum.Enum, ...] | None  # states in which it applies, or ANY
    actions: tuple[Callable[[RoleT, EventT], None], ...] = ()  # steps to carry out, in order
    target: enum.Enum | None = SAME  # state to enter, with a new timeout, or SAME
    # Condition on role and event, without side effects.
    guard: Callable[[RoleT, EventT], bool] = always
    outcome: Outcome | None = None  # what to count, if anything
    restart_timeout: bool = False  # whether to restart the timeout of the current state
    # The class of its event, and the name of the event in the counters; set by `on`.
    event: type = object
    event_name: str = ''


AnyRow = Row[Any, Any]
# Conditions on which a message is dropped in every state, each with the outcome to count, or None.
Drops = dict[Callable[..., bool], Outcome | None]


class on(Generic[EventT]):
    """Returns the rows of an event, in order: ``on(event, its name, drops)(*rows)``."""

    def __init__(self, event: type[EventT], name: str, drops: Drops | None = None) -> None:
        self._event, self._name, self._drops = event, name, drops or {}

    def __call__(self, *rows: Row[Any, EventT]) -> tuple[AnyRow, ...]:
        """Return the rows that drop messages, followed by others."""
        drops = [Row[Any, EventT](ANY, guard=wrong, outcome=outcome)
                 for wrong, outcome in self._drops.items()]
        return tuple(dataclasses.replace(row, event=self._event, event_name=self._name)
                     for row in (*drops, *rows))


class StateMachine(Role):
    """A role with states, which takes events and returns actions.

    `handle` takes the first row of `TABLE` whose source, event class and guard match. An event
    without a matching row changes nothing and counts as ``unexpected_<name>``.
    """

    STATES: ClassVar[type[enum.Enum]]
    TABLE: ClassVar[tuple[AnyRow, ...]]
    # All events, and their names in the counters of unexpected events; derived from the table.
    EVENT_NAMES: ClassVar[Mapping[type, str]]

    _rows: ClassVar[Mapping[tuple[enum.Enum | None, type], tuple[AnyRow, ...]]]

    def __init_subclass__(cls) -> None:
        """Derive the events from a new table, and group its rows by state and event."""
        super().__init_subclass__()
        if 'TABLE' in vars(cls):
            cls.EVENT_NAMES = {row.event: row.event_name for row in cls.TABLE}
            cls.RECEIVES = tuple(event for event in cls.EVENT_NAMES if issubclass(event, Message))
            cls._rows = {(state, event): tuple(rows_for(cls.TABLE, state, event))
                         for state in cls.STATES for event in cls.EVENT_NAMES}

    def __init__(self, initial: enum.Enum) -> None:
        super().__init__()
        self.state: enum.Enum = initial
        # Number of times that the timeout was restarted since the state was entered.
        self.repeats = 0
        # Outcome of the row that was taken last.
        self.outcome: Outcome | None = None
        self._deadline_s: float | None = None

    def timeout_s(self, state: enum.Enum) -> float | None:
        """Return the time after which a state expects a `Timeout` [s]; None: it has no timeout."""
        return None

    def next_deadline(self) -> float | None:
        """Return when the machine expects a `Timeout` [s], on the clock of `handle`, or None."""
        return self._deadline_s

    def react(self, event: Event) -> None:
        """Take the first matching row; raise TypeError for an event that the table lacks."""
        kind = type(event)
        try:
            rows = self._rows[self.state, kind]
        except KeyError:
            raise TypeError(
                f'{kind.__name__} is not an event of {type(self).__name__}') from None
        for row in rows:
            if row.guard(self, event):
                self._take(row, event)
                return
        self.counters[f'unexpected_{self.EVENT_NAMES[kind]}'] += 1

    def _take(self, row: AnyRow, event: Event) -> None:
        self.outcome = row.outcome
        if row.outcome:
            self.count(row.outcome)
        for action in row.actions:
            action(self, event)
        if row.target or row.restart_timeout:
            self.repeats = 0 if row.target else self.repeats + 1
            self.state = state = row.target or self.state
            # Read after the actions, which may have changed it.
            timeout_s = self.timeout_s(state)
            self._deadline_s = None if timeout_s is None else self.now_s + timeout_s


def rows_for(table: Iterable[AnyRow], state: enum.Enum, event: type) -> list[AnyRow]:
    """Return the rows for a state and a class of events, in the order in which they are tried."""
    return [row for row in table
            if row.event is event and (row.source is ANY or state in row.source)]
