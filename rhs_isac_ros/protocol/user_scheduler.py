"""The users that a base station knows, and whom of them it serves next."""

import numpy as np

POLICIES = ('round_robin', 'first', 'random')
# A user that leaves so many beacons in a row without an answer is not waited for.
_PATIENCE = 3
# More that answer at once are refused: numbers cost nothing, memory does.
_MOST_USERS = 1024


class UserScheduler:
    """Users that answer beacons.

    Parameters
    ----------
    policy
        ``round_robin``: who was served longest ago; ``first``: who answered first; ``random``.
    rng
        Source of randomness, for ``random``.

    Raises
    ------
    ValueError
        If there is no such policy.
    """

    def __init__(self, policy: str, rng: np.random.Generator) -> None:
        self._rng = rng
        self.follow(policy)
        # The turn in which a user was served last, 1, or after which it came, 0.
        self._served: dict[int, tuple[int, int]] = {}
        self._missed: dict[int, int] = {}
        self._turn = 0
        self.answered: list[int] = []

    def follow(self, policy: str) -> None:
        """Select by a policy from now on; who was served when stays known.

        Parameters
        ----------
        policy
            The policy.

        Raises
        ------
        ValueError
            If there is no such policy.
        """
        if policy not in POLICIES:
            raise ValueError(f'policy: {policy!r}, expected one of {list(POLICIES)}')
        self._policy = policy

    def open(self) -> None:
        """Begin a cycle: nobody has answered yet."""
        self.answered = []

    def is_full_for(self, user: int) -> bool:
        """Tell whether there is no place for a user.

        Parameters
        ----------
        user
            The user.

        Returns
        -------
        bool
            True if it is not known, and no other can be.
        """
        return user not in self._missed and len(self._missed) >= _MOST_USERS

    def welcome(self, user: int) -> None:
        """Know a user, without counting it as answering.

        Parameters
        ----------
        user
            The user.
        """
        # A newcomer stands behind all that wait, and before who was served just now: who comes
        # and goes takes nobody's turn.
        self._served.setdefault(user, (self._turn, 0))
        self._missed[user] = 0

    def answer(self, user: int) -> None:
        """Count a user as answering in this cycle.

        Parameters
        ----------
        user
            The user.
        """
        self.welcome(user)
        self.answered.append(user)

    def forget(self, user: int) -> None:
        """Wait for a user no longer; it is known again when it answers.

        Parameters
        ----------
        user
            The user.
        """
        self._missed.pop(user, None)
        self._served.pop(user, None)

    def complete_with(self, user: int) -> bool:
        """Tell whether a user's answer leaves nobody to wait for.

        Parameters
        ----------
        user
            The user that answers.

        Returns
        -------
        bool
            True if the selection need not wait.
        """
        if self._policy == 'first':
            return True
        return self._missed.keys() <= {*self.answered, user}

    def give_up(self) -> list[int]:
        """Wait no longer for users that have not answered for some cycles; the list closes.

        Returns
        -------
        list of int
            Who is not waited for any more.
        """
        lost = []
        for user in sorted(self._missed.keys() - set(self.answered)):
            self._missed[user] += 1
            if self._missed[user] >= _PATIENCE:
                self.forget(user)
                lost.append(user)
        return lost

    def select(self) -> int:
        """Choose among those that answered.

        Returns
        -------
        int
            The user to serve.
        """
        if self._policy == 'first':
            chosen = self.answered[0]
        elif self._policy == 'random':
            chosen = int(self._rng.choice(self.answered))
        else:
            chosen = min(self.answered, key=lambda user: (self._served[user], user))
        self._turn += 1
        self._served[chosen] = self._turn, 1
        return chosen
