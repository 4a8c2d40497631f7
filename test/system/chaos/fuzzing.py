"""Fuzzing: publish random and mutated messages on every topic, and compare the counters.

The messages that are mutated are examples, not those of the running network, so all mutations of a
seed are the same in each run.
"""

import collections
import dataclasses
import itertools
import json
import time
from collections.abc import Callable, Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from example_messages import example_message
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import serialize_message
from visualization_msgs.msg import MarkerArray

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.presences import Presence
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED, PRESENCES, profile_for
from rhs_isac_ros.ros.peers import UNNAMED
from rhs_isac_ros.ros.processes import Processes
from system.chaos.mutations import mutate
from system.chaos.trial import TIMEOUT_S, ChaosError, both_served, wait_for_service
from system.observer import NetworkObserver

# Mutations on one topic between checks; the queues of the nodes hold more messages.
_BATCH = 8
_N_ORIGINALS = 8
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
    #: Latest mutations on the topics of the nodes that failed, each as ``<topic> <bytes>``.
    suspects: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether no node crashed, and every node counted all malformed messages."""
        return not self.ended and not self.traces and self.malformed == self.counted


def originals(scenario: Scenario, codebook: Codebook, rng: np.random.Generator
              ) -> dict[str, list[bytes]]:
    """Return the messages to mutate on each topic; none where messages are random instead."""
    identity = 1, scenario.id
    presence = Presence(*identity, 'bs', '/other', json.dumps(scenario.fields()))
    found = {name: [convert.to_bytes(example_message(scenario, kind, rng), 1, identity)
                    for _ in range(_N_ORIGINALS)] for name, kind in _PROTOCOL.items()}
    # A mutation of diagnostics could have the name of a node, and falsify its counters.
    return found | {
        topics.CODEBOOK: [convert.to_bytes(convert.CodebookMessage.of(codebook, *identity), 1)],
        topics.PRESENCE: [convert.to_bytes(presence, 1)],
        topics.POSITION: [serialize_message(PoseWithCovarianceStamped())],
        topics.DIAGNOSTICS: [], topics.MARKERS: []}


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
                for key, value in (report.details if report else {}).items()
                if key.startswith(('received.', 'dropped.'))}
        return found

    def malformed(self) -> dict[str, int]:
        """Return the number of messages that each node has dropped as malformed."""
        return {node: counts.get('dropped.malformed', 0)
                for node, counts in self.current().items()}

    def wrong(self, malformed: Mapping[str, int]) -> set[str]:
        """Return the nodes that have not counted the given numbers of malformed messages."""
        return {node for node, n in self.malformed().items() if n != malformed.get(node, 0)}

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
        observer: NetworkObserver, processes: Processes, scenario: Scenario, codebook: Codebook,
        n: int, rng: np.random.Generator, on_progress: Callable[[int], None]) -> FuzzResult:
    """Publish `n` mutations to a network, and call `on_progress` with their number so far.

    Ends early if a node fails. Raises ChaosError if the network serves no users, a node does not
    receive all mutations, or a mutation causes an error in this process.
    """
    types = {name: (convert.ros_type(kind), profile_for(kind))
             for name, kind in _PROTOCOL.items()} | _OTHERS
    publishers = {name: observer.create_publisher(kind, name, profile)
                  for name, (kind, profile) in types.items()}
    stored = originals(scenario, codebook, rng)
    wait_for_service(observer)
    # The name of a node may arrive after its endpoints.
    if not observer.spin_until(lambda: not any(
            _subscribers(observer, name) & {*UNNAMED} for name in _PROTOCOL), TIMEOUT_S):
        raise ChaosError(f'a subscriber without a name after {TIMEOUT_S:g} s')
    counters = _Counters(observer)
    sent: collections.Counter[str] = collections.Counter()
    malformed: collections.Counter[str] = collections.Counter()
    failed: set[str] = set()
    while sent.total() < n and not failed:
        latest: list[tuple[str, bytes]] = []
        for name in itertools.islice(
                itertools.cycle(types), min(_BATCH * len(types), n - sent.total())):
            content = mutate(types[name][0], stored[name], rng)
            publishers[name].publish(content)
            latest.append((name, content))
            sent[name] += 1
            kind = _PROTOCOL.get(name)
            if kind and _is_malformed(kind, content, scenario):
                malformed.update(counters.subscribers[name])
        # Queues overflow unless every node has received all mutations before the next ones.
        observer.spin_until(lambda: bool(processes.ended()) or (
            counters.all_received(sent) and not counters.wrong(malformed)), TIMEOUT_S)
        failed = counters.wrong(malformed) | {*processes.ended()}
        if not failed and not counters.all_received(sent):
            raise ChaosError(f'not all mutations were received within {TIMEOUT_S:g} s')
        on_progress(sent.total())
    result = _result(observer, processes, counters, sent, malformed)
    return dataclasses.replace(result, suspects=tuple(
        f'{name} {content.hex()}' for name, content in latest
        if failed.intersection(counters.subscribers.get(name, failed))))


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
    except Exception as error:
        raise ChaosError(f'{error!r} from {kind.__name__} {content.hex()}') from error
    return False


def _result(
        observer: NetworkObserver, processes: Processes, counters: _Counters,
        sent: Mapping[str, int], malformed: Mapping[str, int]) -> FuzzResult:
    """Wait until the network serves its users again, and collect the counters."""
    first, begin_s = len(observer.log.ended), time.monotonic()
    recovered = observer.spin_until(lambda: both_served(observer, first), TIMEOUT_S)
    recovery_s = time.monotonic() - begin_s if recovered else None
    # Diagnostics are published once a second.
    observer.spin_for(1.5)
    final = counters.current()
    dropped: collections.Counter[str] = collections.Counter()
    for counts in final.values():
        for key, count in counts.items():
            if key.startswith('dropped.'):
                dropped[key.removeprefix('dropped.')] += count
    counted = counters.malformed()
    traces = [f'{name}: {line}' for name in processes.names
              for line in processes.log(name).splitlines()
              if line.startswith('Traceback') or 'terminate called' in line
              or 'rcutils' in line]
    return FuzzResult(
        dict(sent), {node: malformed.get(node, 0) for node in counted}, counted, dict(dropped),
        tuple(processes.ended()), tuple(traces), recovery_s)
