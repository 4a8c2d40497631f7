"""What roles have in common: their interface, bounded memory, and state machines with tables."""

import collections
import dataclasses
import enum
import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from rhs_isac_ros.protocol.events import Action, Event, Outcome
from rhs_isac_ros.protocol.messages import Message


class Role(Protocol):
    """A role of the protocol. It maps events to actions and does not read a clock.

    Attributes
    ----------
    counters
        Number of occurrences of each outcome and of each kind of unexpected event.
    """

    counters: collections.Counter[str]

    @property
    def SENDS(self) -> tuple[type[Message], ...]:
        """Messages that the role sends."""
        ...

    @property
    def RECEIVES(self) -> tuple[type[Message], ...]:
        """Messages that the role handles."""
        ...

    @property
    def BLOCKED_STATES(self) -> frozenset[enum.Enum]:
        """States in which something that the role needs is missing."""
        ...

    @property
    def WORLD_STATES(self) -> frozenset[enum.Enum]:
        """States whose timeouts are on the clock of the emulated world."""
        ...

    @property
    def state(self) -> enum.Enum | None:
        """Current state; None if the role has no state machine."""
        ...

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Process an event at a time [s] of a monotonic clock and return actions, in order."""
        ...

    def next_deadline(self) -> float | None:
        """Return when the role expects a `Timeout` [s], on the clock of `handle`, or None."""
        ...

    def status(self) -> Mapping[str, str]:
        """Return the values in use and those pending by name, for the diagnostics.

        Examples of names are ``parameter.policy``, ``pending.policy`` and ``codebook_id``; the
        result is empty if the role has no settings.
        """
        ...


class CountingRole:
    """Base of all roles: counts outcomes and has no settings.

    Attributes
    ----------
    counters
        Number of occurrences of each outcome and of each kind of unexpected event.
    """

    def __init__(self) -> None:
        self.counters: collections.Counter[str] = collections.Counter()

    def count(self, outcome: Outcome, n: int = 1) -> None:
        """Add `n` occurrences of an outcome."""
        if n:
            self.counters[outcome.value] += n

    def status(self) -> Mapping[str, str]:
        """Return an empty mapping, because the role has no settings."""
        return {}


class PlainRole(CountingRole):
    """Base of the roles that only answer messages, without states or deadlines."""

    BLOCKED_STATES: frozenset[enum.Enum] = frozenset()
    WORLD_STATES: frozenset[enum.Enum] = frozenset()
    state: enum.Enum | None = None

    def next_deadline(self) -> float | None:
        """Return None, because the role needs no `Timeout`."""
        return None


Key = TypeVar('Key')
Value = TypeVar('Value')


class NewestDict(dict[Key, Value]):
    """A dictionary that keeps only its newest entries; `put` adds them.

    Parameters
    ----------
    max_size
        Number of entries that it keeps.
    """

    def __init__(self, max_size: int) -> None:
        super().__init__()
        self.max_size = max_size

    def put(self, key: Key, value: Value, pinned: Key | None = None) -> int:
        """Store an entry as the newest and discard the oldest beyond the limit.

        Parameters
        ----------
        pinned
            Key of an entry that is neither discarded nor counted towards the limit.

        Returns
        -------
        int
            Number of entries that were discarded.
        """
        self.pop(key, None)
        self[key] = value
        # Stops at the last entry to discard, because most calls discard none.
        n_surplus = len(self) - (pinned in self) - self.max_size
        surplus = list(itertools.islice(
            (known for known in self if known != pinned), max(n_surplus, 0)))
        for known in surplus:
            del self[known]
        return len(surplus)


Item = TypeVar('Item')
# Maximum number of codebooks offered during a cycle before the oldest one is discarded.
_MAX_OFFERED = 3


class CodebookCache(Generic[Item]):
    """Items by codebook id; the item in use is never discarded.

    Attributes
    ----------
    in_use
        Id of the item that was taken last; empty at first.
    """

    def __init__(self) -> None:
        self._items: NewestDict[str, Item] = NewestDict(_MAX_OFFERED)
        self.in_use = ''

    def put(self, codebook_id: str, item: Item) -> None:
        """Store an item as the latest; the oldest one not in use may be discarded."""
        self._items.put(codebook_id, item, pinned=self.in_use)

    def take(self, codebook_id: str) -> Item:
        """Return the item of a codebook and mark it as in use.

        Raises
        ------
        KeyError
            If the codebook has no item.
        """
        item = self._items[codebook_id]
        self.in_use = codebook_id
        return item

    def peek(self, codebook_id: str) -> Item | None:
        """Return the item of a codebook, or None; the item in use stays the same."""
        return self._items.get(codebook_id)

    def __contains__(self, codebook_id: str) -> bool:
        """Return whether a codebook has an item."""
        return codebook_id in self._items

    def ids(self) -> list[str]:
        """Return the ids of all items, the oldest first."""
        return list(self._items)


StateT = TypeVar('StateT', bound=enum.Enum)
RoleT = TypeVar('RoleT')
EventT = TypeVar('EventT')

# As a source: any state. As a target: the current state.
ANY = None
SAME = None


def always(role: object, event: object, now_s: float) -> bool:
    """Accept every event; this is the guard of a row without a condition."""
    return True


@dataclasses.dataclass(frozen=True, eq=False)
class Transition(Generic[StateT, RoleT, EventT]):
    """One row of a table.

    Attributes
    ----------
    source
        States in which the row applies, or ANY.
    event
        Class of the event.
    guard
        Condition on role, event and time; it must not have side effects.
    actions
        Steps to carry out, in order; each may return protocol actions.
    target
        Next state, or SAME.
    outcome
        Outcome to count, or None.
    restart_timeout
        Whether to restart the timeout although the state does not change.
    enter_again
        Whether the state is entered again, although it does not change: the timeout restarts, and
        `StateMachine.repeats` is 0.
    """

    source: tuple[StateT, ...] | None
    event: type[EventT]
    guard: Callable[[RoleT, EventT, float], bool] = always
    actions: tuple[Callable[[RoleT, EventT, float], Iterable[Action] | None], ...] = ()
    target: StateT | None = SAME
    outcome: Outcome | None = None
    restart_timeout: bool = False
    enter_again: bool = False


class StateMachine(CountingRole, Generic[StateT]):
    """A role with states, which takes events and returns actions.

    `handle` takes the first row of `TABLE` whose source, event class and guard match. An event
    without a matching row changes nothing and counts as ``unexpected_<name>``. The machine does
    not read a clock: every call passes the time.

    Parameters
    ----------
    initial
        First state.
    timeouts_s
        Time after which a state expects a `Timeout` [s]; other states have no timeout.

    Attributes
    ----------
    state
        Current state.
    repeats
        Number of times that the timeout was restarted since the current state was entered.
    """

    STATES: ClassVar[type[enum.Enum]]
    TABLE: ClassVar[tuple[Transition[Any, Any, Any], ...]]
    # By message: the conditions on which it is dropped in every state, each with the outcome to
    # count, or None. They precede the rows of the table.
    DROPS: ClassVar[Mapping[type, Mapping[Callable[..., bool], Outcome | None]]] = {}
    # Names of the events in the counters of unexpected events.
    EVENT_NAMES: ClassVar[Mapping[type, str]]
    # States in which something that the role needs is missing.
    BLOCKED_STATES: ClassVar[frozenset[enum.Enum]] = frozenset()
    # States whose timeouts are on the clock of the emulated world, and not of the protocol.
    WORLD_STATES: ClassVar[frozenset[enum.Enum]] = frozenset()

    _rows: ClassVar[Mapping[tuple[enum.Enum, type], tuple[Transition[Any, Any, Any], ...]]]

    def __init_subclass__(cls) -> None:
        """Add the rows of `DROPS` to a new table, and group its rows by state and event class."""
        super().__init_subclass__()
        if 'TABLE' in vars(cls):
            events = dict.fromkeys(row.event for row in cls.TABLE)
            cls.TABLE = tuple(row for event in events for row in (
                *(Transition(ANY, event, guard=wrong, outcome=outcome)
                  for wrong, outcome in cls.DROPS.get(event, {}).items()),
                *(row for row in cls.TABLE if row.event is event)))
            cls._rows = {(state, event): tuple(rows_for(cls.TABLE, state, event))
                         for state in cls.STATES for event in {row.event for row in cls.TABLE}}

    def __init__(self, initial: StateT, timeouts_s: Mapping[StateT, float]) -> None:
        super().__init__()
        self.state = initial
        self.repeats = 0
        self._timeouts_s = dict(timeouts_s)
        self._deadline_s: float | None = None

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Process an event.

        Parameters
        ----------
        now_s
            Time on any monotonic clock [s].

        Returns
        -------
        list of Action
            Actions to carry out, in order.

        Raises
        ------
        TypeError
            If no row of the table names the class of the event.
        """
        kind = type(event)
        try:
            rows = self._rows[self.state, kind]
        except KeyError:
            raise TypeError(
                f'{kind.__name__} is not an event of {type(self).__name__}') from None
        for row in rows:
            if row.guard(self, event, now_s):
                return self._take(row, event, now_s)
        self.counters[f'unexpected_{self.EVENT_NAMES[kind]}'] += 1
        return []

    def next_deadline(self) -> float | None:
        """Return when the machine expects a `Timeout`.

        Returns
        -------
        float or None
            Time on the clock of `handle` [s]; None if the state has no timeout.
        """
        return self._deadline_s

    def _take(self, row: Transition[Any, Any, Any], event: Event, now_s: float) -> list[Action]:
        if row.outcome:
            self.count(row.outcome)
        actions: list[Action] = []
        for action in row.actions:
            actions += action(self, event, now_s) or ()
        target = row.target or self.state
        enters = row.enter_again or target is not self.state
        if enters or row.restart_timeout:
            self.state = target
            self.repeats = 0 if enters else self.repeats + 1
            # Looked up after the actions, which may have changed the timeouts.
            timeout_s = self._timeouts_s.get(self.state)
            self._deadline_s = None if timeout_s is None else now_s + timeout_s
        return actions


def rows_for(
        table: Iterable[Transition[Any, Any, Any]], state: enum.Enum, event: type
) -> list[Transition[Any, Any, Any]]:
    """Return the rows for a state and a class of events, in the order in which they are tried."""
    return [row for row in table
            if row.event is event and (row.source is ANY or state in row.source)]
