"""The codebooks that follow a user: estimates propose them, and the base station takes them."""

from typing import Any

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.library import Library
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import NewestDict
from rhs_isac_ros.protocol.user_registry import MAX_USERS

# Time for which a proposed codebook holds, in intervals between the signals of the user.
_PATIENCE = 2.0


def proposal(library: Library, predicted: tuple[np.ndarray, float, float] | None
             ) -> dict[str, Any]:
    """Return the fields of an estimate that propose a codebook for the user's next cycle.

    The prediction is that of `Tracks.predict`. Without one, or far from all cells, the result is
    empty.
    """
    codebook = predicted and library.codebook_at(*predicted[:2])
    if not (predicted and codebook):
        return {}
    return {'next_codebook_id': codebook.id, 'next_codebook_s': _PATIENCE * predicted[2]}


class Proposals:
    """The codebooks of a library that estimates propose for the next cycle of their users.

    A proposal serves once: after a cycle without an estimate, there is none.
    """

    def __init__(self, library: Library) -> None:
        self._library = library
        # The latest estimate of each user, and its time of arrival [s].
        self._estimates: NewestDict[int, tuple[m.PositionEstimate, float]] = NewestDict(MAX_USERS)

    def add(self, estimate: m.PositionEstimate, now_s: float) -> None:
        """Store the proposal of an estimate that arrives at a time [s]."""
        self._estimates.put(estimate.user, (estimate, now_s))

    def drop(self, user: int) -> None:
        """Remove the proposal for a user."""
        self._estimates.pop(user, None)

    def take(self, user: int, instance: int, now_s: float) -> Codebook | None:
        """Remove the proposal for a user; return its codebook if it holds at a time [s]."""
        estimate, time_s = self._estimates.pop(user, (None, 0.0))
        if (estimate and now_s <= time_s + estimate.next_codebook_s
                and m.same_instance(estimate.user_instance, instance)):
            return self._library.by_id.get(estimate.next_codebook_id)
        return None
