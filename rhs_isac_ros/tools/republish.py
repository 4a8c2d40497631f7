"""Publishing a recording again to live nodes, with its timing and its codebooks."""

import argparse
import sys
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.optimizer import OptimizerNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.recording import RecordingError, read, read_scenario, recorded_topics
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.ros.timers import steady_timer

_SIGNALS = topics.NAMES[m.ReceivedSignals]
_ESTIMATES = topics.NAMES[m.PositionEstimate]
# How often to look for listeners; how long an optimizer may take to be discovered [s].
_LOOK_S = 0.05
_DISCOVERY_S = 1.0
_ACKNOWLEDGED = Duration(seconds=5)


class RepublishError(Exception):
    """Live nodes cannot be served."""


class RepublisherNode(Node):
    """Publishes messages, each when it is due, as soon as somebody listens to all topics.

    Parameters
    ----------
    messages
        Relative name of the topic, message and time [s], in the order of the times; a codebook
        is for the optimizer.
    names
        Relative names of the topics.
    rate
        How many times as fast as recorded.

    Attributes
    ----------
    optimizer
        Holds the codebooks; None if another node does.
    count
        Messages published.
    waits_for
        The topic whose listener it waits for; empty once it publishes.
    finished
        Whether all are published.
    """

    def __init__(
            self, messages: Iterable[tuple[str, Any, float]], names: Collection[str],
            rate: float) -> None:
        super().__init__('replay', start_parameter_services=False)
        self.optimizer: OptimizerNode | None = None
        self.count, self.finished, self.waits_for = 0, False, next(iter(names))
        self._messages, self._rate = iter(messages), rate
        self._next: tuple[str, Any, float] | None = None
        # What the steady clock shows when that of the recording shows 0 [s]; None before the
        # first message.
        self._origin_s: float | None = None
        kinds = recorded_topics()
        self._outlets = {name: self.create_publisher(kinds[name][0], name, kinds[name][1])
                         for name in names}
        self._timer = steady_timer(self, _LOOK_S, self._look)

    def _look(self) -> None:
        self.waits_for = next((name for name in self._outlets if not self._heard(name)), '')
        if not self.waits_for:
            self._timer.cancel()
            self._next = next(self._messages, None)
            self._timer = steady_timer(self, _LOOK_S, self._publish)
            self._publish()

    def _heard(self, name: str) -> bool:
        """Tell whether the listeners of a topic are there."""
        outlet, expected = self._outlets[name], 1
        if name == _SIGNALS:
            # Onlookers hear them as well: what counts is who makes estimates of them, and that
            # listens once its tables are built.
            makers = {_name_of(end) for end in self.get_publishers_info_by_topic(
                self.resolve_topic_name(_ESTIMATES))} - {self.get_fully_qualified_name()}
            ears = {_name_of(end) for end in self.get_subscriptions_info_by_topic(
                outlet.topic_name)}
            if not makers or not makers <= ears:
                return False
            expected = len(ears)
        return outlet.get_subscription_count() >= expected

    def _publish(self) -> None:
        """Publish what is due, and wait for the next."""
        while self._next:
            name, message, time_s = self._next
            now_s = time.monotonic()
            if self._origin_s is None and name != topics.CODEBOOK:
                self._origin_s = now_s - time_s / self._rate
            due_s = now_s if self._origin_s is None else self._origin_s + time_s / self._rate
            if (wait_s := due_s - now_s) > 0:
                self._timer.timer_period_ns = max(int(wait_s * 1e9), 1)
                self._timer.reset()
                return
            if name != topics.CODEBOOK:
                self._outlets[name].publish(message)
                self.count += 1
            elif self.optimizer:
                self.optimizer.set_parameters_atomically(
                    _parameters(convert.codebook_from_ros(message)))
            self._next = next(self._messages, None)
        self._timer.cancel()
        for outlet in self._outlets.values():
            outlet.wait_for_all_acked(_ACKNOWLEDGED)
        self.finished = True

    def others(self) -> list[str]:
        """Return topics that another node publishes as well.

        Returns
        -------
        list of str
            Their relative names.
        """
        return [name for name, outlet in self._outlets.items()
                if self.count_publishers(outlet.topic_name) > 1]


def republish(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Publish a recording to live nodes.

    Parameters
    ----------
    options
        ``file``, ``namespace``, ``topic``, ``rate``, ``codebook``, ``config``, ``timeout``.
    arguments
        Name of the program and command line with the ROS arguments.

    Returns
    -------
    int
        Exit code: 0, also after a signal; 2 if a ROS argument is wrong.

    Raises
    ------
    RepublishError
        If nobody listens, or another node publishes the same.
    RecordingError, ScenarioError, CodebookError
        If a file is wrong.
    """
    names = options.topic or [_SIGNALS]
    scenario = (Scenario.from_yaml(options.config) if options.config
                else read_scenario(options.file) or Scenario())
    first = _first_codebook(options, names)
    if first:
        first.check(scenario)
    nodes: list[RepublisherNode] = []
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as folder:
        file = Path(folder) / 'scenario.yaml'
        file.write_text(yaml.safe_dump(scenario.changes()), encoding='utf-8')

        def make() -> list[Node]:
            nodes.append(RepublisherNode(
                _messages(options, [*names, topics.CODEBOOK]), names, options.rate))
            if first and not _optimizer_is_there(nodes[0]):
                nodes[0].optimizer = OptimizerNode(parameter_overrides=[
                    Parameter('scenario_file', value=str(file)), *_parameters(first)])
            return [*nodes, *filter(None, [nodes[0].optimizer])]
        begin_s = time.monotonic()

        def done() -> bool:
            node = nodes[0]
            if others := node.others():
                raise RepublishError(f'{others[0]}: another node publishes it, expected none')
            if node.waits_for and time.monotonic() > begin_s + options.timeout:
                raise RepublishError(f'{node.waits_for}: nobody listens within '
                                     f'{options.timeout:g} s')
            return node.finished
        code = run(make, arguments, done)
    if nodes:
        print(f'{nodes[0].count} messages published')
    return code


def root_of(namespace: str) -> str:
    """Return what the full names of a namespace's topics begin with.

    Parameters
    ----------
    namespace
        The namespace.

    Returns
    -------
    str
        It with a slash at both ends.
    """
    return f'/{namespace.strip("/")}/'.replace('//', '/')


def _messages(
        options: argparse.Namespace, names: Iterable[str]) -> Iterator[tuple[str, Any, float]]:
    """Read messages of a recording, with the relative names of their topics."""
    full = {f'{root_of(options.namespace)}{name}': name for name in names}
    for topic, message, time_s in read(options.file, full):
        yield full[topic], message, time_s


def _first_codebook(options: argparse.Namespace, names: Collection[str]) -> Codebook | None:
    """Return the codebook to begin with, if there are signals that need it."""
    used, codebooks = [], {}
    for name, message, _ in _messages(options, [_SIGNALS, topics.CODEBOOK]):
        if name == topics.CODEBOOK:
            codebooks.setdefault(message.codebook_id, message)
        else:
            used.append(message.codebook_id)
    if _SIGNALS not in names:
        return None
    if not used:
        raise RecordingError(f'{options.file}: no {_SIGNALS} in the namespace '
                             f'{options.namespace}')
    if options.codebook:
        given = Codebook.load(options.codebook)
        if given.id != used[0]:
            raise RecordingError(f'{options.codebook}: codebook {given.id}, but the signals were '
                                 f'taken with {used[0]}: live nodes would drop them')
        return given
    if used[0] not in codebooks:
        raise RecordingError(f'codebook {used[0]}: not in the recording, expected its file: '
                             '--codebook FILE')
    return convert.codebook_from_ros(codebooks[used[0]])


def _optimizer_is_there(node: Node) -> bool:
    there = AsyncParameterClient(node, topics.OPTIMIZER_NODE).wait_for_services(_DISCOVERY_S)
    if there:
        print(f'the {topics.OPTIMIZER_NODE} of the namespace keeps its codebook', file=sys.stderr)
    return there


def _parameters(codebook: Codebook) -> list[Parameter]:
    return [Parameter(name, value=value) for name, value in codebook.to_parameters().items()]


def _name_of(end: Any) -> str:
    return f'{end.node_namespace.rstrip("/")}/{end.node_name}'
