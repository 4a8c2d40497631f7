"""Log messages about outages, one at the beginning of each and one at its end."""

from collections.abc import Iterable

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.outcomes import Outcome

# The reason that concerns one user; all others concern the whole network.
_USER_REASON = Outcome.USER_GONE.value


class OutageLog:
    """Suppresses repeated log messages about the same outage.

    Missing roles are logged again once a cycle has begun. The reason for a lost cycle is logged
    again once service has resumed: to the same user for ``user_gone``, to any user for other
    reasons.
    """

    def __init__(self) -> None:
        # Reason and user of each outage; user 0 for the whole network.
        self._open: set[tuple[str, int]] = set()
        self._waiting_for: tuple[str, ...] = ()

    def log_waiting(self, missing: Iterable[str]) -> list[LogMessage]:
        """Return a warning about what is missing, unless the last one had the same text."""
        previous, self._waiting_for = self._waiting_for, tuple(missing)
        if self._waiting_for == previous:
            return []
        return [LogMessage(f'waiting for {", ".join(self._waiting_for)}', warning=True)]

    def clear_waiting(self) -> None:
        """Record that nothing is missing, because a cycle has begun."""
        self._waiting_for = ()

    @staticmethod
    def log_lost_users(users: Iterable[int]) -> list[LogMessage]:
        """Return a warning for each user that stopped answering beacons."""
        return [LogMessage(f'user {user} no longer answers', warning=True) for user in users]

    def log_lost_cycle(self, cycle_id: int, user: int, reason: str) -> list[LogMessage]:
        """Return a warning about a cycle without service, unless its reason was logged before."""
        key = reason, user if reason == _USER_REASON else 0
        if key in self._open:
            return []
        self._open.add(key)
        return [LogMessage(f'cycle {cycle_id} of user {user} given up: {reason}', warning=True)]

    def log_served_cycle(self, cycle_id: int, user: int) -> list[LogMessage]:
        """Return a message about the outages that a served cycle ends, if any."""
        ended = {key for key in self._open if key[1] in (0, user)}
        if not ended:
            return []
        self._open -= ended
        reasons = ', '.join(sorted(reason for reason, _ in ended))
        return [LogMessage(f'cycle {cycle_id}: user {user} served again after: {reasons}')]
