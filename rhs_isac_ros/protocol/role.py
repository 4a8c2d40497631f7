"""The interface of the roles, and the base of those without a state machine."""

import collections
import enum
from collections.abc import Mapping
from typing import Protocol

from rhs_isac_ros.protocol.events import Action, Event
from rhs_isac_ros.protocol.messages import Message


class Role(Protocol):
    """A role of the protocol: it turns events into actions and has no clock of its own.

    Attributes
    ----------
    counters
        Number of dropped messages and failures, by reason.
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
    def LACKING(self) -> frozenset[enum.Enum]:
        """States in which something that the role needs is missing."""
        ...

    @property
    def state(self) -> enum.Enum | None:
        """Present state; None if the role has no state machine."""
        ...

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Handle an event at a time [s] of a monotonic clock and return actions, in order."""
        ...

    def next_deadline(self) -> float | None:
        """Return when the role needs a `Tick` [s], on the clock of `handle`, or None."""
        ...

    def status(self) -> Mapping[str, str]:
        """Return what is in use and what is pending, by name, for the diagnostics.

        The names are such as ``parameter.policy``, ``pending.policy`` and ``codebook_id``; the
        result is empty if nothing of the role can change.
        """
        ...


class PlainRole:
    """Base of the roles that answer messages and have neither states nor deadlines.

    Attributes
    ----------
    counters
        Number of dropped messages, by reason.
    """

    LACKING: frozenset[enum.Enum] = frozenset()
    state: enum.Enum | None = None

    def __init__(self) -> None:
        self.counters: collections.Counter[str] = collections.Counter()

    def status(self) -> Mapping[str, str]:
        """Return what is in use and what is pending, as `Role.status`; here nothing."""
        return {}

    def next_deadline(self) -> float | None:
        """Return None: the role needs no `Tick`."""
        return None
