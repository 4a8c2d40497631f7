"""The interface of the roles, and their common base classes."""

import collections
import enum
from collections.abc import Mapping
from typing import Generic, Protocol, TypeVar

from rhs_isac_ros.protocol.events import Action, Event, LogMessage
from rhs_isac_ros.protocol.messages import Message
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.settings import changes, describe_settings, shown


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
    state: enum.Enum | None = None

    def next_deadline(self) -> float | None:
        """Return None, because the role needs no `Timeout`."""
        return None


SettingsT = TypeVar('SettingsT')


class PendingSettings(Generic[SettingsT]):
    """Holds new settings back until the role may apply them.

    Attributes
    ----------
    in_use
        The settings in use.
    latest
        The settings received last.
    """

    def __init__(self, settings: SettingsT) -> None:
        self.in_use = settings
        self.latest = settings

    def apply(self) -> list[LogMessage]:
        """Put the latest settings into use; return a message that lists changes, if any."""
        changed = changes(self.in_use, self.latest)
        self.in_use = self.latest
        described = ', '.join(f'{name} {shown(value)!r}' for name, value in changed.items())
        return [LogMessage(f'settings applied: {described}')] if described else []

    def describe(self) -> dict[str, str]:
        """Return the values in use and the pending ones, as `settings.describe_settings` does."""
        return describe_settings(self.in_use, self.latest)
