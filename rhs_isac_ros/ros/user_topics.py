"""Topics of single users, for a bounded number of users."""

import time
from collections.abc import Mapping

from rclpy.node import Node
from rclpy.publisher import Publisher

from rhs_isac_ros.ros import qos
from rhs_isac_ros.ros.endpoints import create_publisher

# Every topic takes time in discovery, and the ids of the users come from messages.
MAX_USERS = 64
# A user without messages for this time [s] gives up its topics if another user needs them.
_IDLE_S = 60.0


class UserTopics:
    """Publishers for each of the first `MAX_USERS` users.

    Parameters
    ----------
    kinds
        Types by name of the topic, which contains ``{user}``.
    """

    def __init__(self, node: Node, kinds: Mapping[str, type]) -> None:
        self._node, self._kinds = node, kinds
        self._publishers: dict[int, tuple[Publisher, ...]] = {}
        # Time of the latest use [s], by user; the user idle for longest comes first.
        self._used_s: dict[int, float] = {}

    def publishers(self, user: int) -> tuple[Publisher, ...]:
        """Return the publishers for a user, in the order of `kinds`; empty if there are too many.

        They are created on first use.
        """
        now_s = time.monotonic()
        if user not in self._publishers and not self._has_space(now_s):
            self._node.get_logger().warning(
                f'no topics for user {user}: {MAX_USERS} users have topics', once=True)
            return ()
        if user not in self._publishers:
            self._publishers[user] = tuple(
                create_publisher(self._node, kind, name.format(user=user), qos.EXCHANGE)
                for name, kind in self._kinds.items())
        self._used_s.pop(user, None)
        self._used_s[user] = now_s
        return self._publishers[user]

    def remove(self, user: int) -> None:
        """Destroy the publishers for a user, if any."""
        self._used_s.pop(user, None)
        for publisher in self._publishers.pop(user, ()):
            self._node.destroy_publisher(publisher)

    def _has_space(self, now_s: float) -> bool:
        if len(self._publishers) < MAX_USERS:
            return True
        idle, used_s = next(iter(self._used_s.items()))
        if now_s < used_s + _IDLE_S:
            return False
        self.remove(idle)
        return True
