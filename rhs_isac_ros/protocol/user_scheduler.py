"""The users that a base station waits for, and the order in which it serves them."""

from collections.abc import Callable

import numpy as np

POLICIES = ('round_robin', 'first', 'random')
# Number of consecutive beacons without an answer after which a user is removed.
_MAX_MISSED = 3
# Maximum number of registered users, which bounds the memory whatever ids the acks contain.
_MAX_USERS = 1024


class UserScheduler:
    """Registers the users that answer beacons and selects the next one to serve.

    Parameters
    ----------
    policy
        ``round_robin``: the user served longest ago; ``first``: the first to answer; ``random``.
    rng
        Source of randomness, for ``random``.

    Attributes
    ----------
    answered
        Users that answered in this cycle, in order.

    Raises
    ------
    ValueError
        If the policy is unknown.
    """

    def __init__(self, policy: str, rng: np.random.Generator) -> None:
        self._rng = rng
        self.set_policy(policy)
        # By user: (turn, 1) if it was served in that turn, (turn, 0) if it was registered after
        # it and not served yet.
        self._served: dict[int, tuple[int, int]] = {}
        # By user: consecutive beacons without an answer.
        self._missed: dict[int, int] = {}
        self._turn = 0
        self.answered: list[int] = []

    def set_policy(self, policy: str) -> None:
        """Change the policy; the turns of the users are kept.

        Raises
        ------
        ValueError
            If the policy is unknown.
        """
        if policy not in POLICIES:
            raise ValueError(f'policy: {policy!r}, expected one of {list(POLICIES)}')
        self._policy = policy

    def begin_cycle(self) -> None:
        """Clear the answers."""
        self.answered = []

    def is_full_for(self, user: int) -> bool:
        """Return whether a user is new while the maximum number of users is registered."""
        return user not in self._missed and len(self._missed) >= _MAX_USERS

    def register(self, user: int) -> None:
        """Wait for a user, without counting it among those that answered."""
        # A new user comes after all that wait and before the one served last, so that users that
        # leave and return do not gain turns.
        self._served.setdefault(user, (self._turn, 0))
        self._missed[user] = 0

    def add_answer(self, user: int) -> None:
        """Register a user as answering in this cycle."""
        self.register(user)
        self.answered.append(user)

    def remove(self, user: int) -> None:
        """Stop waiting for a user until it answers again."""
        self._missed.pop(user, None)
        self._served.pop(user, None)

    @property
    def n_users(self) -> int:
        """Number of registered users."""
        return len(self._missed)

    def remove_all_except(self, is_allowed: Callable[[int], bool]) -> list[int]:
        """Remove and return the users that are not allowed."""
        removed = [user for user in sorted(self._missed) if not is_allowed(user)]
        for user in removed:
            self.remove(user)
        return removed

    def is_complete_with(self, user: int) -> bool:
        """Return whether no further answers are needed once `user` has answered."""
        if self._policy == 'first':
            return True
        return self._missed.keys() <= {*self.answered, user}

    def remove_absent(self) -> list[int]:
        """Count missed beacons; remove and return the users that missed too many in a row."""
        lost = []
        for user in sorted(self._missed.keys() - set(self.answered)):
            self._missed[user] += 1
            if self._missed[user] >= _MAX_MISSED:
                self.remove(user)
                lost.append(user)
        return lost

    def select(self) -> int:
        """Return the user to serve, one of those that answered."""
        if self._policy == 'first':
            chosen = self.answered[0]
        elif self._policy == 'random':
            chosen = int(self._rng.choice(self.answered))
        else:
            chosen = min(self.answered, key=lambda user: (self._served[user], user))
        self._turn += 1
        self._served[chosen] = self._turn, 1
        return chosen
