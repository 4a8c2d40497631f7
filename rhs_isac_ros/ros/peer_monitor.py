"""Which of the roles that a node needs are there."""

from collections.abc import Callable, Mapping

from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.timers import steady_timer

# How often it looks while somebody is missing, and while nobody is: a look takes half a
# millisecond, which a crowd of users would spend all the time.
_POLL_S, _CALM_POLL_S = 0.1, 1.0
# Looks before the first complaint: at the start, everyone is still being discovered.
_GRACE = 10

# What must be seen of a role: topics it publishes, and topics it subscribes to.
EndpointRequirements = tuple[tuple[type[m.Message], ...], tuple[type[m.Message], ...]]
OF_BASE_STATION: Mapping[str, EndpointRequirements] = {
    'rhs_controller': ((m.RhsConfiguration,), (m.RhsCommand,)),
    'channel': ((m.FeedSignals,), (m.Pilot,)),
    'positioner': ((m.PositionEstimate,), (m.ReceivedSignals,)),
    'transmission': ((m.Beam,), ()),
}
OF_USER: Mapping[str, EndpointRequirements] = {
    'channel': ((m.FeedSignals,), (m.Pilot,)),
    'bs': ((m.Beacon,), (m.Ack,)),
}


class PeerMonitor:
    """Watches the graph and reports changes of the missing roles.

    A role counts as present once it was seen twice in a row, which gives the other side time to
    see this node too.

    Parameters
    ----------
    node
        The node that needs the roles.
    needs
        What must be seen of each role.
    on_change
        Called with the names of the missing roles: when none is missing, or after a moment, and
        then whenever they change.
    """

    def __init__(
            self, node: Node, needs: Mapping[str, EndpointRequirements],
            on_change: Callable[[tuple[str, ...]], None]) -> None:
        self._node, self._needs, self._on_change = node, needs, on_change
        self._before: frozenset[str] = frozenset(needs)
        self._reported: tuple[str, ...] | None = None
        self._looks = 0
        self._timer = steady_timer(node, _POLL_S, self._look)

    def _look(self) -> None:
        absent = frozenset(role for role, signs in self._needs.items() if not self._seen(signs))
        missing = tuple(role for role in self._needs if role in absent | self._before)
        self._before = absent
        self._looks += 1
        if missing and self._reported is None and self._looks < _GRACE:
            return
        if missing != self._reported:
            self._reported = missing
            self._timer.timer_period_ns = int(1e9 * (_POLL_S if missing else _CALM_POLL_S))
            self._on_change(missing)

    def _seen(self, signs: EndpointRequirements) -> bool:
        publishes, subscribes = signs
        return (all(self._node.count_publishers(self._name(kind)) for kind in publishes)
                and all(self._node.count_subscribers(self._name(kind)) for kind in subscribes))

    def _name(self, kind: type[m.Message]) -> str:
        """Name of a topic after remapping, which the counts do not apply."""
        return self._node.resolve_topic_name(topics.NAMES[kind])
