"""The users of a base station: which of them are invited and served, and who owns a number."""

import dataclasses
import math
from collections.abc import Callable, Iterable

import numpy as np

from rhs_isac_ros.protocol import messages as m

POLICIES = ('round_robin', 'first', 'random')
# Highest user number that is ever accepted. It bounds the memory, whatever acks arrive.
MAX_USERS = 4096
# Number of registered users that the first beacon of a cycle invites, and the factor by which each
# further beacon increases it. The number is small: a cycle serves one user, and acks take time.
INVITED, _EXTENSION = 8, 8
# Number of consecutive beacons without an answer after which a user is removed, and of consecutive
# incomplete cycles after which a senior loses this rank.
_MAX_MISSED = 3
# The owner of a number counts as silent if it has not answered for this time [s] while other nodes
# with the number have answered _MAX_MISSED beacons. A beacon invites all of these nodes or none.
SILENT_S = 1.0
# Time without a rejected ack after which a conflict has ended [s].
_CONFLICT_S = 5.0


@dataclasses.dataclass
class _User:
    """A registered user, and the node that owns its number."""

    # (number of a grant, 1, user) if this grant was the user's last one; (number of a grant, 0,
    # user) if the user was registered, or late, after this grant and has had none since then.
    order: tuple[int, int, int]
    missed: int = 0  # consecutive beacons without an answer
    instance: int = 0  # instance of the owner; 0 if unknown
    answered_s: float = 0.0  # time of the owner's last ack [s]
    rejected: int = 0  # number of acks from other instances since that ack


class UserRegistry:
    """Registers the users that answer beacons, and selects the next one to serve.

    A number belongs to the first node that answers with it, until this node falls silent. The
    policy selects the user served longest ago (``round_robin``), the ``first`` to answer, or one
    at ``random``. The first `INVITED` users that completed a cycle are seniors. When another user
    does not complete a cycle, the seniors precede all others for as long as that cycle took. Users
    that answer beacons but never complete a cycle therefore take at most half of the time.
    """

    def __init__(self, policy: str, rng: np.random.Generator) -> None:
        self.policy, self._rng = policy, rng
        self._users: dict[int, _User] = {}
        # Time at which a conflict was last observed [s], and the owner of the number, by number.
        self._conflicts: dict[int, tuple[float, int]] = {}
        # The registered users that were invited and have not answered yet.
        self._awaited: set[int] = set()
        # Users to serve once before all others, in the order of the requests.
        self._requested: dict[int, None] = {}
        # Number of consecutive incomplete cycles of each senior.
        self._seniors: dict[int, int] = {}
        # Whether seniors precede all others, and the time at which this ends [s].
        self._seniors_first, self._until_s = False, -math.inf
        self._n_grants = 0
        # Whether the latest beacon invited all users.
        self.all_invited = True
        # Users that answered in this cycle, in order; a dictionary serves as an ordered set.
        self.answered: dict[int, None] = {}

    def __len__(self) -> int:
        """Return the number of registered users."""
        return len(self._users)

    def invite(self, attempt: int) -> tuple[int, int]:
        """Choose the users to wait for, and return the first and the last number to invite.

        The range contains the user who is due. As other users become due, the ranges cover all
        numbers, so that new users are invited, too. `attempt` is the number of beacons in this
        cycle that nobody answered; the range grows with it.
        """
        self.answered = {}
        numbers, size = sorted(self._users), INVITED * _EXTENSION**min(attempt, 8)
        self.all_invited = size >= len(numbers)
        if self.all_invited:
            self._awaited = set(numbers)
            return 1, m.LAST_USER
        users = self._preferred(numbers)
        due = users[self._n_grants * INVITED % len(users)] if self.policy == 'first' else (
            self._choose(users))
        begin = numbers.index(due) // size * size
        invited = numbers[begin:begin + size]
        self._awaited = set(invited)
        return (numbers[begin - 1] + 1 if begin else 1,
                invited[-1] if begin + size < len(numbers) else m.LAST_USER)

    def request(self, user: int) -> None:
        """Serve a user once before all others, as soon as the user answers."""
        self._requested[user] = None

    def _preferred(self, users: Iterable[int]) -> list[int]:
        """Return the given users that take precedence: a requested one, else seniors, else all."""
        users = list(users)
        requested = [user for user in self._requested if user in users][:1]
        seniors = [user for user in users if self._seniors_first and user in self._seniors]
        return requested or seniors or users

    def _choose(self, users: list[int]) -> int:
        match self.policy:
            case 'first':
                return users[0]
            case 'random':
                return int(self._rng.choice(users))
        return min(users, key=lambda user: self._users[user].order)

    def is_taken(self, number: int, instance: int, now_s: float) -> bool:
        """Return whether another instance owns a number and is not silent."""
        user = self._users.get(number)
        return user is not None and instance != user.instance and (
            user.rejected < _MAX_MISSED or now_s < user.answered_s + SILENT_S)

    def reject(self, number: int) -> None:
        """Count an ack from an instance that does not own the number."""
        self._users[number].rejected += 1

    def register(self, number: int, instance: int = 0, now_s: float = 0.0) -> str:
        """Register a user that answered, even if too late for this cycle.

        With ``round_robin``, an invited user that answers too late goes to the end. Without this
        rule, a user that is always late would be due forever, and users in other ranges
        would not be invited. Returns a warning if the owner of the number answers after another
        instance was rejected and the conflict is new, otherwise ''.
        """
        user = self._users.get(number)
        # A new user comes after all waiting users and before the one served last, so that no user
        # gains by leaving and returning.
        if user is None:
            user = self._users[number] = _User((self._n_grants, 0, number), instance=instance)
        elif self.policy == 'round_robin' and number in self._awaited:
            user.order = self._n_grants, 0, number
        warning = ''
        if user.rejected and instance == user.instance:
            if self._in_conflict(now_s).get(number) != instance:
                warning = m.describe_conflict([number], instance)
            self._conflicts[number] = now_s, instance
        user.missed, user.rejected, user.instance, user.answered_s = 0, 0, instance, now_s
        return warning

    def add_answer(self, number: int, instance: int = 0, now_s: float = 0.0) -> str:
        """Register a user that answered in time; return a warning as `register` does."""
        self._awaited.discard(number)
        self.answered[number] = None
        return self.register(number, instance, now_s)

    def remove(self, number: int) -> None:
        """Remove a user until the user answers again, and release the number."""
        self._users.pop(number, None)
        self._awaited.discard(number)

    def owner(self, number: int) -> int:
        """Return the instance that owns a number; 0 if there is none or it is unknown."""
        user = self._users.get(number)
        return user.instance if user else 0

    def conflicts(self, now_s: float) -> dict[str, str]:
        """Return a description of the conflicts of each owner, by its key in the diagnostics."""
        return m.describe_conflicts(self._in_conflict(now_s))

    def _in_conflict(self, now_s: float) -> dict[int, int]:
        """Return the owner of each number that another node has, too."""
        return {number: instance for number, (latest_s, instance) in self._conflicts.items()
                if now_s < latest_s + _CONFLICT_S}

    def remove_all_except(self, is_allowed: Callable[[int], bool]) -> list[int]:
        """Remove and return the users that are not allowed."""
        removed = [user for user in sorted(self._users) if not is_allowed(user)]
        for user in removed:
            self.remove(user)
        return removed

    def is_complete_with(self, user: int) -> bool:
        """Return whether the answer of `user` is the last that the cycle needs."""
        if user in self._requested or (
                self.policy == 'first' and user in self._preferred({*self._awaited, user})):
            return True
        return self._awaited <= {user}

    def remove_absent(self) -> dict[int, int]:
        """Count missed invitations; remove the users that missed too many in a row.

        Returns the instances of their nodes by number, in ascending order.
        """
        for number in self._awaited:
            self._users[number].missed += 1
        lost = {number: self._users[number].instance for number in sorted(self._awaited)
                if self._users[number].missed >= _MAX_MISSED}
        for number in lost:
            self.remove(number)
        return lost

    def select(self) -> int:
        """Choose the user to serve among the users that answered."""
        chosen = self._choose(self._preferred(self.answered))
        self._requested.pop(chosen, None)
        self._n_grants += 1
        self._users[chosen].order = self._n_grants, 1, chosen
        return chosen

    def end_cycle(self, user: int, begin_s: float, now_s: float, *, completed: bool) -> None:
        """Update the seniors, and decide whether they precede all others in the next cycle."""
        seniors = self._seniors
        if completed and user not in seniors and len(seniors) == INVITED:
            # A senior that has left keeps this rank until another user takes it.
            seniors.pop(next((other for other in seniors if other not in self._users), 0), None)
        if user in seniors or completed and len(seniors) < INVITED:
            seniors[user] = 0 if completed else seniors[user] + 1
            if seniors[user] == _MAX_MISSED:
                del seniors[user]
        elif not completed:
            self._until_s = now_s + (now_s - begin_s)
        self._seniors_first = now_s < self._until_s
