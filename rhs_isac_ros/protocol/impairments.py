"""An air that loses, doubles, delays and reorders, for trying out what a network bears."""

import dataclasses
import heapq
import itertools
from typing import Any

import numpy as np

from rhs_isac_ros.protocol.events import Action, Event, Send, Tick


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


class Impaired:
    """A role whose messages go through an air that is not ideal.

    Parameters
    ----------
    role
        The role, one without deadlines of its own.
    impairments
        What happens to its messages.
    rng
        Source of randomness.

    Attributes
    ----------
    counters
        Those of the role, with ``emulated_loss`` and ``emulated_double``.
    """

    def __init__(self, role: Any, impairments: Impairments, rng: np.random.Generator) -> None:
        self._role, self._impairments, self._rng = role, impairments, rng
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
        actions = [] if isinstance(event, Tick) else self._role.handle(event, now_s)
        arriving: list[Action] = []
        for action in actions:
            if isinstance(action, Send):
                self._send(action, now_s)
            else:
                arriving.append(action)
        while self._on_the_way and self._on_the_way[0][0] <= now_s:
            arriving.append(heapq.heappop(self._on_the_way)[2])
        return arriving

    def next_deadline(self) -> float | None:
        """Return when the next message arrives.

        Returns
        -------
        float or None
            The time [s], on the clock of `handle`; None if nothing is on its way.
        """
        return self._on_the_way[0][0] if self._on_the_way else None

    def _send(self, action: Send, now_s: float) -> None:
        what = self._impairments
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
