"""Who is in the network: the nodes and topics of the ROS graph."""

import collections
import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.messages import MessageError
from rhs_isac_ros.protocol.presences import Presence, Presences
from rhs_isac_ros.ros import convert, endpoints, topics
from rhs_isac_ros.ros.roster import ROSTER, identifying_endpoints

# Poll period while a role is missing or nodes are in conflict, and otherwise. A poll takes half a
# millisecond, which adds up over many users.
_POLL_S, _IDLE_POLL_S = 0.1, 1.0
# Polls before the first report of missing roles, while discovery is still under way.
_GRACE_POLLS = 10
# Maximum number of incompatible endpoints that are logged, which bounds the log.
_MAX_LOGGED = 16
# Topics of every node, which are not ours.
_FOREIGN = ('/rosout', '/parameter_events')
# What the middleware returns instead of the name of a node: it has not arrived yet, or the
# participant is unknown, which also endpoints of processes that have ended may be for a time.
_NOT_YET = '_NODE_NAME_UNKNOWN_'
_UNNAMED = (_NOT_YET, '_CREATED_BY_BARE_DDS_APP_')
# Number of bytes of the identity of an endpoint that identify its participant.
_PREFIX_LENGTH = 12

_last_instance = 0


def new_instance() -> int:
    """Return the instance of a node that starts now, unique in this process [ns since 1970]."""
    global _last_instance
    _last_instance = max(time.time_ns(), _last_instance + 1)
    return _last_instance


class Peers:
    """Polls the ROS graph for what a node needs to know about the others.

    A role is missing if no node has all `identifying_endpoints`, and present once two polls in a
    row have found them, which gives it time to discover this node as well. A node of a unique role
    also announces its instance on a latched topic: of two with the same role, the newer serves
    until it disappears from the graph. Endpoints that cannot exchange messages, because one
    requests a quality of service that the other does not offer, are logged.

    Parameters
    ----------
    role
        Role of the node, a key of `ROSTER`.
    instance
        Instance of the node; see `Message.sender`.
    on_missing
        Called with the roles that are missing, by name with a description: as soon as none is
        missing or after a grace period, and then on every change.
    on_rival
        Called with whether the node stands by, when nodes with the same role appear or go.
    """

    def __init__(
            self, node: Node, role: str, instance: int, scenario: Scenario,
            on_missing: Callable[[dict[str, str]], None],
            on_rival: Callable[[bool], None]) -> None:
        self._node, self._on_missing, self._on_rival = node, on_missing, on_rival
        self._required = {name: identifying_endpoints(name) for name in ROSTER[role].needed}
        # By role that was found last: the number of endpoints of each topic then.
        self._present: dict[str, tuple[int, ...]] = {}
        # Number of endpoints by topic at the last poll, and incompatible ones by topic and node.
        self._counts: list[tuple[str, int, int]] = []
        self._incompatible: dict[tuple[str, str], str] = {}
        # Endpoints that were logged; those that are created again are not logged again.
        self._logged: set[tuple[str, str]] = set()
        self._presences = Presences(Presence(
            instance, scenario.id, role, node.get_fully_qualified_name(), scenario.fields()))
        self._is_announced = ROSTER[role].is_unique
        # Whether the last poll found that a node in conflict has gone.
        self._is_short = False
        if self._is_announced:
            self._publisher = endpoints.create_publisher(
                node, ros.Presence, topics.PRESENCE, endpoints.LATCHED)
            endpoints.subscribe(node, ros.Presence, topics.PRESENCE, self._receive,
                                endpoints.PRESENCES, raw=True)
            self._announce()
        self._timer = endpoints.steady_timer(node, _POLL_S, self._poll)
        self.restart()

    def restart(self) -> None:
        """Report the missing roles anew, as after the start."""
        self._absent_before = frozenset(self._required)
        self._reported: dict[str, str] | None = None
        self._polls = 0
        self._set_period(_POLL_S)

    def conflicts(self) -> dict[str, str]:
        """Return a description of each conflict and refusal, by key of the diagnostics."""
        return self._presences.conflicts() | {
            f'conflict.qos.{topic.lstrip("/")}.{name.lstrip("/")}': text
            for (topic, name), text in self._incompatible.items()} | {
            f'conflict.{what.replace(" ", "_")}': text
            for what, text in endpoints.refusals(self._node).items()}

    def _poll(self) -> None:
        self._polls += 1
        self._report_missing()
        self._examine_qos()
        if self._presences.others:
            self._look_for_rivals()
        busy = self._reported != {} or self._presences.others
        self._set_period(_POLL_S if busy else _IDLE_POLL_S)

    def _set_period(self, period_s: float) -> None:
        if self._timer.timer_period_ns != int(1e9 * period_s):
            self._timer.timer_period_ns = int(1e9 * period_s)
            self._timer.reset()

    # Roles that are required

    def _report_missing(self) -> None:
        lacking = {name: text for name in self._required if (text := self._lacking(name))}
        missing = {name: lacking.get(name, name) for name in self._required
                   if name in lacking or name in self._absent_before}
        self._absent_before = frozenset(lacking)
        if missing and self._reported is None and self._polls < _GRACE_POLLS:
            return
        if missing != self._reported:
            self._reported = missing
            self._on_missing(missing)

    def _lacking(self, name: str) -> str:
        """Return a missing role with the endpoints that it lacks; empty if it lacks none."""
        node, (publishers, subscriptions) = self._node, self._required[name]
        # The counts do not apply remapping rules.
        wanted = [*(('publisher', node.resolve_topic_name(topic)) for topic in publishers),
                  *(('subscriber', node.resolve_topic_name(topic)) for topic in subscriptions)]
        counts = tuple(node.count_publishers(topic) if kind == 'publisher'
                       else node.count_subscribers(topic) for kind, topic in wanted)
        if counts == self._present.get(name):
            return ''
        # Observers have single endpoints, so that only a node with all of them is present.
        owners = [{_owner(info) for info in (
            node.get_publishers_info_by_topic(topic) if kind == 'publisher'
            else node.get_subscriptions_info_by_topic(topic))} for kind, topic in wanted]
        absent = [f'no {kind} of {topic}' for (kind, topic), found in zip(
            wanted, owners, strict=True) if not found & owners[0]]
        if absent:
            is_gone = len(absent) == len(wanted)
            return name if is_gone else f'{name} ({", ".join(absent)})'
        self._present[name] = counts
        return ''

    # Quality of service

    def _examine_qos(self) -> None:
        """Log endpoints of others that cannot exchange messages with those of this node."""
        node = self._node
        ours = {*(publisher.topic_name for publisher in node.publishers),
                *(subscription.topic_name for subscription in node.subscriptions)}
        counts = [(topic, node.count_publishers(topic), node.count_subscribers(topic))
                  for topic in sorted(ours.difference(_FOREIGN))]
        if counts == self._counts:
            return
        self._counts = counts
        found = {(topic, name): text for topic, _, _ in counts
                 for name, text in self._mismatches(topic)}
        for key in sorted(found.keys() - self._logged)[:_MAX_LOGGED - len(self._logged)]:
            self._logged.add(key)
            node.get_logger().warning(found[key])
        self._incompatible = found

    def _mismatches(self, topic: str) -> Iterator[tuple[str, str]]:
        """Yield node and description of each incompatible endpoint of a topic."""
        own = self._node.get_fully_qualified_name()
        publishers = self._node.get_publishers_info_by_topic(topic)
        subscriptions = self._node.get_subscriptions_info_by_topic(topic)
        for publisher, subscription in itertools.product(publishers, subscriptions):
            names = {full_name(publisher), full_name(subscription)}
            if publisher.node_name in _UNNAMED or subscription.node_name in _UNNAMED:
                # The name may arrive after the endpoint; the next poll examines it again.
                self._counts = []
            elif own in names:
                compatibility, reason = qos_check_compatible(
                    publisher.qos_profile, subscription.qos_profile)
                if compatibility == QoSCompatibility.ERROR:
                    (name,) = names - {own} or {own}
                    reason = reason.removeprefix('ERROR: ').rstrip(';. ')
                    yield name, f'{topic}: no messages between this node and {name}: {reason}'

    # Other nodes of the same role

    def _announce(self) -> None:
        self._publisher.publish(convert.to_bytes(
            self._presences.own, self._node.get_clock().now().nanoseconds, frame=''))

    def _receive(self, content: bytes) -> None:
        try:
            presence = convert.from_bytes(Presence, content)
        # Anything may be published on the topic.
        except MessageError:
            return
        self._apply(lambda presences: presences.add(presence, time.time_ns()))
        if self._presences.others:
            self._set_period(_POLL_S)

    def _look_for_rivals(self) -> None:
        """Forget nodes in conflict that are absent in two polls in a row."""
        infos = self._node.get_publishers_info_by_topic(self._publisher.topic_name)
        present = collections.Counter(
            '' if info.node_name == _NOT_YET else full_name(info) for info in infos)
        was_short, self._is_short = self._is_short, bool(self._presences.gone(present))
        if was_short and self._is_short:
            self._apply(lambda presences: presences.keep(present))

    def _apply(self, change: Callable[[Presences], list[LogMessage]]) -> None:
        """Change the known nodes and log it; announce this node to those that have appeared."""
        presences, logger = self._presences, self._node.get_logger()
        others, rival = presences.others, presences.rival
        for message in change(presences):
            # Not one line: rclpy requires a single severity for each line that logs.
            if message.warning:
                logger.warning(message.text)
            else:
                logger.info(message.text)
        if presences.others != others:
            self._announce()
        if presences.rival != rival:
            self._on_rival(presences.stands_by)


def _owner(info: Any) -> str | bytes:
    """Return the node of an endpoint, or its participant while the node is unknown.

    The name of a node may arrive after its endpoints. If the process stood still for longer than
    the lease of discovery, its endpoints are discovered again, but Fast DDS does not deliver the
    name again.
    """
    if info.node_name in _UNNAMED:
        return bytes(info.endpoint_gid[:_PREFIX_LENGTH])
    return full_name(info)


def full_name(info: Any) -> str:
    """Return the fully qualified name of the node of an endpoint."""
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'
