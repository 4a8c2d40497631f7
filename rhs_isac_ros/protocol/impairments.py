"""A channel that loses, duplicates, delays and reorders messages."""

import dataclasses
import enum
import heapq
import itertools
from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, Event, Send, SettingsOffered, Timeout
from rhs_isac_ros.protocol.pending_settings import PendingSettings
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.protocol.settings import setting


@dataclasses.dataclass(frozen=True)
class Impairments:
    """Impairments of the air interface."""

    loss_probability: float = setting(
        0.0, 'Probability that a message is lost.', low=0.0, high=1.0)
    double_probability: float = setting(
        0.0, 'Probability that a message that arrives is duplicated.', low=0.0, high=1.0)
    delay_s: float = setting(
        0.0, 'Minimum delay of each message.', unit='s', low=0.0, high=10.0)
    jitter_s: float = setting(
        0.0, 'Maximum additional random delay; messages may be reordered.', unit='s',
        low=0.0, high=10.0)


class ImpairedChannel:
    """A channel role whose outgoing messages are subject to impairments.

    New impairments take effect at the start of the next cycle, when its true position arrives.

    Parameters
    ----------
    role
        A role without deadlines.
    impairments
        Initial impairments.
    rng
        Random source of losses, duplicates and delays.

    Attributes
    ----------
    counters
        The counters of the role, and ``emulated_loss`` and ``emulated_double``.
    """

    def __init__(self, role: Role, impairments: Impairments, rng: np.random.Generator) -> None:
        self.counters = role.counters
        self._role, self._settings, self._rng = role, PendingSettings(impairments), rng
        self._cycle_id = 0
        self._serial = itertools.count()
        # Time of arrival, serial number as a tie-break, message.
        self._in_flight: list[tuple[float, int, Send]] = []

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Pass an event to the role and return the messages that arrive by `now_s` [s]."""
        arriving: list[Action] = []
        actions: list[Action] = []
        match event:
            case Timeout():
                pass
            case SettingsOffered(impairments):
                self._settings.latest = impairments
            case _:
                arriving += self._begin_cycle(event)
                actions = self._role.handle(event, now_s)
        for action in actions:
            if isinstance(action, Send):
                self._send(action, now_s)
            else:
                arriving.append(action)
        while self._in_flight and self._in_flight[0][0] <= now_s:
            arriving.append(heapq.heappop(self._in_flight)[2])
        return arriving

    def status(self) -> Mapping[str, str]:
        """Return the impairments in use and pending, by name."""
        return self._settings.describe()

    @property
    def SENDS(self) -> tuple[type[m.Message], ...]:
        """Messages that the role sends."""
        return self._role.SENDS

    @property
    def RECEIVES(self) -> tuple[type[m.Message], ...]:
        """Messages that the role handles."""
        return self._role.RECEIVES

    @property
    def state(self) -> enum.Enum | None:
        """State of the role."""
        return self._role.state

    @property
    def BLOCKED_STATES(self) -> frozenset[enum.Enum]:
        """States in which something that the role needs is missing."""
        return self._role.BLOCKED_STATES

    def next_deadline(self) -> float | None:
        """Return when the next message arrives [s], or None if no message is in flight."""
        return self._in_flight[0][0] if self._in_flight else None

    def _begin_cycle(self, event: Event) -> list[Action]:
        if not isinstance(event, m.GroundTruth) or event.cycle_id in (0, self._cycle_id):
            return []
        self._cycle_id = event.cycle_id
        return [*self._settings.apply()]

    def _send(self, action: Send, now_s: float) -> None:
        impairments = self._settings.in_use
        # The number of draws is fixed, so that the impairments of one message do not affect
        # those of others.
        loss, duplication, *delays = self._rng.random(4)
        if loss < impairments.loss_probability:
            self.counters['emulated_loss'] += 1
            return
        copies = 1
        if duplication < impairments.double_probability:
            copies = 2
            self.counters['emulated_double'] += 1
        for delay in delays[:copies]:
            arrival_s = now_s + impairments.delay_s + impairments.jitter_s * delay
            heapq.heappush(self._in_flight, (arrival_s, next(self._serial), action))
