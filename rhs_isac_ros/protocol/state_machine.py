"""State machines that are driven by a literal table."""

import collections
import dataclasses
import enum
from collections.abc import Mapping
from typing import ClassVar

from rhs_isac_ros.protocol.events import Action, Event

# In a table: any state, as the source; the present state, as the target.
ANY = None
SAME = None


@dataclasses.dataclass(frozen=True)
class Transition:
    """One transition.

    Attributes
    ----------
    to
        Next state, or SAME.
    do
        Methods of the machine that make the actions, in their order.
    counts
        Counter to raise.
    rearm
        Start the state's time-out afresh even if the state stays.
    """

    to: enum.Enum | None = SAME
    do: tuple[str, ...] = ()
    counts: str = ''
    rearm: bool = False


class StateMachine:
    """A role of the protocol: events in, actions out.

    A subclass names every event by `_classify` and lists in `TABLE` what each name does in each
    state, first by state, then for ANY. A pair that the table does not hold changes nothing and
    counts as ``unexpected_<name>``. There is no clock inside: every call brings the time.

    Parameters
    ----------
    initial
        First state.
    timeouts_s
        How long the machine may stay in a state before it wants a `Tick`; states that are not
        listed have no end.

    Attributes
    ----------
    state
        Present state.
    repeats
        How often the present state's time-out began afresh.
    counters
        What was dropped or went wrong, by reason.
    """

    TABLE: ClassVar[Mapping[tuple[enum.Enum | None, enum.Enum], Transition]]
    # States in which something that the role needs is missing.
    LACKING: ClassVar[frozenset[enum.Enum]] = frozenset()

    def __init__(self, initial: enum.Enum, timeouts_s: Mapping[enum.Enum, float]) -> None:
        self.state = initial
        self.repeats = 0
        self.counters: collections.Counter[str] = collections.Counter()
        self._timeouts_s = dict(timeouts_s)
        self._deadline_s: float | None = None

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take an event.

        Parameters
        ----------
        event
            A message, or something local.
        now_s
            The time, on any clock that only goes forward [s].

        Returns
        -------
        list of Action
            What to do, in this order.
        """
        name = self._classify(event)
        step = self.TABLE.get((self.state, name)) or self.TABLE.get((ANY, name))
        if step is None:
            self.counters[f'unexpected_{name.value}'] += 1
            return []
        if step.counts:
            self.counters[step.counts] += 1
        actions: list[Action] = []
        for method in step.do:
            actions += getattr(self, f'_{method}')(event, now_s) or []
        changes = step.to is not SAME and step.to is not self.state
        if changes or step.rearm:
            self.state = step.to or self.state
            self.repeats = 0 if changes else self.repeats + 1
            timeout = self._timeouts_s.get(self.state)
            self._deadline_s = None if timeout is None else now_s + timeout
        return actions

    def next_deadline(self) -> float | None:
        """Return when the machine wants a `Tick`.

        Returns
        -------
        float or None
            The time [s], on the clock of `handle`; None if only a message can change anything.
        """
        return self._deadline_s

    def status(self) -> Mapping[str, str]:
        """Return what is in use and what waits, for the diagnostics.

        Returns
        -------
        Mapping
            Values by name, such as ``parameter.policy`` and ``pending.policy``, and the
            ``codebook_id`` in use; empty if all of that is fixed.
        """
        return {}

    def _classify(self, event: Event) -> enum.Enum:
        raise NotImplementedError
