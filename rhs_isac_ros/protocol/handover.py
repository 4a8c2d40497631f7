"""The surfaces whose beams a base station awaits, and the one that carries the data of a user."""

import dataclasses
import math
from collections.abc import Collection, Mapping

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import NewestDict
from rhs_isac_ros.protocol.user_registry import MAX_USERS

# Time during which a surface that has not delivered data carries data only if no other can [s].
_AVOIDED_S = 10.0


@dataclasses.dataclass
class Steering:
    """The beams with which surfaces answer the estimate of one cycle, by `Scenario.id`."""

    awaited: set[str] = dataclasses.field(default_factory=set)  #: Surfaces that answered before.
    beams: dict[str, m.Beam] = dataclasses.field(default_factory=dict)
    applied: set[str] = dataclasses.field(default_factory=set)  #: Surfaces that show their beams.

    @property
    def ready(self) -> dict[str, m.Beam]:
        """The beams that can carry data."""
        return {surface: beam for surface, beam in self.beams.items() if surface in self.applied}

    def add(self, surface: str, answer: m.Beam | m.RhsConfiguration) -> None:
        """Store the beam of a surface, or that the surface shows it."""
        if isinstance(answer, m.Beam):
            self.beams[surface] = answer
        else:
            self.applied.add(surface)

    def is_complete_with(self, surface: str, answer: m.Beam | m.RhsConfiguration) -> bool:
        """Return whether an answer makes its surface ready, which is the last awaited one."""
        others: Collection[str] = self.applied if isinstance(answer, m.Beam) else self.beams
        return surface in others and self.awaited <= self.ready.keys() | {surface}

    def next(self) -> 'Steering':
        """Return the begin of the next cycle, which awaits the surfaces that showed a beam."""
        return Steering(self.applied or self.awaited)


class Carriers:
    """Chooses the surface that carries the data of a user, by expected capacities.

    The data of a user move to another surface only if its capacity exceeds that of the present one
    by a ratio.
    """

    def __init__(self) -> None:
        self.n_handovers = 0
        # The surface that delivered the latest data of each user.
        self._latest: NewestDict[int, str] = NewestDict(MAX_USERS)
        # End of the time during which a surface is avoided [s].
        self._avoided_until_s: dict[str, float] = {}

    def choose(self, user: int, beams: Mapping[str, m.Beam], ratio: float, now_s: float) -> str:
        """Return the surface of one of the beams, of which there must be one at least."""
        def preference(surface: str) -> tuple[bool, float]:
            weight = ratio if surface == self._latest.get(user) else 1.0
            return (now_s >= self._avoided_until_s.get(surface, -math.inf),
                    weight * beams[surface].expected_bps)
        return max(beams, key=preference)

    def lose(self, surface: str, now_s: float) -> None:
        """Note that a surface has not delivered data."""
        self._avoided_until_s[surface] = now_s + _AVOIDED_S

    def deliver(self, user: int, surface: str) -> None:
        """Note that a surface has delivered the data of a user."""
        self.n_handovers += self._latest.get(user, surface) != surface
        self._latest.put(user, surface)
        self._avoided_until_s.pop(surface, None)
