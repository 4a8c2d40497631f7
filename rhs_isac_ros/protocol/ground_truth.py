"""The true positions of users, which only a simulation knows, by what was located."""

import sys

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import NewestDict

# Maximum number of nodes with the number of one user whose positions are kept.
_MAX_NODES = 8


class TruePositions:
    """The true positions in the newest `max_cycles` cycles, by default in all of them.

    If several nodes have the number of a user, each of them sends its own position.
    """

    def __init__(self, max_cycles: int = sys.maxsize) -> None:
        self._sent: NewestDict[tuple[int, int], NewestDict[int, m.GroundTruth]] = NewestDict(
            max_cycles)

    def add(self, truth: m.GroundTruth) -> None:
        """Add a true position, unless it belongs to no cycle."""
        if truth.cycle_id:
            key = truth.cycle_id, truth.user
            self._sent.put(key, self._sent.get(key) or NewestDict(_MAX_NODES))
            self._sent[key].put(truth.sender, truth)

    def of(self, located: m.ReceivedSignals | m.PositionEstimate | None) -> m.GroundTruth | None:
        """Return the true position of the user whose signals or estimate these are, or None."""
        if located is None or (sent := self._sent.get((located.cycle_id, located.user))) is None:
            return None
        return next((truth for sender, truth in reversed(sent.items())
                     if m.same_instance(sender, located.user_instance)), None)
