"""The nodes that acknowledge beacons with the same user number."""

import dataclasses
from collections.abc import Iterable

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.instance import started

# Acks of older instances in a row after which the newest one no longer owns the number.
_MAX_MISSED = 3
# Time without a rejected ack after which a conflict has ended [s].
_CONFLICT_S = 5.0


@dataclasses.dataclass
class _Owner:
    """The instance that owns a number.

    Attributes
    ----------
    rejected
        Acks of other instances since the last one of this instance.
    """

    instance: int
    rejected: int = 0


class UserInstances:
    """Assigns each user number to one node, the newest of those that acknowledge with it.

    A restarted user owns its number at once. If the newest node falls silent, the number passes to
    an older one after a few beacons.
    """

    def __init__(self) -> None:
        self._owners: dict[int, _Owner] = {}
        # By user: time of the last rejected ack, and a description.
        self._conflicts: dict[int, tuple[float, str]] = {}

    def owner(self, user: int) -> int:
        """Return the instance that owns a number; 0 if none does or if it is unknown."""
        owner = self._owners.get(user)
        return owner.instance if owner else 0

    def is_superseded(self, user: int, instance: int) -> bool:
        """Return whether a newer instance owns a number."""
        owner = self._owners.get(user)
        return owner is not None and instance < owner.instance and owner.rejected < _MAX_MISSED

    def accept(self, user: int, instance: int) -> None:
        """Record an ack of the instance that owns a number from now on."""
        self._owners[user] = _Owner(instance)

    def reject(self, user: int, now_s: float) -> list[LogMessage]:
        """Record an ack of a superseded instance; return a warning about the first."""
        owner = self._owners[user]
        owner.rejected += 1
        text = (f'user {user}: two nodes have this number; the newer one, '
                f'{started(owner.instance)}, is served')
        known = user in self._conflicts
        self._conflicts[user] = now_s, text
        return [] if known else [LogMessage(text, warning=True)]

    def forget(self, users: Iterable[int], now_s: float) -> None:
        """Release the numbers of users that no longer answer, and end old conflicts."""
        for user in users:
            self._owners.pop(user, None)
        self._conflicts = {user: entry for user, entry in self._conflicts.items()
                           if now_s - entry[0] < _CONFLICT_S}

    def conflicts(self) -> dict[str, str]:
        """Return a description of each conflict, by key of the diagnostics."""
        return {f'conflict.user_{user}': text for user, (_, text) in self._conflicts.items()}
