"""The interface of the roles, their bounded memory, and state machines defined by tables."""

import collections
import dataclasses
import enum
import itertools
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, ClassVar, Generic, TypeVar

from rhs_isac_ros.protocol.events import Action, Event, Immediately, LogMessage, Outcome, Send
from rhs_isac_ros.protocol.messages import Message
from rhs_isac_ros.support.fields import finite
from rhs_isac_ros.support.plugins import PluginError, trace_of


class Role:
    """A role of the protocol, which maps events and their times to actions.

    A subclass defines `react`, which appends actions through `send`, `log` and `act`.
    """

    # Types of the messages that the role sends, and of those that it handles.
    SENDS: ClassVar[tuple[type[Message], ...]] = ()
    RECEIVES: ClassVar[tuple[type[Message], ...]] = ()
    # States in which the role lacks something that it needs.
    BLOCKED_STATES: ClassVar[frozenset[enum.Enum]] = frozenset()
    # States whose timeouts follow the clock of the emulated world instead of the protocol's clock.
    WORLD_STATES: ClassVar[frozenset[enum.Enum]] = frozenset()

    def __init__(self) -> None:
        # Number of occurrences of each outcome, unexpected event or other condition, by counter.
        self.counters: collections.Counter[str] = collections.Counter()
        # Time of the latest event [s].
        self.now_s = 0.0
        # None if the role has no state machine.
        self.state: enum.Enum | None = None
        self._actions: list[Action] = []

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Process an event at `now_s` [s] on a monotonic clock; return the actions in order.

        If a plug-in fails, the event has no further effect, as if it had been lost. Raises
        ValueError if the time is not finite.
        """
        self.now_s, self._actions = finite('now_s', now_s), []
        try:
            self.react(event)
        except PluginError as error:
            self.act(self.noted(error))
        return self._actions

    def noted(self, error: PluginError) -> Action:
        """Count a failure of a plug-in, and return an action that logs it with its traceback."""
        self.count(Outcome.PLUGIN_FAULT)
        return LogMessage(f'plug-in: {error}{trace_of(error.__cause__)}', warning=True,
                          key=f'plug-in: {error}')

    def react(self, event: Event) -> None:
        """Process an event at the time `now_s`."""
        raise NotImplementedError

    def act(self, action: Action) -> None:
        """Append an action to the result of `handle`."""
        self._actions.append(action)

    def send(self, message: Message) -> None:
        """Append an action that publishes a message."""
        self.act(Send(message))

    def log(self, text: str, warning: bool = False, key: str = '') -> None:
        """Append an action that logs a text about an event, unless it is empty."""
        if text:
            self.act(LogMessage(text, warning, key))

    def log_state(
            self, key: str, text: str, holds: bool, warning: bool | None = None) -> None:
        """Append an action that logs the beginning of a state (`holds`), or its end."""
        self.act(LogMessage(text, holds if warning is None else warning, key, holds))

    def count(self, outcome: Outcome, n: int = 1) -> None:
        """Add `n` occurrences of an outcome."""
        if n:
            self.counters[outcome.value] += n

    def next_deadline(self) -> float | None:
        """Return the time of the next `Timeout` [s], on the same clock as `now_s`, or None."""
        return None

    def status(self) -> Mapping[str, str]:
        """Return details for the diagnostics, by keys such as ``parameter.policy``."""
        return {}


# Number of cycles whose messages the roles remember. Older messages are no longer in transit.
REMEMBERED_CYCLES = 8

Key = TypeVar('Key')
Value = TypeVar('Value')


class NewestDict(dict[Key, Value]):
    """A dictionary whose `put` discards all but the newest `max_size` entries."""

    def __init__(self, max_size: int) -> None:
        super().__init__()
        self.max_size = max_size

    def put(self, key: Key, value: Value) -> int:
        """Store an entry as the newest, and return the number of entries that were discarded."""
        self.pop(key, None)
        self[key] = value
        n_surplus = max(len(self) - self.max_size, 0)
        for oldest in list(itertools.islice(self, n_surplus)):
            del self[oldest]
        return n_surplus


# Number of codebooks that are kept besides those of a library, including the one in use.
_MAX_CODEBOOKS = 4


class CodebookCache(NewestDict[str, Value]):
    """A cache of items by codebook id.

    It never discards the item that was taken last, nor those of the codebooks in a library.
    """

    def __init__(self, library: Collection[str] = ()) -> None:
        super().__init__(_MAX_CODEBOOKS + len(library))
        self._library = library
        self.in_use = ''  # id of the codebook whose item is in use; empty at first

    def put(self, codebook_id: str, item: Value) -> int:
        """Store an item as `NewestDict.put` does, but discard none that is to be kept."""
        for kept in (*self._library, self.in_use):
            if kept in self:
                super().put(kept, self[kept])
        return super().put(codebook_id, item)

    def take(self, codebook_id: str) -> Value:
        """Return the item of a known codebook, and mark it as in use."""
        item = self[codebook_id]
        self.in_use = codebook_id
        return item


RoleT = TypeVar('RoleT')
EventT = TypeVar('EventT', contravariant=True)

# ANY as a source: any state. SAME as a target: the current state, which is not entered again.
ANY = None
SAME = None


def always(role: object, event: object) -> bool:
    """Accept every event: the guard of a row without a condition."""
    return True


@dataclasses.dataclass(frozen=True, eq=False)
class Row(Generic[RoleT, EventT]):
    """One row of a table of transitions."""

    source: tuple[enum.Enum, ...] | None  # states in which the row applies, or ANY
    actions: tuple[Callable[[RoleT, EventT], None], ...] = ()  # steps to carry out, in order
    target: enum.Enum | None = SAME  # state to enter, with a new timeout, or SAME
    # Condition on the role and the event, without side effects.
    guard: Callable[[RoleT, EventT], bool] = always
    outcome: Outcome | None = None  # outcome to count, if any
    restart_timeout: bool = False  # whether to restart the timeout of the current state
    # Class of the event, and name of the event in the counters; `on` sets both.
    event: type = object
    event_name: str = ''


AnyRow = Row[Any, Any]

# Conditions under which a message is dropped in every state, with the outcome to count, or None.
Drops = dict[Callable[..., bool], Outcome | None]


class on(Generic[EventT]):
    """Builds the rows for one class of events: ``on(event, name of the event, drops)(*rows)``."""

    def __init__(self, event: type[EventT], name: str, drops: Drops | None = None) -> None:
        self._event, self._name, self._drops = event, name, drops or {}

    def __call__(self, *rows: Row[Any, EventT]) -> tuple[AnyRow, ...]:
        """Return the rows for the event: those that drop messages, followed by `rows`."""
        drops = [Row[Any, EventT](ANY, guard=wrong, outcome=outcome)
                 for wrong, outcome in self._drops.items()]
        return tuple(dataclasses.replace(row, event=self._event, event_name=self._name)
                     for row in (*drops, *rows))


class StateMachine(Role):
    """A role whose reactions depend on its state and are defined by `TABLE`.

    `handle` applies the first row whose source, event class and guard match. If no row matches,
    the event changes nothing, and is counted as ``unexpected_<name>``. After a row, those for
    `Immediately` apply in the same way, until none matches.
    """

    STATES: ClassVar[type[enum.Enum]]
    TABLE: ClassVar[tuple[AnyRow, ...]]
    # Name of each class of events, as in ``unexpected_<name>``; derived from the table.
    EVENT_NAMES: ClassVar[Mapping[type, str]]

    _rows: ClassVar[Mapping[tuple[enum.Enum | None, type], tuple[AnyRow, ...]]]

    def __init_subclass__(cls) -> None:
        """If the subclass defines a table, derive its events, and group its rows."""
        super().__init_subclass__()
        if 'TABLE' in vars(cls):
            cls.EVENT_NAMES = {row.event: row.event_name for row in cls.TABLE
                               if row.event is not Immediately}
            cls.RECEIVES = tuple(event for event in cls.EVENT_NAMES if issubclass(event, Message))
            cls._rows = {(state, event): tuple(rows_for(cls.TABLE, state, event))
                         for state in cls.STATES for event in (*cls.EVENT_NAMES, Immediately)}

    def __init__(self, initial: enum.Enum) -> None:
        super().__init__()
        self.state: enum.Enum = initial
        # Number of times that the timeout has been restarted in the current state.
        self.repeats = 0
        # Outcome of the row that was applied last.
        self.outcome: Outcome | None = None
        self._deadline_s: float | None = None

    def timeout_s(self, state: enum.Enum) -> float | None:
        """Return the timeout of a state [s], or None if it has none."""
        return None

    def next_deadline(self) -> float | None:
        """Return the time at which the timeout of the current state ends [s], or None."""
        return self._deadline_s

    def react(self, event: Event) -> None:
        """Apply the first matching row, if any; raise TypeError if the table lacks the event."""
        kind = type(event)
        if kind not in self.EVENT_NAMES:
            raise TypeError(f'{kind.__name__} is not an event of {type(self).__name__}')
        row = self._first(self._rows[self.state, kind], event)
        if row is None:
            self.counters[f'unexpected_{self.EVENT_NAMES[kind]}'] += 1
        while row:
            self._take(row, event)
            event = Immediately()
            row = self._first(self._rows[self.state, Immediately], event)

    def _first(self, rows: Iterable[AnyRow], event: Event) -> AnyRow | None:
        for row in rows:
            if row.guard(self, event):
                return row
        return None

    def _take(self, row: AnyRow, event: Event) -> None:
        self.outcome = row.outcome
        if row.outcome:
            self.count(row.outcome)
        for action in row.actions:
            action(self, event)
        if row.target or row.restart_timeout:
            self.repeats = 0 if row.target else self.repeats + 1
            self.state = state = row.target or self.state
            # Read after the actions, which may have changed the settings.
            timeout_s = self.timeout_s(state)
            self._deadline_s = None if timeout_s is None else self.now_s + timeout_s


def rows_for(table: Iterable[AnyRow], state: enum.Enum, event: type) -> list[AnyRow]:
    """Return the rows for a state and a class of events, in order."""
    return [row for row in table
            if row.event is event and (row.source is ANY or state in row.source)]
