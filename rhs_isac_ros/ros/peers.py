"""Presence of other nodes, from their announcements, and endpoints that do not fit this node."""

import dataclasses
import functools
import itertools
import json
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping

from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, qos_check_compatible

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol.messages import MessageError
from rhs_isac_ros.protocol.presences import PERIOD_S, SLOW_PERIOD_S, Presence, Presences
from rhs_isac_ros.ros import convert, endpoints, topics
from rhs_isac_ros.ros.roster import MEMBERS
from rhs_isac_ros.support.clock_watch import ClockWatch
from rhs_isac_ros.support.frame_watch import FrameWatch

# Poll period while roles appear or nodes are in conflict, poll period otherwise, and of a node
# without work that nobody observes [s].
_POLL_S, _IDLE_POLL_S, _SLOW_POLL_S = 0.1, 1.0, 4.0
# Time after the last message until a node has no work [s].
_WORK_S = 5.0
# Number of polls before the first report of missing roles, while discovery is still under way.
_GRACE_POLLS = 10


class Peers:
    """Monitors the roles that a node requires, and other nodes with the same role.

    Nodes of unique roles announce themselves periodically. A role is present while such a node
    announces it, and counts once two polls in a row have found one, so that it has had time to
    discover this node. Of two nodes with the same role, the newer one serves.

    Conflicts are logged when they begin and end. Among them are endpoints of other nodes whose
    quality of service prevents messages to or from this node.

    Parameters
    ----------
    role
        Role of the node, a key of `MEMBERS`.
    instance
        Instance of the node; see `Message.sender`.
    on_missing
        Called with the missing roles: first when none is missing or after a grace period, then on
        every change.
    on_rival
        Called with True if this node has to stand by for another one, or False if it may serve.
    site_prefix
        Namespace of the nodes of the whole site, with a final slash; empty without a site.
    library_id
        Id of the library of codebooks; empty for a role that uses none.
    observe
        Called after each poll; returns whether an observer expects a poll every second.
    frame
        Frame of the positions that the node expects and publishes; empty if it has none.
    """

    def __init__(
            self, node: Node, role: str, instance: int, scenario: Scenario,
            on_missing: Callable[[tuple[str, ...]], None],
            on_rival: Callable[[bool], None], site_prefix: str = '', library_id: str = '',
            observe: Callable[[], bool] = lambda: False, frame: str = '') -> None:
        self._node, self._on_missing, self._on_rival = node, on_missing, on_rival
        self._observe, self._work_end_s, self._period_s = observe, 0.0, PERIOD_S
        of_site = MEMBERS[role].requires_of_site if site_prefix else ()
        self._role, self._needed = role, (*of_site, *MEMBERS[role].needed)
        self._presences = Presences(Presence(
            instance, scenario.id, '', node.get_fully_qualified_name(),
            json.dumps(scenario.fields()), library_id=library_id))
        # The newest instance of each role of interest at the last poll, and the newest one ever.
        self._newest, self._latest = dict.fromkeys((role, *self._needed), 0), 0
        self._clock, self._mismatches = ClockWatch(), Mismatches(node)
        self._frames = FrameWatch(frame)
        self._conflicts: dict[str, str] = {}
        # Before the first announcement, which other nodes compare with their own.
        self._examine_clock()
        # Time of the last poll or received announcement, and total duration of stalls [s].
        self._last_s, self._missed_s = time.monotonic(), 0.0
        self._closed, self._changed, self._thread = False, threading.Event(), threading.Thread()
        endpoints.subscribe(node, ros.Presence, topics.PRESENCE, self._receive,
                            endpoints.PRESENCES, raw=True)
        if of_site:
            # Other nodes in this namespace may belong to another network.
            endpoints.subscribe(
                node, ros.Presence, site_prefix + topics.PRESENCE,
                functools.partial(self._receive, roles=of_site), endpoints.PRESENCES, raw=True)
        if MEMBERS[role].is_unique:
            # A thread announces the node even while the node computes.
            self._thread = threading.Thread(
                target=self._announce, daemon=True, args=[endpoints.create_publisher(
                    node, ros.Presence, topics.PRESENCE, endpoints.LATCHED)])
            self._thread.start()
        self._timer = endpoints.steady_timer(node, _POLL_S, self._poll)
        self.restart()

    def take_role(self) -> None:
        """Announce the role; called after the publishers and subscriptions have been created."""
        self._presences.own = dataclasses.replace(self._presences.own, role=self._role)
        self._changed.set()

    def note_work(self) -> None:
        """Announce the node at the shortest period for some time, because it has work."""
        now_s = time.monotonic()
        had_work, self._work_end_s = now_s < self._work_end_s, now_s + _WORK_S
        if not had_work:
            self._changed.set()

    def note_frame(self, topic: str, frame: str) -> None:
        """Compare the frame of a received position with those of others."""
        self._frames.add(topic, frame, time.monotonic())

    def close(self) -> None:
        """Announce that the node gives up its role; called before the node is destroyed."""
        self._closed = True
        self._changed.set()
        if self._thread.is_alive():
            self._thread.join()

    def restart(self) -> None:
        """Report the missing roles again, as after the start."""
        self._found: frozenset[str] = frozenset()
        self._reported: tuple[str, ...] | None = None
        self._polls = 0
        endpoints.set_period(self._timer, _POLL_S)

    def conflicts(self) -> dict[str, str]:
        """Return a description of each conflict and refusal, by its key in the diagnostics."""
        return self._conflicts | {
            f'conflict.{what.replace(" ", "_")}': text
            for what, text in endpoints.refusals(self._node).items()}

    def _poll(self) -> float:
        """Report what has changed, and return the time until the next poll [s]."""
        self._polls += 1
        self._presences.now_s = self._now_s()
        before, self._newest = self._newest, self._find()
        if (latest := max(self._newest.values())) > self._latest:
            # Nothing that a new node causes has been logged before.
            endpoints.journal(self._node).renew()
            self._latest = latest
        problems = {'conflict.time': self._examine_clock(),
                    'conflict.frame': self._frames.update(time.monotonic())}
        self._conflicts = self._presences.conflicts() | self._mismatches.update() | {
            key: problem for key, problem in problems.items() if problem}
        endpoints.journal(self._node).update(self._conflicts)
        if self._newest[self._role] != before[self._role]:
            self._on_rival(self._presences.stands_by)
        has_changed = self._report_missing()
        is_observed = self._observe()
        if has_changed or self._conflicts or self._presences.own.use_sim_time:
            return _POLL_S
        slow = not is_observed and self._presences.next_period_s(SLOW_PERIOD_S) > _IDLE_POLL_S
        return _SLOW_POLL_S if slow else _IDLE_POLL_S

    def _find(self) -> dict[str, int]:
        return {role: self._presences.newest(role) for role in self._newest}

    def _now_s(self) -> float:
        """Return the time [s], without the intervals in which this process stalled."""
        now_s = time.monotonic()
        if now_s - self._last_s > _SLOW_POLL_S + PERIOD_S:
            # Announcements that arrived meanwhile may still be waiting.
            self._missed_s += now_s - self._last_s
        self._last_s = now_s
        return now_s - self._missed_s

    def _report_missing(self) -> bool:
        """Report missing roles, and return whether the next poll may find others."""
        before, self._found = self._found, frozenset(
            role for role in self._needed if self._newest[role])
        missing = tuple(role for role in self._needed if role not in self._found & before)
        is_early = self._reported is None and self._polls < _GRACE_POLLS
        if missing != self._reported and not (missing and is_early):
            self._reported = missing
            self._on_missing(missing)
        return self._found != before or self._reported is None

    def _examine_clock(self) -> str:
        """Announce whether the node uses simulated time, and return what is wrong with it."""
        clock, presences = self._node.get_clock(), self._presences
        is_simulated = bool(clock.ros_time_is_active)  # type: ignore[attr-defined]
        presences.own = dataclasses.replace(presences.own, use_sim_time=is_simulated)
        return self._clock.update(
            1e-9 * clock.now().nanoseconds if is_simulated else None, time.monotonic())

    def _announce(self, publisher: Publisher) -> None:
        """Announce this node periodically until it ends, and then that it has no role."""
        closed = False
        while not closed:
            closed, own = self._closed, self._presences.own
            own = dataclasses.replace(own, role='') if closed else own
            try:
                publisher.publish(convert.to_bytes(
                    own, self._node.get_clock().now().nanoseconds, frame=''))
            except InvalidHandle:  # The node was destroyed.
                return
            except rclpy_implementation.RCLError as error:
                if not self._node.context.ok():
                    return
                endpoints.journal(self._node).event(
                    topics.PRESENCE, f'others may miss this node: {topics.PRESENCE}: {error}')
            if not closed:
                has_changed = self._changed.wait(self._period_s)
                self._changed.clear()
                has_work = has_changed or time.monotonic() < self._work_end_s
                self._period_s = (PERIOD_S if has_work else
                                  self._presences.next_period_s(self._period_s))

    def _receive(self, content: bytes, _: object, roles: tuple[str, ...] = ()) -> None:
        """Process an announcement; with `roles`, only of a node that has had one of them."""
        try:
            presence = convert.from_bytes(Presence, content)
        # Anything may be published on the topic.
        except MessageError:
            return
        if roles and presence.role not in roles and not self._presences.knows(presence.sender):
            return
        was_known = self._presences.knows(presence.sender)
        self._presences.add(presence, time.time_ns(), self._now_s())
        if self._period_s > PERIOD_S and self._presences.knows(presence.sender) > was_known:
            # So that the new node soon receives an announcement of this one.
            self._changed.set()
        if self._find() != self._newest:
            endpoints.set_period(self._timer, self._poll())


# Topics that ROS creates for every node, whose quality of service is not examined.
_FOREIGN = ('/rosout', '/parameter_events')
# Placeholders of the middleware for the name of a node, which may arrive after its endpoints.
UNNAMED = ('_NODE_NAME_UNKNOWN_', '_CREATED_BY_BARE_DDS_APP_')
# Begin of a reason why qualities of service are incompatible.
_SEVERITY = re.compile(r'\b(ERROR|WARNING): ')
# Time after which an endpoint without a name belongs to no node of ROS [s].
_NAMING_S = 3.0


class Mismatches:
    """Endpoints of other programs that cannot exchange messages with those of a node."""

    def __init__(self, node: Node) -> None:
        self._node, self._texts = node, dict[str, str]()
        # Numbers of endpoints by topic at the last examination.
        self._counts: list[tuple[str, int, int]] = []
        # Time at which each endpoint without a name was found [s], by its GID.
        self._unnamed: dict[str, float] = {}
        self._are_named = True

    def update(self) -> dict[str, str]:
        """Return a description of each, by its key in the diagnostics.

        The topics of the node in the ROS graph are examined if endpoints have appeared or gone, or
        may receive a name.
        """
        node = self._node
        # While another node has the same name, the graph may list the topics of that one. Only the
        # topics of actions are read there: they are the same, and the node does not list them.
        own = node.get_name(), node.get_namespace()
        actions = [topic for topic, _ in [
            *node.get_publisher_names_and_types_by_node(*own),
            *node.get_subscriber_names_and_types_by_node(*own)] if '/_action/' in topic]
        ours = {*actions, *(one.topic_name for one in node.publishers),
                *(one.topic_name for one in node.subscriptions)} - {*_FOREIGN}
        counts = [(topic, node.count_publishers(topic), node.count_subscribers(topic))
                  for topic in sorted(ours)]
        if counts != self._counts or not self._are_named:
            self._counts, before, self._unnamed = counts, self._unnamed, {}
            self._are_named = True
            self._texts = {
                key: text for topic, *_ in counts for key, text in self._find(topic, before)}
        return self._texts

    def _find(self, topic: str, before: Mapping[str, float]) -> Iterator[tuple[str, str]]:
        own, found = self._node.get_fully_qualified_name(), [
            *self._node.get_publishers_info_by_topic(topic),
            *self._node.get_subscriptions_info_by_topic(topic)]
        for mine, other in itertools.product(
                (one for one in found if endpoints.full_name(one) == own), found):
            # Two publishers of a type have nothing to exchange.
            kind = 'qos' if other.topic_type == mine.topic_type else 'type'
            if kind == 'qos' and other.endpoint_type == mine.endpoint_type:
                continue
            name = endpoints.full_name(other)
            if other.node_name in UNNAMED:
                gid = bytes(other.endpoint_gid).hex()
                self._unnamed[gid] = before.get(gid, time.monotonic())
                if time.monotonic() < self._unnamed[gid] + _NAMING_S:
                    self._are_named = False
                    continue
                name = f'DDS endpoint {gid}'
            reason = f'type {other.topic_type}, expected {mine.topic_type}'
            if kind == 'qos':
                publisher, subscription = sorted(
                    (mine, other), key=lambda endpoint: endpoint.endpoint_type)
                compatibility, reason = qos_check_compatible(
                    publisher.qos_profile, subscription.qos_profile)
                if compatibility != QoSCompatibility.ERROR:
                    continue
            # There may be several reasons.
            reason = _SEVERITY.sub('', reason).rstrip(';. ').replace(';', '; ')
            yield (f'conflict.{kind}.{topic.lstrip("/")}.{name.lstrip("/").replace(" ", "_")}',
                   f'{topic}: no messages between this node and {name}: {reason}')
