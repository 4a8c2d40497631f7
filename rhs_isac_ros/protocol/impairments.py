"""An air that loses, doubles, delays and reorders, for trying out what a network bears."""

import dataclasses
import heapq
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, Event, Send, SettingsOffered, Tick
from rhs_isac_ros.protocol.pending_settings import PendingSettings


@dataclasses.dataclass(frozen=True)
class Impairments:
    """What happens to a message on its way.

    Attributes
    ----------
    loss_probability
        That it never arrives.
    double_probability
        That it arrives a second time, if it arrives.
    delay_s
        How long it takes at least [s].
    jitter_s
        How much longer, at random and evenly, each for itself: so they overtake each other [s].
    """

    loss_probability: float = 0.0
    double_probability: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0


class ImpairedChannel:
    """A channel whose messages go through an air that need not be ideal.

    Other impairments hold from the true position on with which the next cycle begins.

    Parameters
    ----------
    role
        The role, one without deadlines of its own.
    impairments
        What happens to its messages, until others are offered.
    rng
        Source of randomness.

    Attributes
    ----------
    counters
        Those of the role, with ``emulated_loss`` and ``emulated_double``.
    """

    def __init__(self, role: Any, impairments: Impairments, rng: np.random.Generator) -> None:
        self._role, self._settings, self._rng = role, PendingSettings(impairments), rng
        self._cycle_id = 0
        self.counters = role.counters
        self._serial = itertools.count()
        self._on_the_way: list[tuple[float, int, Send]] = []

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Hand an event to the role, and pass on what arrives by now.

        Parameters
        ----------
        event
            The event.
        now_s
            The time [s].

        Returns
        -------
        list of Action
            What arrives.
        """
        arriving: list[Action] = []
        actions: list[Action] = []
        match event:
            case Tick():
                pass
            case SettingsOffered(impairments):
                self._settings.newest = impairments
            case _:
                arriving += self._begin(event)
                actions = self._role.handle(event, now_s)
        for action in actions:
            if isinstance(action, Send):
                self._send(action, now_s)
            else:
                arriving.append(action)
        while self._on_the_way and self._on_the_way[0][0] <= now_s:
            arriving.append(heapq.heappop(self._on_the_way)[2])
        return arriving

    def status(self) -> Mapping[str, str]:
        """Return the impairments in use, and those that wait.

        Returns
        -------
        Mapping
            Values by name.
        """
        return self._settings.describe()

    def next_deadline(self) -> float | None:
        """Return when the next message arrives.

        Returns
        -------
        float or None
            The time [s], on the clock of `handle`; None if nothing is on its way.
        """
        return self._on_the_way[0][0] if self._on_the_way else None

    def _begin(self, event: Event) -> list[Action]:
        if not isinstance(event, m.GroundTruth) or event.cycle_id in (0, self._cycle_id):
            return []
        self._cycle_id = event.cycle_id
        return self._settings.apply()

    def _send(self, action: Send, now_s: float) -> None:
        what = self._settings.in_use
        # All draws for every message: none depends on the fate of another one.
        lost, doubled, *late = self._rng.random(4)
        if lost < what.loss_probability:
            self.counters['emulated_loss'] += 1
            return
        copies = 1
        if doubled < what.double_probability:
            copies = 2
            self.counters['emulated_double'] += 1
        for share in late[:copies]:
            arrives_s = now_s + what.delay_s + what.jitter_s * share
            heapq.heappush(self._on_the_way, (arrives_s, next(self._serial), action))
