"""Quality of service, publishers, subscriptions, timers, and a thread for slow work.

Publishers and subscriptions have no event handlers. On a subscription, a handler slows down the
executor; on a publisher, it crashes a node that destroys the publisher while an observer with an
incompatible quality of service is present (ros2/rclpy#1644).

The middleware may refuse to create an endpoint, for instance because a permission is missing. The
node then runs without it, logs the refusal, and reports it in its diagnostics.
"""

import collections
import contextlib
import copy
import functools
import inspect
import itertools
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol, TypeVar, runtime_checkable

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.timer import Timer

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.support.plugins import PluginError, trace_of
from rhs_isac_ros.support.state_log import Line, StateLog


def _profile(
        depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
        reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability,
                      durability=durability)


# For handshakes and signals, which must all arrive and are useless to late joiners. The queue
# holds the messages that arrive during a computation.
EXCHANGE = _profile(128)
# For acks: all users answer the first beacon of a new base station.
ACKS = _profile(MAX_USERS)
# For observers of all messages, which a busy machine may suspend for several seconds.
OBSERVATION = _profile(4096)
# For a current value, which late joiners receive as well.
LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
# For the `LATCHED` values of many publishers.
PRESENCES = _profile(128, DurabilityPolicy.TRANSIENT_LOCAL)
# For services: all clients may call at once, and rclpy's default of 10 loses the other requests.
SERVICES = _profile(1024)
# For the positions of robots, whose drivers and simulators often publish best effort.
SENSOR = _profile(10, reliability=ReliabilityPolicy.BEST_EFFORT)
_LATCHED_MESSAGES = {m.CapacityStatistics}


def profile_for(kind: type[m.Message], exchange: QoSProfile = EXCHANGE) -> QoSProfile:
    """Return the quality of service of a message: `LATCHED`, `ACKS` or `exchange`."""
    if kind is m.Ack and exchange is EXCHANGE:
        return ACKS
    return LATCHED if kind in _LATCHED_MESSAGES else exchange


# Minimum period of logging what was not logged at once [s].
_JOURNAL_S = 1.0
_CreatedT = TypeVar('_CreatedT')
# For each node: descriptions of refused endpoints, by kind and name.
_refusals: weakref.WeakKeyDictionary[Node, dict[str, str]] = weakref.WeakKeyDictionary()


def log(node: Node, text: str, severity: LoggingSeverity = LoggingSeverity.INFO) -> None:
    """Log a line of a node, with the place of this call.

    The methods of a logger examine all modules to find that place, which takes 40 ms of processor
    time at the first line of a process.
    """
    caller = sys._getframe(1)
    rclpy_implementation.rclpy_logging_rcutils_log(
        severity, node.get_logger().name, text, caller.f_code.co_name, caller.f_code.co_filename,
        caller.f_lineno)


def refusals(node: Node) -> dict[str, str]:
    """Return descriptions of refused endpoints, by kind and name."""
    return _refusals.get(node, {})


def create_or_refuse(node: Node, what: str, create: Callable[[], _CreatedT]) -> _CreatedT | None:
    """Return the result of `create`, or None if it is refused; log a refusal once."""
    try:
        created = create()
        _refusals.get(node, {}).pop(what, None)
        return created
    # rclpy raises a ValueError for an action. RCLError is a RuntimeError.
    except (RuntimeError, ValueError) as error:
        # The text ends with a position in the ROS sources, which does not help here.
        text = f'{what} was refused: {str(error).partition(", at ")[0].splitlines()[0]}'
        known = _refusals.setdefault(node, {})
        if what not in known:
            log(node, text, LoggingSeverity.ERROR)
        known[what] = text
        return None


def steady_timer(node: Node, period_s: float, callback: Callable[[], float | None]) -> Timer:
    """Create a running timer on the steady clock; `callback` may return a new period [s]."""
    def call() -> None:
        with surviving(node):
            set_period(timer, callback())
    timer = node.create_timer(period_s, call, clock=Clock(clock_type=ClockType.STEADY_TIME))
    return timer


def once(node: Node, delay_s: float, callback: Callable[[], None]) -> Timer:
    """Call a function once after a delay on the steady clock; return its timer."""
    def call() -> None:
        node.destroy_timer(timer)
        callback()
    timer = steady_timer(node, max(delay_s, 1e-3), call)
    return timer


@runtime_checkable
class _OfRole(Protocol):
    """A node of a role, which counts failures of plug-ins."""

    def note(self, error: PluginError) -> None: ...


@contextlib.contextmanager
def surviving(node: Node) -> Iterator[None]:
    """Let a node continue after the failure of a plug-in in a block, which it logs."""
    try:
        yield
    except PluginError as error:
        if isinstance(node, _OfRole):
            node.note(error)
        else:
            text = f'plug-in: {error}'
            journal(node).event(text, text + trace_of(error.__cause__))


def set_period(timer: Timer, period_s: float | None) -> None:
    """Start a timer with a period [s], unless it runs with this period or None is given."""
    if period_s is not None:
        period_ns = max(round(1e9 * period_s), 1)
        if timer.is_canceled() or timer.timer_period_ns != period_ns:
            timer.timer_period_ns = period_ns
            timer.reset()


class _NoPublisher(Publisher):
    """Replacement for a publisher that was refused; it publishes nothing."""

    def __init__(self, topic_name: str) -> None:
        self._name = topic_name

    @property
    def topic_name(self) -> str:
        return self._name

    def publish(self, msg: Any) -> None:
        return

    def get_subscription_count(self) -> int:
        return 0


def _overriding(overridable: bool) -> QoSOverridingOptions | None:
    return QoSOverridingOptions.with_default_policies() if overridable else None


def create_publisher(
        node: Node, kind: type, name: str, profile: QoSProfile, overridable: bool = False
) -> Publisher:
    """Create a publisher of a ROS type on a topic; a refused publisher publishes nothing.

    Parameters ``qos_overrides.*`` change the quality of service of an `overridable` topic.
    """
    # A copy: rclpy writes the overrides into the profile, which other endpoints use, too.
    own = copy.copy(profile)
    publisher = create_or_refuse(node, f'publisher of {name}', lambda: node.create_publisher(
        kind, name, own, qos_overriding_options=_overriding(overridable),
        event_callbacks=PublisherEventCallbacks(use_default_callbacks=False)))
    return publisher or _NoPublisher(node.resolve_topic_name(name))


def publish_if_subscribed(publishers: Iterable[Publisher], make: Callable[[], Any]) -> None:
    """Publish the result of `make` on the topics that have subscribers; if none has, do nothing.

    Observer topics often lack subscribers, and making a message takes longer than publishing it.
    """
    if subscribed := [one for one in publishers if one.get_subscription_count()]:
        message = make()
        for publisher in subscribed:
            publisher.publish(message)


def subscribe(
        node: Node, kind: type, name: str, callback: Callable[..., None], profile: QoSProfile,
        raw: bool = False, overridable: bool = False) -> None:
    """Subscribe to a topic of a ROS type; a `raw` callback receives bytes (CDR) and their times.

    The times are those of rclpy's `MessageInfo`. The node logs that it drops a message without a
    valid serialization. Parameters ``qos_overrides.*`` change the quality of service of an
    `overridable` topic.
    """
    def receive(*taken: Any) -> None:
        # The EventsExecutor of rclpy 7.1 passes both as one argument.
        content, info = taken if len(taken) == 2 else taken[0]
        if raw:
            callback(content, info)
            return
        try:
            message = convert.deserialize(content, kind)
        except m.MessageError as error:
            log_dropped(node, error)
            return
        callback(message)
    # The callbacks to which rclpy passes the times are those with two parameters.
    receive.__signature__ = inspect.signature(lambda content, info: None)  # type: ignore[attr-defined]
    # A copy, as in `create_publisher`.
    own = copy.copy(profile)
    # A subscription of rclpy that is not raw drops an invalid message without a word, and leaves
    # the error to the next call that fails.
    create_or_refuse(node, f'subscription to {name}', lambda: node.create_subscription(
        kind, name, receive, own, raw=True,
        qos_overriding_options=_overriding(overridable),
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False)))


class Journal:
    """The log lines of a node about states and events, limited as `StateLog` describes."""

    def __init__(self, node: Node) -> None:
        self._node, self._log = node, StateLog()
        self._lock = threading.Lock()
        self._timer = steady_timer(node, _JOURNAL_S, lambda: self._write(StateLog.due))

    def state(self, key: str, text: str, holds: bool, warning: bool | None = None) -> None:
        """Log that a state begins or has another text (`holds`), or that it ends."""
        line = Line(text, holds if warning is None else warning)
        self._write(StateLog.state, key, line, holds=holds)

    def event(self, key: str, text: str, error: bool = False) -> None:
        """Log an event as a warning or an error."""
        self._write(StateLog.event, key, Line(text, True, error))

    def update(self, states: Mapping[str, str]) -> None:
        """Log the changes of a group of states; `states` contains the texts of those that hold."""
        self._write(StateLog.update, states)

    def renew(self) -> None:
        """Treat all states and events as new."""
        self._log.renew()

    def _write(self, method: Callable[..., list[Line]], *args: Any, **options: Any) -> None:
        with self._lock:
            now_s = time.monotonic()
            lines = method(self._log, *args, now_s=now_s, **options)
            if (due_s := self._log.due_s) is None:
                self._timer.cancel()
            else:
                set_period(self._timer, max(due_s - now_s, _JOURNAL_S))
        for text, warning, error in lines:
            log(self._node, text, LoggingSeverity.ERROR if error else
                LoggingSeverity.WARN if warning else LoggingSeverity.INFO)


_journals: weakref.WeakKeyDictionary[Node, Journal] = weakref.WeakKeyDictionary()


def journal(node: Node) -> Journal:
    """Return the journal of a node, which is created at the first call."""
    if node not in _journals:
        _journals[node] = Journal(node)
    return _journals[node]


def arrived_s(info: Mapping[str, int]) -> float:
    """Return when the middleware received a message [s], on the clock of `time.monotonic`.

    The callback of a busy process may run seconds later.
    """
    return time.monotonic() - 1e-9 * max(time.time_ns() - info['received_timestamp'], 0)


def log_dropped(node: Node, error: m.MessageError) -> None:
    """Log the reason why a node drops a message; the text starts with the name of the field."""
    journal(node).event(
        f'dropped {str(error).partition(":")[0]}', f'dropped: {error}', error=True)


def subscribe_messages(
        node: Node, kinds: Iterable[type[m.Message]], scenario: Scenario | None,
        on_message: Callable[[m.Message, float], None],
        on_error: Callable[[m.MessageError], None] | None = None, *,
        on_foreign: Callable[[m.Message], None] | None = None,
        on_arrival: Callable[[type[m.Message]], None] = lambda kind: None,
        on_frame: Callable[[str, str], None] | None = None,
        exchange: QoSProfile = EXCHANGE, prefix: str = '') -> None:
    """Subscribe to messages of the protocol; drop messages that are malformed or foreign.

    Parameters
    ----------
    scenario
        Scenario of the messages, whose id and sizes are checked; None: no check.
    on_message
        Called with each message, and the time of its arrival as in `arrived_s` [s].
    on_error
        Called with the reason why a message was dropped; by default, the node logs it.
    on_foreign
        Called with messages of other scenarios; by default, they are errors.
    on_arrival
        Called with the class of each message before decoding.
    on_frame
        Called with the topic and the frame of each message that contains positions.
    exchange
        Quality of service, as in `profile_for`.
    prefix
        Namespace of the topics with a final slash; empty: that of the node.
    """
    def receive(kind: type[m.Message], serialized: bytes, info: Mapping[str, int]) -> None:
        on_arrival(kind)
        try:
            message = convert.from_bytes(kind, serialized)
            if scenario and message.scenario_id not in ('', scenario.id):
                if on_foreign:
                    on_foreign(message)
                    return
                raise m.MessageError(f'{kind.__name__} of scenario {message.scenario_id}, '
                                     f'expected {scenario.id}')
            if scenario:
                m.check(message, scenario)
        except m.MessageError as error:
            (on_error or functools.partial(log_dropped, node))(error)
            return
        if on_frame and kind in m.POSITIONS:
            on_frame(node.resolve_topic_name(prefix + topics.NAMES[kind]),
                     convert.frame_of(serialized))
        on_message(message, arrived_s(info))
    for kind in kinds:
        subscribe(node, convert.ros_type(kind), prefix + topics.NAMES[kind],
                  functools.partial(receive, kind), profile_for(kind, exchange), raw=True)


class UserTopics:
    """Publishers for each user, created on first use.

    `kinds` contains the type of each topic by its name, with ``{user}`` for the user's number.
    Users above `max_users` have none: numbers come from messages, and topics slow down discovery.
    """

    def __init__(self, node: Node, kinds: Mapping[str, type], max_users: int) -> None:
        self._node, self._kinds, self._max_users = node, kinds, max_users
        self._publishers: dict[int, tuple[Publisher, ...]] = {}

    def publishers(self, user: int) -> tuple[Publisher, ...]:
        """Return the publishers for a user, in the order of `kinds`; empty above the limit."""
        if user > self._max_users:
            journal(self._node).event(
                'user_topics',
                f'no topics for user {user}, because the limit user_topics is {self._max_users}')
            return ()
        if user not in self._publishers:
            self._publishers[user] = tuple(
                create_publisher(
                    self._node, kind, name.format(user=user), EXCHANGE, overridable=True)
                for name, kind in self._kinds.items())
        return self._publishers[user]

    def created(self) -> Iterator[Publisher]:
        """Return all publishers that exist."""
        return itertools.chain(*self._publishers.values())

    def remove(self, user: int) -> None:
        """Destroy the publishers for a user, if any."""
        for publisher in self._publishers.pop(user, ()):
            self._node.destroy_publisher(publisher)


def full_name(info: Any) -> str:
    """Return the fully qualified name of the node of an endpoint."""
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


_Result = TypeVar('_Result')
_IMMEDIATE_S = 1e-6


class BackgroundWorker:
    """A thread that runs jobs one after the other.

    The thread that spins the node calls the functions that receive the results, between messages.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._is_open = True
        self._done: collections.deque[tuple[Future[Any], Callable[[Any], None]]] = (
            collections.deque())
        self._timer = steady_timer(node, _IMMEDIATE_S, self._deliver)
        self._timer.cancel()
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix=node.get_name())

    def run(self, job: Callable[[], _Result], on_result: Callable[[_Result], None]) -> None:
        """Queue a job; the thread that spins the node passes the result to `on_result`.

        That thread also raises exceptions of the job, except for failures of plug-ins, which the
        node notes.
        """
        def hand_over(future: Future[_Result]) -> None:
            self._done.append((future, on_result))
            executor = self._node.executor
            if self._is_open and executor is not None:
                executor.create_task(self._wake)
        self._pool.submit(job).add_done_callback(hand_over)

    def close(self) -> None:
        """Wait for the running job, cancel the others and discard all results."""
        self._is_open = False
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _wake(self) -> None:
        # The task only starts the timer, because an exception in a task would stop the executor,
        # and a task may outlast the node.
        if self._is_open:
            self._timer.reset()

    def _deliver(self) -> None:
        self._timer.cancel()
        while self._done:
            future, on_result = self._done.popleft()
            with surviving(self._node):
                on_result(future.result())
