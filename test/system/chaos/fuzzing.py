"""Publishes messages that nobody meant on every topic, and counts what becomes of them."""

import collections
import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.ros.subscriptions import subscribe
from system.chaos.crashes import ChaosError
from system.chaos.mutations import lie
from system.chaos.watcher import Watcher

# Lies on one topic at a time; the queues of the nodes take four times as many.
_BATCH = 32
_PATIENCE_S = 30.0
_HEARD = 32
# What is not a message of the protocol, by topic.
_OTHERS = {
    topics.CODEBOOK: (ros.Codebook, qos.HELD),
    topics.POSITION: (PoseWithCovarianceStamped, qos.EXCHANGE),
    topics.DIAGNOSTICS: (DiagnosticArray, qos.EXCHANGE),
    topics.MARKERS: (MarkerArray, qos.EXCHANGE),
}


@dataclasses.dataclass(frozen=True)
class Fuzzed:
    """What became of the lies.

    Attributes
    ----------
    sent
        Lies by topic.
    malformed
        By node: lies that break what their type declares, and that it listens to.
    counted
        By node: what it counted as malformed meanwhile.
    dropped
        By reason, over all nodes: what they dropped meanwhile.
    ended
        Processes that ended.
    traces
        Lines of logs that tell of an error that nobody handled.
    serves_again_s
        How long after the last lie both users were served again [s].
    """

    sent: Mapping[str, int]
    malformed: Mapping[str, int]
    counted: Mapping[str, int]
    dropped: Mapping[str, int]
    ended: tuple[str, ...]
    traces: tuple[str, ...]
    serves_again_s: float

    @property
    def passed(self) -> bool:
        """Whether nobody crashed, and all that is malformed was counted."""
        return not self.ended and not self.traces and self.malformed == self.counted


class _Mouth:
    """A topic to lie on."""

    def __init__(self, node: Node, name: str, kind: type, profile: Any) -> None:
        self.name, self.kind = name, kind
        self.publisher = node.create_publisher(kind, name, profile)
        self.heard: collections.deque[bytes] = collections.deque(maxlen=_HEARD)
        self._told: collections.deque[bytes] = collections.deque(maxlen=4 * _BATCH)
        subscribe(node, kind, name, self._hear, profile, raw=True)

    def tell(self, rng: np.random.Generator) -> bytes:
        """Publish a lie, and return it."""
        # What the nodes tell of themselves is counted here: nobody may speak in their names.
        models = () if self.name == topics.DIAGNOSTICS else self.heard
        content = lie(self.kind, models, rng)
        self._told.append(content)
        self.publisher.publish(content)
        return content

    def _hear(self, content: bytes) -> None:
        if content not in self._told:
            self.heard.append(content)


def fuzz(
        watcher: Watcher, processes: Processes, scenario: Scenario, n: int,
        rng: np.random.Generator, progress: Callable[[int], None]) -> Fuzzed:
    """Lie to a network.

    Parameters
    ----------
    watcher
        Hears the network.
    processes
        The network.
    scenario
        Its scenario.
    n
        How many lies.
    rng
        Source of randomness.
    progress
        Called with the number of lies so far.

    Returns
    -------
    Fuzzed
        What became of them.

    Raises
    ------
    ChaosError
        If a node does not get what is sent to it.
    """
    mouths = [_Mouth(watcher, topics.NAMES[kind], convert.ros_type(kind), qos.of(kind))
              for kind in topics.NAMES]
    mouths += [_Mouth(watcher, name, kind, profile) for name, (kind, profile) in _OTHERS.items()]
    if not watcher.spin_until(lambda: all(mouth.heard for mouth in mouths
                                          if mouth.name not in _SILENT), _PATIENCE_S):
        silent = [mouth.name for mouth in mouths if not mouth.heard]
        raise ChaosError(f'nothing on {silent} within {_PATIENCE_S:g} s')
    listeners = _listeners(watcher, mouths)
    before = _books(watcher, listeners)
    sent: collections.Counter[str] = collections.Counter()
    malformed: collections.Counter[str] = collections.Counter()
    kinds = {name: kind for kind, name in topics.NAMES.items()}
    while sum(sent.values()) < n and not processes.ended():
        for _ in range(min(_BATCH * len(mouths), n - sum(sent.values()))):
            mouth = mouths[sum(sent.values()) % len(mouths)]
            content = mouth.tell(rng)
            sent[mouth.name] += 1
            if mouth.name in kinds and _is_malformed(kinds[mouth.name], content, scenario):
                for node in listeners[mouth.name]:
                    malformed[node] += 1
        _await_books(watcher, processes, listeners, before, sent, kinds)
        progress(sum(sent.values()))
    return _settle(watcher, processes, listeners, before, sent, malformed)


# Topics on which a good network with one codebook and nobody who looks says nothing.
_SILENT = {topics.NAMES[m.NoFix], topics.MARKERS}


def _is_malformed(kind: type[m.Message], content: bytes, scenario: Scenario) -> bool:
    try:
        m.check(convert.from_bytes(kind, content), scenario.sizes)
    except m.MessageError:
        return True
    return False


def _listeners(watcher: Watcher, mouths: list[_Mouth]) -> dict[str, list[str]]:
    """Nodes of the network that listen to each topic of the protocol."""
    own = watcher.get_name()
    return {mouth.name: sorted({
        info.node_name for info in watcher.get_subscriptions_info_by_topic(
            watcher.resolve_topic_name(mouth.name)) if info.node_name != own})
        for mouth in mouths if mouth.name not in _OTHERS}


def _books(watcher: Watcher, listeners: Mapping[str, list[str]]) -> dict[str, dict[str, int]]:
    """What each listener has received and dropped, by key of its diagnostics."""
    nodes = {node for names in listeners.values() for node in names}
    return {node: {key: int(value) for key, value in watcher.values(node).items()
                   if key.startswith(('received.', 'dropped.'))} for node in nodes}


def _await_books(
        watcher: Watcher, processes: Processes, listeners: Mapping[str, list[str]],
        before: Mapping[str, Mapping[str, int]], sent: Mapping[str, int],
        kinds: Mapping[str, type[m.Message]]) -> None:
    """Wait until every node has received all that was sent to it: no queue may overflow."""
    def received() -> bool:
        books = _books(watcher, listeners)
        return bool(processes.ended()) or all(
            books[node].get(key, 0) - before[node].get(key, 0) >= sent.get(name, 0)
            for name, nodes in listeners.items() for node in nodes
            for key in [f'received.{kinds[name].__name__}'])
    if not watcher.spin_until(received, _PATIENCE_S):
        raise ChaosError(f'not all lies are received within {_PATIENCE_S:g} s')


def _settle(
        watcher: Watcher, processes: Processes, listeners: Mapping[str, list[str]],
        before: Mapping[str, Mapping[str, int]], sent: Mapping[str, int],
        malformed: Mapping[str, int]) -> Fuzzed:
    begin, begin_s = len(watcher.ends), time.monotonic()
    served = watcher.spin_until(lambda: {1, 2} <= {
        end.user for end in watcher.ends[begin:] if end.outcome == 'served'}, _PATIENCE_S)
    again_s = time.monotonic() - begin_s if served else float('inf')
    # Diagnostics come once a second.
    watcher.spin_until(lambda: False, 1.5)
    books = _books(watcher, listeners)
    dropped: collections.Counter[str] = collections.Counter()
    counted: dict[str, int] = {}
    for node, counts in books.items():
        for key, count in counts.items():
            if key.startswith('dropped.'):
                dropped[key.removeprefix('dropped.')] += count - before[node].get(key, 0)
        counted[node] = counts.get('dropped.malformed', 0) - before[node].get(
            'dropped.malformed', 0)
    traces = [f'{name}: {line}' for name in processes.names
              for line in processes.log(name).splitlines()
              if line.startswith('Traceback') or 'terminate called' in line
              or 'rcutils' in line]
    return Fuzzed(
        dict(sent), {node: malformed.get(node, 0) for node in counted}, counted, dict(dropped),
        tuple(processes.ended()), tuple(traces), again_s)
