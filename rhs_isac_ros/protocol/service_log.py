"""What a base station logs about its service: users, what it lacks, and outages."""

from collections.abc import Iterator

from rhs_isac_ros.protocol.events import LogMessage, Outcome
from rhs_isac_ros.protocol.role import NewestDict
from rhs_isac_ros.protocol.user_registry import MAX_USERS

# Reasons for a lost cycle that concern one user. All others concern the whole network.
_USER_REASONS = (Outcome.USER_GONE, Outcome.NO_FIX)


class ServiceLog:
    """Derives the messages of the log from what happens to cycles."""

    def __init__(self) -> None:
        # Outages that have been logged and have not ended, by reason, and number of the user, or 0
        # for all users, with the name of the state, which contains the instance of the user.
        self._outages: NewestDict[tuple[str, tuple[int, str]], None] = NewestDict(MAX_USERS)
        # Missing roles and codebook as logged last; empty once a cycle has begun.
        self._lacking: tuple[str, ...] = ()
        # Whether a cycle has been served since the last time that something was missing, and ever.
        self._serving = self._has_served = False

    def waits(self, lacking: tuple[str, ...]) -> Iterator[LogMessage]:
        """Log missing roles and codebook if they have changed."""
        self._serving = False
        if lacking != self._lacking:
            self._lacking = lacking
            # At the start, the other nodes may be about to start, too.
            yield LogMessage(
                f'waiting for {", ".join(lacking)}', self._has_served, 'service', True)

    def begins(self) -> None:
        """Note that a cycle has begun; a role that is missing later is then logged again."""
        self._lacking = ()

    def gives_up(self, cycle_id: int, user: int, instance: int, outcome: Outcome
                 ) -> Iterator[LogMessage]:
        """Log a lost cycle unless its outage has been logged."""
        affected = ((user, f'outage of user {user} {instance}') if outcome in _USER_REASONS
                    else (0, 'outage'))
        if (outcome.value, affected) not in self._outages:
            self._outages.put((outcome.value, affected), None)
            yield LogMessage(f'cycle {cycle_id} of user {user} given up: {outcome.value}', True,
                             affected[1], True)

    def serves(self, cycle_id: int, user: int, use: str) -> Iterator[LogMessage]:
        """Log the start of service, with what it uses, and the outages that ended."""
        if not self._serving:
            self._serving = self._has_served = True
            yield LogMessage(f'serving: {use}', False, 'service', False)
        ended = [outage for outage in self._outages if outage[1][0] in (0, user)]
        for outage in ended:
            del self._outages[outage]
        for affected in dict.fromkeys(affected for _, affected in ended):
            reasons = ', '.join(sorted(reason for reason, other in ended if other == affected))
            yield LogMessage(f'cycle {cycle_id}: user {user} served again after: {reasons}', False,
                             affected[1], False)
