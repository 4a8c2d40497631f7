"""Fuzzing: publish random and mutated messages on every topic, and compare the counters."""

import collections
import dataclasses
import time
from collections.abc import Callable, Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from visualization_msgs.msg import MarkerArray

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import NewestDict
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED, PRESENCES, profile_for, subscribe
from rhs_isac_ros.ros.processes import Processes
from system.chaos.mutations import mutate
from system.chaos.trial import ChaosError, both_served
from system.observer import NetworkObserver

# Mutations on one topic between checks; the queues of the nodes hold four times as many messages.
_BATCH = 32
_TIMEOUT_S = 30.0
_MAX_ORIGINALS = 32
_MAX_PUBLISHED = 100 * _BATCH
# Messages of the protocol by topic.
_PROTOCOL = {name: kind for kind, name in topics.NAMES.items()}
# Topics with other messages.
_OTHERS = {
    topics.CODEBOOK: (ros.Codebook, LATCHED),
    topics.PRESENCE: (ros.Presence, PRESENCES),
    topics.POSITION: (PoseWithCovarianceStamped, EXCHANGE),
    topics.DIAGNOSTICS: (DiagnosticArray, EXCHANGE),
    topics.MARKERS: (MarkerArray, EXCHANGE),
}
# Topics without messages in a correct network with one codebook, a node for each user and no
# visualizer.
_UNUSED = {topics.NAMES[m.NoFix], topics.NAMES[m.GroundTruths], topics.MARKERS}


@dataclasses.dataclass(frozen=True)
class FuzzResult:
    """Result of fuzzing."""

    sent: Mapping[str, int]  #: Number of mutations by topic.
    #: Number of received mutations that violate the declaration of their type, by node.
    malformed: Mapping[str, int]
    counted: Mapping[str, int]  #: Number of messages that a node counted as malformed, by node.
    dropped: Mapping[str, int]  #: Number of messages that all nodes dropped, by reason.
    ended: tuple[str, ...]  #: Processes that ended.
    traces: tuple[str, ...]  #: Lines of logs that belong to unhandled errors.
    #: From the last mutation until both users have been served again [s]; None if never.
    recovery_s: float | None

    @property
    def passed(self) -> bool:
        """Whether no node crashed, and every node counted all malformed messages."""
        return not self.ended and not self.traces and self.malformed == self.counted


class _Mutator:
    """Publishes mutations of the messages of a topic."""

    def __init__(self, node: Node, name: str, kind: type, profile: QoSProfile) -> None:
        self.name = name
        self.originals: collections.deque[bytes] = collections.deque(maxlen=_MAX_ORIGINALS)
        self._kind = kind
        self._publisher = node.create_publisher(kind, name, profile)
        # On a busy machine, the observer receives its own messages late.
        self._published: NewestDict[bytes, None] = NewestDict(_MAX_PUBLISHED)
        subscribe(node, kind, name, self._receive, profile, raw=True)

    def publish(self, rng: np.random.Generator) -> bytes:
        """Publish a mutation, and return it."""
        # Diagnostics are random messages, not mutations: a mutation could carry the name of a node
        # and falsify the counters, which are read from the diagnostics.
        originals = () if self.name == topics.DIAGNOSTICS else self.originals
        content = mutate(self._kind, originals, rng)
        self._published.put(content, None)
        self._publisher.publish(content)
        return content

    def _receive(self, content: bytes) -> None:
        if content not in self._published:
            self.originals.append(content)


class _Counters:
    """Counters in the diagnostics of the nodes, relative to those at the start."""

    def __init__(self, observer: NetworkObserver) -> None:
        self._observer = observer
        # Nodes of the network that subscribe to each topic of the protocol.
        self.subscribers = {name: sorted(_subscribers(observer, name)) for name in _PROTOCOL}
        self._nodes = {node for nodes in self.subscribers.values() for node in nodes}
        self._before: dict[str, dict[str, int]] = {}
        self._before = self.current()

    def current(self) -> dict[str, dict[str, int]]:
        """Return the messages received and dropped since the start, by node and key."""
        found = {}
        for node in self._nodes:
            report, before = self._observer.reports.get(node), self._before.get(node, {})
            found[node] = {
                key: int(value) - before.get(key, 0)
                for key, value in (report.values if report else {}).items()
                if key.startswith(('received.', 'dropped.'))}
        return found

    def all_received(self, sent: collections.Counter[str]) -> bool:
        """Return whether every subscriber has received the mutations sent on its topics."""
        due: collections.Counter[tuple[str, str]] = collections.Counter()
        for name, nodes in self.subscribers.items():
            for node in nodes:
                due[node, _PROTOCOL[name].__name__] += sent[name]
        counters = self.current()
        return all(counters[node].get(f'received.{kind}', 0) >= n
                   for (node, kind), n in due.items())


def fuzz(
        observer: NetworkObserver, processes: Processes, scenario: Scenario, n: int,
        rng: np.random.Generator, on_progress: Callable[[int], None]) -> FuzzResult:
    """Publish `n` mutations to a network, and call `on_progress` with their number so far.

    Raises ChaosError if a topic has no messages, or a node does not receive all mutations.
    """
    mutators = [_Mutator(observer, name, convert.ros_type(kind), profile_for(kind))
                for name, kind in _PROTOCOL.items()]
    mutators += [_Mutator(observer, name, kind, profile)
                 for name, (kind, profile) in _OTHERS.items()]

    def silent() -> list[str]:
        return [mutator.name for mutator in mutators
                if mutator.name not in _UNUSED and not mutator.originals]
    if not observer.spin_until(lambda: not silent(), _TIMEOUT_S):
        raise ChaosError(f'no messages on {silent()} within {_TIMEOUT_S:g} s')
    counters = _Counters(observer)
    sent: collections.Counter[str] = collections.Counter()
    malformed: collections.Counter[str] = collections.Counter()
    while sent.total() < n and not processes.ended():
        for _ in range(min(_BATCH * len(mutators), n - sent.total())):
            mutator = mutators[sent.total() % len(mutators)]
            content = mutator.publish(rng)
            sent[mutator.name] += 1
            kind = _PROTOCOL.get(mutator.name)
            if kind and _is_malformed(kind, content, scenario):
                malformed.update(counters.subscribers[mutator.name])
        # Queues overflow unless every node has received all mutations before the next ones.
        if not observer.spin_until(
                lambda: bool(processes.ended()) or counters.all_received(sent), _TIMEOUT_S):
            raise ChaosError(f'not all mutations were received within {_TIMEOUT_S:g} s')
        on_progress(sent.total())
    return _result(observer, processes, counters, sent, malformed)


def _subscribers(observer: NetworkObserver, name: str) -> set[str]:
    """Return the names of the other nodes that subscribe to a topic."""
    return {info.node_name for info in observer.get_subscriptions_info_by_topic(
        observer.resolve_topic_name(name))} - {observer.get_name()}


def _is_malformed(kind: type[m.Message], content: bytes, scenario: Scenario) -> bool:
    """Return whether nodes drop a mutation as malformed, rather than for its scenario."""
    try:
        message = convert.from_bytes(kind, content)
        if message.scenario_id in ('', scenario.id):
            m.check(message, scenario)
    except m.MessageError:
        return True
    return False


def _result(
        observer: NetworkObserver, processes: Processes, counters: _Counters,
        sent: Mapping[str, int], malformed: Mapping[str, int]) -> FuzzResult:
    """Wait until the network serves its users again, and collect the counters."""
    first, begin_s = len(observer.log.ended), time.monotonic()
    recovered = observer.spin_until(lambda: both_served(observer, first), _TIMEOUT_S)
    recovery_s = time.monotonic() - begin_s if recovered else None
    # Diagnostics are published once a second.
    observer.spin_for(1.5)
    final = counters.current()
    dropped: collections.Counter[str] = collections.Counter()
    for counts in final.values():
        for key, count in counts.items():
            if key.startswith('dropped.'):
                dropped[key.removeprefix('dropped.')] += count
    counted = {node: counts.get('dropped.malformed', 0) for node, counts in final.items()}
    traces = [f'{name}: {line}' for name in processes.names
              for line in processes.log(name).splitlines()
              if line.startswith('Traceback') or 'terminate called' in line
              or 'rcutils' in line]
    return FuzzResult(
        dict(sent), {node: malformed.get(node, 0) for node in counted}, counted, dict(dropped),
        tuple(processes.ended()), tuple(traces), recovery_s)
