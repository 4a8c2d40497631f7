"""What all roles have in common."""

import collections
from collections.abc import Mapping

from rhs_isac_ros.protocol.outcomes import Outcome


class CountingRole:
    """A role that counts outcomes.

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
        """Return the values in use and those pending, for the diagnostics.

        Returns
        -------
        Mapping
            Values by name, such as ``parameter.policy``, ``pending.policy`` and ``codebook_id``;
            empty if the role has no settings.
        """
        return {}


class PlainRole(CountingRole):
    """A role without states or time-outs: it only answers messages."""

    def next_deadline(self) -> float | None:
        """Return None: the role needs no `Tick`."""
        return None
