"""Presence of the roles that a node needs, as seen in the ROS graph."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.protocol.user import User
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.timers import steady_timer

# Poll period while a role is missing, and while none is. A poll takes half a millisecond, which
# adds up over many users.
_POLL_S, _IDLE_POLL_S = 0.1, 1.0
# Polls before the first report of missing roles, while discovery is still under way.
_GRACE_POLLS = 10


class Endpoints(NamedTuple):
    """Publishers and subscriptions of a role, by message."""

    publishers: tuple[type[m.Message], ...]
    subscriptions: tuple[type[m.Message], ...]


_ENDPOINTS = {
    'bs': Endpoints(BaseStation.SENDS, BaseStation.RECEIVES),
    'user': Endpoints(User.SENDS, User.RECEIVES),
    'rhs_controller': Endpoints(RhsController.SENDS, RhsController.RECEIVES),
    'channel': Endpoints(Channel.SENDS, Channel.RECEIVES),
    'positioner': Endpoints(Positioner.SENDS, Positioner.RECEIVES),
    'transmission': Endpoints(Transmission.SENDS, Transmission.RECEIVES),
}


def identifying_endpoints(role: str) -> Endpoints:
    """Return the endpoints that show the presence of a role.

    These are the first message in `SENDS` that no other role sends, and the first in `RECEIVES`
    that no other role receives, if any. One of each is enough, because a node creates its
    publishers together and its subscriptions together.
    """
    others = [endpoints for name, endpoints in _ENDPOINTS.items() if name != role]
    sent = {kind for other in others for kind in other.publishers}
    received = {kind for other in others for kind in other.subscriptions}
    publishers, subscriptions = _ENDPOINTS[role]
    return Endpoints(
        tuple(kind for kind in publishers if kind not in sent)[:1],
        tuple(kind for kind in subscriptions if kind not in received)[:1])


REQUIRED_BY_BASE_STATION: Mapping[str, Endpoints] = {
    role: identifying_endpoints(role)
    for role in ('rhs_controller', 'channel', 'positioner', 'transmission')}
REQUIRED_BY_USER: Mapping[str, Endpoints] = {
    role: identifying_endpoints(role) for role in ('channel', 'bs')}


class PeerMonitor:
    """Polls the ROS graph and reports changes of the set of missing roles.

    A role is present once two polls in a row have found it, which gives it time to discover this
    node as well.

    Parameters
    ----------
    on_change
        Called with the names of the missing roles: as soon as none is missing or after a grace
        period, and then on every change.
    """

    def __init__(
            self, node: Node, required: Mapping[str, Endpoints],
            on_change: Callable[[tuple[str, ...]], None]) -> None:
        self._node, self._required, self._on_change = node, required, on_change
        self._timer = steady_timer(node, _POLL_S, self._poll)
        self.restart()

    def stop(self) -> None:
        """Report no more changes."""
        self._timer.cancel()

    def restart(self) -> None:
        """Report the missing roles anew, as after the start."""
        self._absent_before: frozenset[str] = frozenset(self._required)
        self._reported: tuple[str, ...] | None = None
        self._polls = 0
        self._timer.timer_period_ns = int(1e9 * _POLL_S)
        self._timer.reset()

    def _poll(self) -> None:
        absent = frozenset(role for role, endpoints in self._required.items()
                           if not self._exist(endpoints))
        missing = tuple(role for role in self._required if role in absent | self._absent_before)
        self._absent_before = absent
        self._polls += 1
        if missing and self._reported is None and self._polls < _GRACE_POLLS:
            return
        if missing != self._reported:
            self._reported = missing
            self._timer.timer_period_ns = int(1e9 * (_POLL_S if missing else _IDLE_POLL_S))
            self._on_change(missing)

    def _exist(self, endpoints: Endpoints) -> bool:
        return (all(self._node.count_publishers(self._topic(kind))
                    for kind in endpoints.publishers)
                and all(self._node.count_subscribers(self._topic(kind))
                        for kind in endpoints.subscriptions))

    def _topic(self, kind: type[m.Message]) -> str:
        # The counts do not apply remapping rules.
        return self._node.resolve_topic_name(topics.NAMES[kind])
