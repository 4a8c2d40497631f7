"""Log messages about service and its outages, one at the beginning and one at the end of each."""

from collections.abc import Iterable, Sequence

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.newest import NewestDict
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.user_scheduler import MAX_USERS

# Maximum number of users that one text names.
MAX_NAMED = 8


def join_users(users: Iterable[int]) -> str:
    """Return the numbers of users as a list, which ends with a count of those beyond `MAX_NAMED`.

    Examples
    --------
    >>> join_users(range(1, 12))
    '1, 2, 3, 4, 5, 6, 7, 8 and 3 others'
    """
    names = [str(user) for user in users]
    n_others = len(names) - MAX_NAMED
    others = f' and {n_others} other{"s" * (n_others > 1)}' if n_others > 0 else ''
    return f'{", ".join(names[:MAX_NAMED])}{others}'


# The reasons that concern one user; all others concern the whole network.
_USER_REASONS = {Outcome.USER_GONE.value, Outcome.NO_FIX.value}
# Maximum number of outages of users that are remembered, which bounds the memory.
_MAX_OPEN = MAX_USERS


class OutageLog:
    """Suppresses repeated log messages about the same outage.

    Missing roles are logged again once a cycle has begun. The reason for a lost cycle is logged
    again once service has resumed: to the same user for ``user_gone`` and ``no_fix``, to any user
    for other reasons.
    """

    def __init__(self) -> None:
        # Reason and user of each outage; user 0 for the whole network.
        self._open: NewestDict[tuple[str, int], None] = NewestDict(_MAX_OPEN)
        self._waiting_for: tuple[str, ...] = ()
        # Whether a cycle was served since something was missing.
        self._serving = False

    def log_waiting(self, missing: Iterable[str]) -> list[LogMessage]:
        """Return a warning about what is missing, unless the last one had the same text."""
        previous, self._waiting_for = self._waiting_for, tuple(missing)
        self._serving = False
        if self._waiting_for == previous:
            return []
        return [LogMessage(f'waiting for {", ".join(self._waiting_for)}', warning=True)]

    def clear_waiting(self) -> None:
        """Record that nothing is missing, because a cycle has begun."""
        self._waiting_for = ()

    @staticmethod
    def log_lost_users(users: Sequence[int]) -> list[LogMessage]:
        """Return a warning about users that stopped answering beacons, if any."""
        if not users:
            return []
        text = (f'users {join_users(users)} no longer answer' if len(users) > 1
                else f'user {users[0]} no longer answers')
        return [LogMessage(text, warning=True)]

    def log_lost_cycle(self, cycle_id: int, user: int, reason: str) -> list[LogMessage]:
        """Return a warning about a cycle without service, unless its reason was logged before."""
        key = reason, user if reason in _USER_REASONS else 0
        if key in self._open:
            return []
        self._open.put(key, None)
        return [LogMessage(f'cycle {cycle_id} of user {user} given up: {reason}', warning=True)]

    @staticmethod
    def log_removed_users(users: Iterable[int], allowed: str) -> list[LogMessage]:
        """Return a message for each user that is not in the new list of allowed users."""
        return [LogMessage(f'user {user} removed: not in allowed_users {allowed!r}')
                for user in users]

    def log_served_cycle(
            self, cycle_id: int, user: int, codebook_id: str, n_users: int) -> list[LogMessage]:
        """Return messages that service begins, and about the outages that a cycle ends, if any."""
        messages = []
        if not self._serving:
            self._serving = True
            messages.append(LogMessage(
                f'serving: codebook {codebook_id}, {n_users} user{"s" * (n_users != 1)}'))
        if ended := {key for key in self._open if key[1] in (0, user)}:
            for key in ended:
                del self._open[key]
            reasons = ', '.join(sorted(reason for reason, _ in ended))
            messages.append(LogMessage(
                f'cycle {cycle_id}: user {user} served again after: {reasons}'))
        return messages
