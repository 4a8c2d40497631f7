"""The nodes of users to which a base station addresses its messages."""

import math

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_instances import UserInstances
from rhs_isac_ros.protocol.user_scheduler import UserScheduler

# A beacon goes to all nodes if none did for this time [s], or none to the same range of users.
# Nodes that are not registered then join within a round, and all others learn that the base
# station is active.
OPEN_PERIOD_S = 0.25


class UserRecipients:
    """Chooses the nodes of users that receive the beacons and grants of a cycle.

    The registered nodes of the invited users are enough for most beacons.
    """

    def __init__(self, users: UserScheduler, instances: UserInstances) -> None:
        self._users, self._instances = users, instances
        self._cycle_id = 0
        # Nodes that answered in this cycle, also with a number that a newer node owns.
        self._answered: set[int] = set()
        # Time of the latest beacon to all nodes [s]: of any range, and by its first user.
        self._opened_s = -math.inf
        self._range_opened_s: dict[int, float] = {}

    def add_answer(self, cycle_id: int, instance: int) -> None:
        """Record the node of an ack."""
        if cycle_id == self._cycle_id:
            self._answered.add(instance)

    def of_beacon(self, beacon: m.Beacon, now_s: float) -> tuple[int, ...]:
        """Return the instances that receive a beacon; empty: all nodes.

        Parameters
        ----------
        now_s
            Time on any monotonic clock [s].
        """
        if beacon.cycle_id != self._cycle_id:
            self._cycle_id = beacon.cycle_id
            self._answered.clear()
        first_user, due_s = beacon.first_user, now_s - OPEN_PERIOD_S
        # A further beacon of a cycle follows one that nobody answered.
        if (beacon.attempt or self._users.all_invited or self._opened_s <= due_s
                or self._range_opened_s.get(first_user, -math.inf) <= due_s):
            self._opened_s = now_s
            # Ranges change with the registered users.
            self._range_opened_s = {
                first: opened_s for first, opened_s in self._range_opened_s.items()
                if opened_s > due_s} | {first_user: now_s}
            return ()
        return tuple(sorted(self._owners()))

    def of_grant(self) -> tuple[int, ...]:
        """Return the instances that wait for the grant; empty: all nodes.

        An ack that has not arrived yet may be on its way.
        """
        return tuple(sorted(self._answered | self._owners()))

    def _owners(self) -> set[int]:
        return {self._instances.owner(user) for user in self._users.awaited}
