"""Saying once what is amiss, and once that it is mended."""

from collections.abc import Iterable

from rhs_isac_ros.protocol.events import LogMessage

# The reason that concerns one user; all others concern the network.
_OF_A_USER = 'user_gone'


class OutageLog:
    """Why no cycle begins, and why cycles are given up, each reason told once.

    What is waited for is told again after a cycle has begun, why one was given up after one was
    served. That a user is gone is mended by serving that user, all else by serving anybody.
    """

    def __init__(self) -> None:
        self._open: set[tuple[str, int]] = set()
        self._needs: tuple[str, ...] = ()

    def waiting(self, needs: Iterable[str]) -> list[LogMessage]:
        """Enter that no cycle can begin.

        Parameters
        ----------
        needs
            What it takes.

        Returns
        -------
        list of Note
            A warning, unless the same was said already.
        """
        said, self._needs = self._needs, tuple(needs)
        if self._needs == said:
            return []
        return [LogMessage(f'waiting for {", ".join(self._needs)}', warning=True)]

    def begun(self) -> None:
        """Enter that a cycle has begun."""
        self._needs = ()

    @staticmethod
    def lost(users: Iterable[int]) -> list[LogMessage]:
        """Enter users that are not waited for any more.

        Parameters
        ----------
        users
            Their numbers.

        Returns
        -------
        list of Note
            A warning of each.
        """
        return [LogMessage(f'user {user} answers no more', warning=True) for user in users]

    def given_up(self, cycle_id: int, user: int, reason: str) -> list[LogMessage]:
        """Enter a cycle that was given up.

        Parameters
        ----------
        cycle_id, user
            Which cycle, and whose.
        reason
            Why.

        Returns
        -------
        list of Note
            A warning, unless the same was said already.
        """
        key = reason, user if reason == _OF_A_USER else 0
        if key in self._open:
            return []
        self._open.add(key)
        return [LogMessage(f'cycle {cycle_id}: user {user} given up: {reason}', warning=True)]

    def served(self, cycle_id: int, user: int) -> list[LogMessage]:
        """Enter a cycle that was served.

        Parameters
        ----------
        cycle_id, user
            Which cycle, and whose.

        Returns
        -------
        list of Note
            What is mended by that, if anything.
        """
        mended = {key for key in self._open if key[1] in (0, user)}
        if not mended:
            return []
        self._open -= mended
        reasons = ', '.join(sorted(reason for reason, _ in mended))
        return [LogMessage(f'cycle {cycle_id}: user {user} served again after: {reasons}')]
