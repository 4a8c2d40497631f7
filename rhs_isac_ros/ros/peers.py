"""Presence of other nodes, derived from the ROS graph and from their announcements."""

import dataclasses
import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, qos_check_compatible

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.messages import MessageError
from rhs_isac_ros.protocol.presences import PERIOD_S, Presence, Presences
from rhs_isac_ros.ros import convert, endpoints, topics
from rhs_isac_ros.ros.roster import ROSTER, identifying_endpoints

# Poll period while a role is missing or nodes are in conflict, and poll period otherwise [s]. A
# poll takes half a millisecond, which adds up over many users.
_POLL_S, _IDLE_POLL_S = 0.1, 1.0
# Number of polls before the first report of missing roles, while discovery is still under way.
_GRACE_POLLS = 10
# Maximum number of incompatible endpoints that are logged, which bounds the log.
_MAX_LOGGED = 16
# Topics that ROS creates for every node, whose quality of service is not examined.
_FOREIGN = ('/rosout', '/parameter_events')
# Placeholders of the middleware for the name of a node, which may arrive after its endpoints.
_UNNAMED = ('_NODE_NAME_UNKNOWN_', '_CREATED_BY_BARE_DDS_APP_')
# Number of leading bytes of the id of an endpoint (GID) that identify its participant.
_PREFIX_LENGTH = 12

_last_instance = 0


def new_instance() -> int:
    """Return the instance of a node that starts now: its start [ns since 1970], made unique."""
    global _last_instance
    _last_instance = max(time.time_ns(), _last_instance + 1)
    return _last_instance


class Peers:
    """Monitors the roles that a node requires, and other nodes with the same role.

    A role is missing if no node has all its `identifying_endpoints`. The role counts as present
    once two polls in a row have found such a node, so that it has had time to discover this one.

    Nodes of unique roles also announce themselves periodically. A node that falls silent does not
    count, although it remains in the graph for some time. A restarted node of the same name counts
    once it has called `take_role`. Of two nodes with the same role, the newer one serves.

    Endpoints whose quality of service prevents messages to or from this node are logged.

    Parameters
    ----------
    role
        Role of the node, a key of `ROSTER`.
    instance
        Instance of the node; see `Message.sender`.
    on_missing
        Called with descriptions of the missing roles, by name: first when no role is missing or
        after a grace period, then on every change.
    on_rival
        Called with True if this node has to stand by for another one, or False if it may serve.
    """

    def __init__(
            self, node: Node, role: str, instance: int, scenario: Scenario,
            on_missing: Callable[[dict[str, str]], None],
            on_rival: Callable[[bool], None]) -> None:
        self._node, self._on_missing, self._on_rival = node, on_missing, on_rival
        self._required = {name: identifying_endpoints(name) for name in ROSTER[role].needed}
        # For each role found so far: the number of endpoints of each topic then, and the nodes.
        self._present: dict[str, tuple[tuple[int, ...], set[str]]] = {}
        # Numbers of endpoints at the last poll, by topic; incompatible ones by topic and node.
        self._counts: list[tuple[str, int, int]] = []
        self._incompatible: dict[tuple[str, str], str] = {}
        # Endpoints that were logged, which are not logged again if they are created again.
        self._logged: set[tuple[str, str]] = set()
        self._role = role
        self._presences = Presences(Presence(
            instance, scenario.id, '', node.get_fully_qualified_name(),
            json.dumps(scenario.fields())))
        # Time of the last poll or received announcement, and total duration of stalls [s].
        self._last_s, self._missed_s = time.monotonic(), 0.0
        # Nodes that the last poll found silent.
        self._silent: set[str] = set()
        # The rival at the last call of `on_rival`; 0 if there was none.
        self._rival = 0
        self._closed, self._changed, self._thread = False, threading.Event(), threading.Thread()
        if ROSTER[role].is_unique:
            endpoints.subscribe(node, ros.Presence, topics.PRESENCE, self._receive,
                                endpoints.PRESENCES, raw=True)
            # A thread announces the node even while the node computes.
            self._thread = threading.Thread(
                target=self._announce, daemon=True, args=[endpoints.create_publisher(
                    node, ros.Presence, topics.PRESENCE, endpoints.LATCHED)])
            endpoints.create_or_refuse(node, 'thread of announcements', self._thread.start)
        self._timer = endpoints.steady_timer(node, _POLL_S, self._poll)
        self.restart()

    def take_role(self) -> None:
        """Announce the role; called after the publishers and subscriptions have been created."""
        self._presences.own = dataclasses.replace(self._presences.own, role=self._role)
        self._changed.set()

    def close(self) -> None:
        """End the announcements; called before the node is destroyed."""
        self._closed = True
        self._changed.set()
        if self._thread.is_alive():
            self._thread.join()

    def restart(self) -> None:
        """Report the missing roles again, as after the start."""
        self._absent_before = frozenset(self._required)
        self._reported: dict[str, str] | None = None
        self._polls = 0
        self._set_period(_POLL_S)

    def conflicts(self) -> dict[str, str]:
        """Return a description of each conflict and refusal, by its key in the diagnostics."""
        return self._presences.conflicts() | {
            f'conflict.qos.{topic.lstrip("/")}.{name.lstrip("/")}': text
            for (topic, name), text in self._incompatible.items()} | {
            f'conflict.{what.replace(" ", "_")}': text
            for what, text in endpoints.refusals(self._node).items()}

    def _poll(self) -> None:
        self._polls += 1
        self._apply(self._presences.update(self._now_s()))
        self._silent = self._presences.silent()
        self._report_missing()
        self._examine_qos()
        busy = self._reported != {} or self._presences.has_conflicts
        self._set_period(_POLL_S if busy else _IDLE_POLL_S)

    def _now_s(self) -> float:
        """Return the time [s], without the intervals in which this process stalled."""
        now_s = time.monotonic()
        if now_s - self._last_s > _IDLE_POLL_S + PERIOD_S:
            # Announcements that arrived meanwhile may still be waiting.
            self._missed_s += now_s - self._last_s
        self._last_s = now_s
        return now_s - self._missed_s

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
        """Describe a missing role and the endpoints that it lacks; return '' if it is present."""
        node, (publishers, subscriptions) = self._node, self._required[name]
        # The methods that count endpoints do not apply remapping rules.
        wanted = [*(('publisher', node.resolve_topic_name(topic)) for topic in publishers),
                  *(('subscriber', node.resolve_topic_name(topic)) for topic in subscriptions)]
        counts = tuple(node.count_publishers(topic) if kind == 'publisher'
                       else node.count_subscribers(topic) for kind, topic in wanted)
        known_counts, found = self._present.get(name, ((), set()))
        if counts != known_counts:
            # Observers may have some of the endpoints, so only a node with all of them counts.
            owners = [{_owner(info) for info in (
                node.get_publishers_info_by_topic(topic) if kind == 'publisher'
                else node.get_subscriptions_info_by_topic(topic))} for kind, topic in wanted]
            absent = [f'no {kind} of {topic}' for (kind, topic), those in zip(
                wanted, owners, strict=True) if not those & owners[0]]
            if absent:
                is_gone = len(absent) == len(wanted)
                return name if is_gone else f'{name} ({", ".join(absent)})'
            found = set.intersection(*owners)
            # Names may arrive later.
            are_named = all('/' in owner for owner in found)
            self._present[name] = (counts if are_named else (), found)
        return '' if found - self._silent else name

    # Quality of service

    def _examine_qos(self) -> None:
        """Log endpoints of other nodes that cannot exchange messages with this node."""
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
        """Yield the node and a description of each incompatible endpoint of a topic."""
        own = self._node.get_fully_qualified_name()
        publishers = self._node.get_publishers_info_by_topic(topic)
        subscriptions = self._node.get_subscriptions_info_by_topic(topic)
        for publisher, subscription in itertools.product(publishers, subscriptions):
            names = {full_name(publisher), full_name(subscription)}
            if publisher.node_name in _UNNAMED or subscription.node_name in _UNNAMED:
                # The name may arrive after the endpoint, which the next poll examines again.
                self._counts = []
            elif own in names:
                compatibility, reason = qos_check_compatible(
                    publisher.qos_profile, subscription.qos_profile)
                if compatibility == QoSCompatibility.ERROR:
                    (name,) = names - {own} or {own}
                    reason = reason.removeprefix('ERROR: ').rstrip(';. ')
                    yield name, f'{topic}: no messages between this node and {name}: {reason}'

    # Other nodes of the same role

    def _announce(self, publisher: Publisher) -> None:
        """Announce this node periodically until it ends."""
        while not self._closed:
            try:
                publisher.publish(convert.to_bytes(
                    self._presences.own, self._node.get_clock().now().nanoseconds, frame=''))
            except InvalidHandle:  # The node was destroyed.
                return
            except rclpy_implementation.RCLError as error:
                if not self._node.context.ok():
                    return
                self._node.get_logger().error(
                    f'others may miss this node: {topics.PRESENCE}: {error}', once=True)
            self._changed.wait(PERIOD_S)
            self._changed.clear()

    def _receive(self, content: bytes) -> None:
        try:
            presence = convert.from_bytes(Presence, content)
        # Anything may be published on the topic.
        except MessageError:
            return
        self._apply(self._presences.add(presence, time.time_ns(), self._now_s()))
        if self._presences.silent() != self._silent:
            self._poll()
        elif self._presences.has_conflicts:
            self._set_period(_POLL_S)

    def _apply(self, changes: list[LogMessage]) -> None:
        """Log changes among other nodes, and call `on_rival` if the rival has changed."""
        logger = self._node.get_logger()
        for message in changes:
            # Two calls, because rclpy requires that a line of code always logs with one severity.
            if message.warning:
                logger.warning(message.text)
            else:
                logger.info(message.text)
        if self._presences.rival != self._rival:
            self._rival = self._presences.rival
            self._on_rival(self._presences.stands_by)


def _owner(info: Any) -> str:
    """Return the full name of an endpoint's node, or the participant's id if the name is unknown.

    If the process was unreachable for longer than the lease of discovery, its endpoints are
    discovered again, but Fast DDS does not deliver the name of the node again.
    """
    if info.node_name in _UNNAMED:
        return bytes(info.endpoint_gid[:_PREFIX_LENGTH]).hex()
    return full_name(info)


def full_name(info: Any) -> str:
    """Return the fully qualified name of the node of an endpoint."""
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'
