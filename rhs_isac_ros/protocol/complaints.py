"""Saying once what is amiss, and once that it is mended."""

from rhs_isac_ros.protocol.events import Note

# The reason that concerns one user; all others concern the network.
_OF_A_USER = 'user_gone'


class Complaints:
    """Why cycles are given up, each reason told once until a cycle is served.

    That a user is gone is mended by serving that user, all else by serving anybody.
    """

    def __init__(self) -> None:
        self._open: set[tuple[str, int]] = set()

    def given_up(self, cycle_id: int, user: int, reason: str) -> list[Note]:
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
        return [Note(f'cycle {cycle_id}: user {user} given up: {reason}', warning=True)]

    def served(self, cycle_id: int, user: int) -> list[Note]:
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
        return [Note(f'cycle {cycle_id}: user {user} served again after: {reasons}')]
