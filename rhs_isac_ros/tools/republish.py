"""Publication of recorded topics to running nodes: ``scripts/replay FILE --publish``."""

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.cycle_log import ANSWERS
from rhs_isac_ros.nodes.optimizer import OptimizerNode, ros_parameters
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import (
    create_publisher,
    full_name,
    set_period,
    steady_timer,
    subscribe_messages,
)
from rhs_isac_ros.ros.environment import is_secure
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.ros.recording import RecordingError, read, recorded_topics
from rhs_isac_ros.ros.run import spin
from rhs_isac_ros.support.arguments import positive_float
from rhs_isac_ros.tools import command
from rhs_isac_ros.tools.command import ToolError

_SIGNALS = topics.NAMES[m.ReceivedSignals]
_ESTIMATES = topics.NAMES[m.PositionEstimate]
# Period of looking for subscribers; maximum time to discover an optimizer, without and with DDS
# security [s].
_POLL_PERIOD_S = 0.05
_DISCOVERY_TIMEOUT_S = 2.0
_SECURE_DISCOVERY_TIMEOUT_S = 8.0
# All publishers and subscribers of a network are assumed to be known if none has appeared for this
# time [s]. Another publisher may be discovered after the first subscriber.
_SETTLING_TIME_S = 1.0
_ACK_TIMEOUT = Duration(seconds=5)
# Number of messages without answers after which acknowledgements are awaited, within the depth of
# the queues.
_BATCH = 64
# Period of publishing signals again that have no answer, because an estimator may still wait for
# the codebook; maximum time to wait for an answer after another one is missing [s].
_REPEAT_S, _SHORT_S = 2.0, 0.5
# A recorded pause that is longer than the first number is shortened to the second [s].
_MAX_GAP_S, _GAP_S = 10.0, 1.0
# Maximum time between two looks at the clock [s].
_MAX_WAIT_S = 1.0
# Topics that can be published again. The codebook is set as parameters; recorded diagnostics and
# announcements would contradict the running nodes.
_TOPICS = sorted(set(recorded_topics()) - {topics.CODEBOOK, topics.DIAGNOSTICS, topics.PRESENCE})
# Defaults of the options.
RATE, TIMEOUT_S = 1.0, 60.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `republish`."""
    add = parser.add_argument_group(
        'running nodes', 'Publish the recorded signals again, with their timing, in the namespace '
        'of --ros-args -r __ns:=... If the namespace has no optimizer, the replay provides the '
        'recorded codebook instead.').add_argument
    add('--publish', action='store_true', help='publish instead of estimating')
    add('--rate', type=positive_float, default=RATE, metavar='R',
        help='speed relative to the recording (default: 1)')
    add('--topic', action='append', choices=_TOPICS, metavar='NAME',
        help=f'relative name; may be repeated (default: {_SIGNALS})')
    add('--timeout', type=positive_float, default=TIMEOUT_S, metavar='S',
        help='maximum time to wait for subscribers, and for an estimate (default: 60 s)')


class RepublisherNode(Node):
    """Publishes messages with their recorded timing, once all topics have subscribers.

    `messages` contains the topic, the content and the time [s] of each message, sorted by time.
    `names` are the relative names of the topics. `rate` is the speed relative to the recording.
    After signals, the node waits up to `timeout_s` for an estimate, so that no queue overflows.
    `optimizer`, unless it is None, receives the codebooks. `waits_for` is the first topic without
    the expected subscribers, or ''. `count` is the number of published messages, `unanswered` that
    of signals without an estimate, and `unconfirmed` contains topics with messages that were not
    acknowledged.
    """

    def __init__(
            self, messages: Iterable[tuple[str, bytes, float]], names: Collection[str],
            rate: float, timeout_s: float) -> None:
        super().__init__('replay', **WITHOUT_SERVICES)
        self.optimizer: OptimizerNode | None = None
        self.count, self.finished, self.waits_for = 0, False, next(iter(names))
        self.unanswered, self.unconfirmed = 0, set[str]()
        # Cycle and user of signals without an answer.
        self._pending: tuple[int, int] | None = None
        # Time of the first check [s]: the time to discover an optimizer does not count.
        self._begin_s = math.inf
        self._timeout_s = self._answer_timeout_s = timeout_s
        self._waits_s = self._publish(messages, rate)
        # Numbers of publishers and subscribers by topic, and the time of their last change [s].
        self._endpoints: list[tuple[int, int]] = []
        self._unchanged_since_s = time.monotonic()
        kinds = recorded_topics()
        self._message_publishers = {
            name: create_publisher(self, kinds[name][0], name, kinds[name][1]) for name in names}
        self._timer = steady_timer(self, _POLL_PERIOD_S, self._poll_subscribers)
        if _SIGNALS in names:
            subscribe_messages(self, ANSWERS, None, self._on_answer)

    def _on_answer(self, message: m.Message, _: float) -> None:
        if isinstance(message, m.PositionEstimate | m.NoFix) and self._pending == (
                message.cycle_id, message.user):
            self._pending = None
            self._continue()

    def _poll_subscribers(self) -> None:
        self.waits_for = next(
            (name for name in self._message_publishers if not self._has_subscribers(name)), '')
        if self._endpoints_settled() and not self.waits_for:
            self._timer.cancel()
            self._timer = steady_timer(self, _POLL_PERIOD_S, self._continue)
            self._continue()

    def _endpoints_settled(self) -> bool:
        """Return whether no endpoint of the topics has appeared or disappeared for some time."""
        now_s = time.monotonic()
        endpoints = [
            (self.count_publishers(name), self.count_subscribers(name))
            for name in (*self._message_publishers, _ESTIMATES)]
        if endpoints != self._endpoints:
            self._endpoints, self._unchanged_since_s = endpoints, now_s
        return now_s >= self._unchanged_since_s + _SETTLING_TIME_S

    def _has_subscribers(self, name: str) -> bool:
        publisher, n_expected = self._message_publishers[name], 1
        if name == _SIGNALS:
            # Observers may subscribe to the signals, too. Wait for the nodes that publish
            # estimates, which subscribe to the signals when their tables are complete.
            estimators = {*map(full_name, self.get_publishers_info_by_topic(
                self.resolve_topic_name(_ESTIMATES)))} - {self.get_fully_qualified_name()}
            subscribers = {*map(
                full_name, self.get_subscriptions_info_by_topic(publisher.topic_name))}
            if not estimators or not estimators <= subscribers:
                return False
            n_expected = len(subscribers)
        return publisher.get_subscription_count() >= n_expected

    def _continue(self) -> None:
        """Publish the messages that are due, and set the timer for the next one."""
        if (wait_s := next(self._waits_s, None)) is not None:
            set_period(self._timer, wait_s)
            return
        self._timer.cancel()
        for name in self._message_publishers:
            self._confirm(name)
        self.finished = True

    def _confirm(self, name: str) -> None:
        if not self._message_publishers[name].wait_for_all_acked(_ACK_TIMEOUT):
            self.unconfirmed.add(name)

    def _publish(
            self, messages: Iterable[tuple[str, bytes, float]], rate: float) -> Iterator[float]:
        """Publish each message when it is due; until then, yield times to wait [s]."""
        begin_s = time.monotonic()
        for name, content, due_s in _without_gaps(messages):
            while (wait_s := begin_s + due_s / rate - time.monotonic()) > 0:
                yield min(wait_s, _MAX_WAIT_S)
            if name == topics.CODEBOOK:
                if self.optimizer:
                    codebook = convert.from_bytes(convert.CodebookMessage, content).codebook()
                    self.optimizer.set_parameters_atomically(
                        ros_parameters(codebook.to_parameters()))
                continue
            self._message_publishers[name].publish(content)
            self.count += 1
            if name == _SIGNALS:
                yield from self._until_answered(content)
            elif self.count % _BATCH == 0:
                self._confirm(name)

    def _until_answered(self, content: bytes) -> Iterator[float]:
        """Yield times to wait [s] until published signals are answered; publish them again."""
        signals = convert.from_bytes(m.ReceivedSignals, content)
        self._pending = signals.cycle_id, signals.user
        begin_s = sent_s = time.monotonic()
        while self._pending and (now_s := time.monotonic()) < begin_s + self._answer_timeout_s:
            if now_s > sent_s + _REPEAT_S:
                self._message_publishers[_SIGNALS].publish(content)
                sent_s = now_s
            yield _POLL_PERIOD_S
        if self._pending:
            self.unanswered += 1
            self._answer_timeout_s = _SHORT_S

    def is_done(self) -> bool:
        """Return `finished`; raise ToolError for another publisher or missing subscribers."""
        self._begin_s = min(self._begin_s, time.monotonic())
        for name, publisher in self._message_publishers.items():
            if self.count_publishers(publisher.topic_name) > 1:
                raise ToolError(f'{name}: already published by another node')
        if self.waits_for and time.monotonic() > self._begin_s + self._timeout_s:
            raise ToolError(f'{self.waits_for}: no subscriber within {self._timeout_s:g} s')
        return self.finished


def _without_gaps(
        messages: Iterable[tuple[str, bytes, float]]) -> Iterator[tuple[str, bytes, float]]:
    """Replace recorded times by times since the first message that is no codebook [s].

    Long pauses are shortened, and printed. A codebook before the first other message is due at
    once.
    """
    last_s, due_s = math.nan, 0.0
    for name, content, time_s in messages:
        if math.isnan(last_s):
            if name != topics.CODEBOOK:
                last_s = time_s
            yield name, content, 0.0
            continue
        step_s, last_s = time_s - last_s, time_s
        if step_s > _MAX_GAP_S:
            print(f'replay: a pause of {step_s:.0f} s in the recording is shortened to '
                  f'{_GAP_S:.0f} s', file=sys.stderr)
            step_s = _GAP_S
        due_s += step_s
        yield name, content, due_s


def republish(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Publish a recording to running nodes; return the exit code."""
    names = options.topic or [_SIGNALS]
    scenario = command.choose_scenario(
        options.config, options.file, options.namespace, options.site)
    first_codebook = _first_codebook(options) if _SIGNALS in names else None
    if first_codebook:
        first_codebook.check(scenario)

    def create() -> list[Any]:
        node = RepublisherNode(_messages(options, [*names, topics.CODEBOOK]), names,
                               options.rate, options.timeout)
        if first_codebook is None:
            return [node]
        if _optimizer_present(node):
            print(f'using the codebook of the {topics.OPTIMIZER_NODE} in the namespace',
                  file=sys.stderr)
            return [node]
        node.optimizer = _optimizer(scenario, first_codebook)
        return [node, node.optimizer]

    node, *_ = spin(create, arguments, lambda nodes: nodes[0].is_done())
    print(f'{node.count} messages published')
    if node.unanswered:
        raise ToolError(f'{node.unanswered} signals without {_ESTIMATES} or no_fix')
    if node.unconfirmed:
        raise ToolError(f'not all acknowledged: {", ".join(sorted(node.unconfirmed))}')
    return 0


def _messages(
        options: argparse.Namespace, names: Iterable[str]) -> Iterator[tuple[str, bytes, float]]:
    """Yield the topic (relative name), the bytes and the time [s] of each recorded message."""
    full_names = {f'{command.topic_prefix(options.namespace)}{name}': name for name in names}
    for topic, content, time_s in read(options.file, full_names):
        yield full_names[topic], content, time_s


def _first_codebook(options: argparse.Namespace) -> Codebook:
    """Return the codebook with which the first signals were received."""
    used = ''
    codebooks: dict[str, convert.CodebookMessage] = {}
    for name, content, _ in _messages(options, [_SIGNALS, topics.CODEBOOK]):
        if name == topics.CODEBOOK:
            message = convert.from_bytes(convert.CodebookMessage, content)
            codebooks.setdefault(message.codebook_id, message)
        else:
            used = used or convert.from_bytes(m.ReceivedSignals, content).codebook_id
    if not used:
        raise command.nothing_recorded(options.file, _SIGNALS, options.namespace)
    if options.codebook:
        codebook = Codebook.load(options.codebook)
        if codebook.id != used:
            raise RecordingError(
                f'{options.codebook}: codebook {codebook.id}, but the signals were received with '
                f'{used}: running nodes would drop them')
        return codebook
    if used not in codebooks:
        raise command.missing_codebook(options.file, used)
    return codebooks[used].codebook()


def _optimizer(scenario: Scenario, codebook: Codebook) -> OptimizerNode:
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as folder:
        scenario.to_yaml(file := f'{folder}/scenario.yaml')
        return OptimizerNode(parameter_overrides=ros_parameters(
            {'scenario_file': file, **codebook.to_parameters()}))


def _optimizer_present(node: Node) -> bool:
    return AsyncParameterClient(node, topics.OPTIMIZER_NODE).wait_for_services(
        _SECURE_DISCOVERY_TIMEOUT_S if is_secure() else _DISCOVERY_TIMEOUT_S)
