"""Quality of service, publishers, subscriptions, timers, and a thread for slow work.

Publishers and subscriptions have no event handlers. On a subscription, a handler slows down the
executor; on a publisher, it crashes a node that destroys the publisher while an observer with an
incompatible quality of service is present (ros2/rclpy#1644).

The middleware may refuse to create an endpoint, for instance because a permission is missing. The
node then runs without it, logs the refusal, and reports it in its diagnostics.
"""

import collections
import functools
import weakref
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.timer import Timer

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros import convert, topics


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
# For the positions of robots, whose drivers and simulators often publish best effort.
SENSOR = _profile(10, reliability=ReliabilityPolicy.BEST_EFFORT)
_LATCHED_MESSAGES = {m.CapacityStatistics}


def profile_for(kind: type[m.Message], exchange: QoSProfile = EXCHANGE) -> QoSProfile:
    """Return the quality of service of a message: `LATCHED`, `ACKS` or `exchange`."""
    if kind is m.Ack and exchange is EXCHANGE:
        return ACKS
    return LATCHED if kind in _LATCHED_MESSAGES else exchange

_CreatedT = TypeVar('_CreatedT')
# For each node: descriptions of refused endpoints, timers and threads, by kind and name.
_refusals: weakref.WeakKeyDictionary[Node, dict[str, str]] = weakref.WeakKeyDictionary()


def refusals(node: Node) -> dict[str, str]:
    """Return descriptions of refused endpoints, timers and threads, by kind and name."""
    return _refusals.get(node, {})


def create_or_refuse(node: Node, what: str, create: Callable[[], _CreatedT]) -> _CreatedT | None:
    """Return the result of `create`, or None if it is refused; log a refusal once."""
    try:
        return create()
    # rclpy raises a ValueError for an action. RCLError and errors of threads are RuntimeErrors.
    except (RuntimeError, ValueError) as error:
        # The text ends with a position in the ROS sources, which does not help here.
        text = f'{what} was refused: {str(error).partition(", at ")[0].splitlines()[0]}'
        known = _refusals.setdefault(node, {})
        if what not in known:
            node.get_logger().error(text)
        known[what] = text
        return None


class _NoTimer(Timer):
    """Replacement for a timer that was refused; it never expires."""

    timer_period_ns = 0

    def __init__(self) -> None:
        return

    def cancel(self) -> None:
        return

    def reset(self) -> None:
        return


def create_timer(
        node: Node, period_s: float, callback: Callable[[], None], clock: Clock | None = None
) -> Timer:
    """Create a running timer, by default on the clock of ROS; a refused timer never expires."""
    timer = create_or_refuse(node, f'timer of {period_s:g} s', lambda: node.create_timer(
        period_s, callback, clock=clock))
    return timer or _NoTimer()


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Create a running timer on the steady clock."""
    return create_timer(node, period_s, callback, Clock(clock_type=ClockType.STEADY_TIME))


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
    publisher = create_or_refuse(node, f'publisher of {name}', lambda: node.create_publisher(
        kind, name, profile, qos_overriding_options=_overriding(overridable),
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
        node: Node, kind: type, name: str, callback: Callable[[Any], None], profile: QoSProfile,
        raw: bool = False, overridable: bool = False) -> None:
    """Subscribe to a topic of a ROS type; a `raw` callback receives serialized bytes (CDR).

    Parameters ``qos_overrides.*`` change the quality of service of an `overridable` topic.
    """
    create_or_refuse(node, f'subscription to {name}', lambda: node.create_subscription(
        kind, name, callback, profile, raw=raw,
        qos_overriding_options=_overriding(overridable),
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False)))


def log_dropped(node: Node, error: m.MessageError) -> None:
    """Log the reason why a node drops a message, at most once every ten seconds."""
    node.get_logger().warning(f'dropped: {error}', throttle_duration_sec=10.0)


def subscribe_messages(
        node: Node, kinds: Iterable[type[m.Message]], sizes: Mapping[str, int] | None,
        on_message: Callable[[m.Message], None],
        on_error: Callable[[m.MessageError], None] | None = None, scenario_id: str = '', *,
        on_foreign: Callable[[m.Message], None] = lambda message: None,
        on_arrival: Callable[[type[m.Message]], None] = lambda kind: None,
        exchange: QoSProfile = EXCHANGE) -> None:
    """Subscribe to messages of the protocol; drop malformed messages.

    Parameters
    ----------
    sizes
        Sizes that `check` expects, as in `Scenario.sizes`; None: no check.
    on_error
        Called with the reason why a malformed message was dropped; by default, the node logs it.
    scenario_id, on_foreign
        If `scenario_id` is given, messages of other scenarios are passed only to `on_foreign`.
    on_arrival
        Called with the class of each message before decoding.
    exchange
        Quality of service, as in `profile_for`.
    """
    def receive(kind: type[m.Message], serialized: bytes) -> None:
        on_arrival(kind)
        try:
            message = convert.from_bytes(kind, serialized)
            if scenario_id and message.scenario_id not in ('', scenario_id):
                on_foreign(message)
                return
            if sizes is not None:
                m.check(message, sizes)
        except m.MessageError as error:
            (on_error or functools.partial(log_dropped, node))(error)
            return
        on_message(message)
    for kind in kinds:
        subscribe(node, convert.ros_type(kind), topics.NAMES[kind],
                  functools.partial(receive, kind), profile_for(kind, exchange), raw=True)


class UserTopics:
    """Publishers for each user, created on first use.

    `kinds` contains the type of each topic by its name, with ``{user}`` for the user's number.
    Users above `max_users` have none: numbers come from messages, and topics slow down discovery.
    """

    def __init__(self, node: Node, kinds: Mapping[str, type], max_users: int) -> None:
        self._node, self._kinds, self._max_users = node, kinds, max_users
        self._publishers: dict[int, tuple[Publisher, ...]] = {}
        self._is_limit_logged = False

    def publishers(self, user: int) -> tuple[Publisher, ...]:
        """Return the publishers for a user, in the order of `kinds`; empty above the limit."""
        if user > self._max_users:
            # Not once=True: rclpy would examine the stack at each call, which takes 0.5 ms.
            if not self._is_limit_logged:
                self._is_limit_logged = True
                self._node.get_logger().warning(
                    f'no topics for user {user}, because the limit user_topics is '
                    f'{self._max_users}')
            return ()
        if user not in self._publishers:
            self._publishers[user] = tuple(
                create_publisher(
                    self._node, kind, name.format(user=user), EXCHANGE, overridable=True)
                for name, kind in self._kinds.items())
        return self._publishers[user]

    def remove(self, user: int) -> None:
        """Destroy the publishers for a user, if any."""
        for publisher in self._publishers.pop(user, ()):
            self._node.destroy_publisher(publisher)


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

        That thread also raises exceptions of the job. The job is refused if no worker can start.
        """
        def hand_over(future: Future[_Result]) -> None:
            self._done.append((future, on_result))
            executor = self._node.executor
            if self._is_open and executor is not None:
                executor.create_task(self._wake)
        if future := create_or_refuse(
                self._node, 'thread of jobs', lambda: self._pool.submit(job)):
            future.add_done_callback(hand_over)

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
            on_result(future.result())
