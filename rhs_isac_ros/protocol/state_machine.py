"""State machines whose tables of transitions are the complete description of a role."""

import dataclasses
import enum
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, Generic, TypeVar

from rhs_isac_ros.protocol.events import Action, Event
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.role import CountingRole

StateT = TypeVar('StateT', bound=enum.Enum)
RoleT = TypeVar('RoleT')
EventT = TypeVar('EventT')

# As a source: any state. As a target: the current state.
ANY = None
SAME = None


def always(role: object, event: object, now_s: float) -> bool:
    """Accept every event; this is the guard of a row without a condition."""
    return True


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
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

    source: tuple[StateT, ...] | None = ANY
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
    # Names of the events in the counters of unexpected events.
    EVENT_NAMES: ClassVar[Mapping[type, str]]
    # States in which something that the role needs is missing.
    BLOCKED_STATES: ClassVar[frozenset[enum.Enum]] = frozenset()

    _rows: ClassVar[Mapping[tuple[enum.Enum, type], tuple[Transition[Any, Any, Any], ...]]]

    def __init_subclass__(cls) -> None:
        """Group the rows of a new table by state and event class."""
        super().__init_subclass__()
        if 'TABLE' in vars(cls):
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
