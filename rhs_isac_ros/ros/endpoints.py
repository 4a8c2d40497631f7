"""Timers, quality of service, publishers and subscriptions, and a thread for slow work.

Publishers and subscriptions have no event handlers. Those of subscriptions slow down executors.
Those of publishers end a node that destroys one while an observer with an incompatible quality of
service is present (ros2/rclpy#1644).

The middleware may refuse to create an endpoint, as without a permission. The node then runs
without it, logs the refusal, and reports it in its diagnostics.
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
from rclpy.impl.implementation_singleton import rclpy_implementation
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


# For handshakes and signals, which must all arrive and are useless to late joiners. The depth
# holds the acks of the users of a beacon, and messages that arrive during a computation.
EXCHANGE = _profile(128)
# For acks: all users answer the beacon of a base station to which they are new.
ACKS = _profile(MAX_USERS)
# For the same messages, received by an observer of the whole network: its queue must hold those
# of several seconds in which a busy machine does not run the observer.
OBSERVATION = _profile(4096)
# For a current value, which late joiners receive as well.
LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
# For `LATCHED` values of many publishers, of which a subscription keeps one each.
PRESENCES = _profile(128, DurabilityPolicy.TRANSIENT_LOCAL)
# For the positions of robots, whose drivers and simulators often publish best effort.
SENSOR = _profile(10, reliability=ReliabilityPolicy.BEST_EFFORT)
_LATCHED_MESSAGES = {m.CapacityStatistics}


def profile_for(kind: type[m.Message], exchange: QoSProfile = EXCHANGE) -> QoSProfile:
    """Return `LATCHED` for messages of a current value, `exchange` for others, `ACKS` for acks."""
    if kind is m.Ack and exchange is EXCHANGE:
        return ACKS
    return LATCHED if kind in _LATCHED_MESSAGES else exchange

_CreatedT = TypeVar('_CreatedT')
# By node: descriptions of what was refused, by kind and name.
_refusals: weakref.WeakKeyDictionary[Node, dict[str, str]] = weakref.WeakKeyDictionary()


def refusals(node: Node) -> dict[str, str]:
    """Return a description of each endpoint that was refused, by kind and name."""
    return _refusals.get(node, {})


def create_or_refuse(node: Node, what: str, create: Callable[[], _CreatedT]) -> _CreatedT | None:
    """Return what `create` returns, or log its refusal by the middleware once and return None."""
    try:
        return create()
    # Of an action, rclpy raises a ValueError.
    except (rclpy_implementation.RCLError, ValueError) as error:
        # The end of the text is a position in the sources of ROS.
        text = f'{what} was refused: {str(error).partition(", at ")[0].splitlines()[0]}'
        known = _refusals.setdefault(node, {})
        if what not in known:
            node.get_logger().error(text)
        known[what] = text
        return None


class _NoTimer(Timer):
    """Takes the place of a timer that was refused, and never expires."""

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
    """Create a running timer, by default on the clock of ROS; if refused, it never expires."""
    timer = create_or_refuse(node, f'timer of {period_s:g} s', lambda: node.create_timer(
        period_s, callback, clock=clock))
    return timer or _NoTimer()


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Create a running timer on the steady clock, which the deadlines of the roles refer to."""
    return create_timer(node, period_s, callback, Clock(clock_type=ClockType.STEADY_TIME))


class _NoPublisher(Publisher):
    """Takes the place of a publisher that was refused, and publishes nothing."""

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
    """Create a publisher of a ROS type on a topic; one that was refused publishes nothing.

    Parameters ``qos_overrides.*`` change the quality of service if it is `overridable`.
    """
    publisher = create_or_refuse(node, f'publisher of {name}', lambda: node.create_publisher(
        kind, name, profile, qos_overriding_options=_overriding(overridable),
        event_callbacks=PublisherEventCallbacks(use_default_callbacks=False)))
    return publisher or _NoPublisher(node.resolve_topic_name(name))


def subscribe(
        node: Node, kind: type, name: str, callback: Callable[[Any], None], profile: QoSProfile,
        raw: bool = False, overridable: bool = False) -> None:
    """Subscribe to a topic of a ROS type; a `raw` callback takes serialized bytes (CDR).

    Parameters ``qos_overrides.*`` change the quality of service if it is `overridable`.
    """
    create_or_refuse(node, f'subscription to {name}', lambda: node.create_subscription(
        kind, name, callback, profile, raw=raw,
        qos_overriding_options=_overriding(overridable),
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False)))


def subscribe_messages(
        node: Node, kinds: Iterable[type[m.Message]], sizes: Mapping[str, int] | None,
        on_message: Callable[[m.Message], None],
        on_error: Callable[[m.MessageError], None] | None = None, scenario_id: str = '', *,
        on_foreign: Callable[[m.Message], None] = lambda message: None,
        on_arrival: Callable[[type[m.Message]], None] = lambda kind: None,
        exchange: QoSProfile = EXCHANGE) -> None:
    """Subscribe to messages of the protocol; malformed ones are dropped.

    Parameters
    ----------
    sizes
        Required array sizes by symbol, as in `Scenario.sizes`; None: any.
    on_error
        Called with the reason why a message was dropped; by default, the node logs it.
    scenario_id, on_foreign
        If given, messages of other scenarios are passed to `on_foreign`.
    on_arrival
        Called with the class of each message before it is read.
    exchange
        Quality of service for messages that are not latched.
    """
    def log(error: m.MessageError) -> None:
        node.get_logger().warning(f'dropped: {error}', throttle_duration_sec=10.0)

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
            (on_error or log)(error)
            return
        on_message(message)
    for kind in kinds:
        subscribe(node, convert.ros_type(kind), topics.NAMES[kind],
                  functools.partial(receive, kind), profile_for(kind, exchange), raw=True)


class UserTopics:
    """Publishers for each user up to a highest number, created on first use.

    The names of the topics contain ``{user}``. The numbers are limited, because they come from
    messages and every topic takes time in discovery.
    """

    def __init__(self, node: Node, kinds: Mapping[str, type], max_users: int) -> None:
        self._node, self._kinds, self._max_users = node, kinds, max_users
        self._publishers: dict[int, tuple[Publisher, ...]] = {}

    def publishers(self, user: int) -> tuple[Publisher, ...]:
        """Return the publishers for a user, in the order of `kinds`; empty above the limit."""
        if user > self._max_users:
            self._node.get_logger().warning(
                f'no topics for user {user}, because the limit user_topics is {self._max_users}',
                once=True)
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

    Results are delivered in the thread that spins the node, as messages are.
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
        """Queue a job; the thread that spins the node gets its result, or its exception."""
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
        # The task only starts the timer: an exception in a task would stop the events executor,
        # and a task may outlast the node.
        if self._is_open:
            self._timer.reset()

    def _deliver(self) -> None:
        self._timer.cancel()
        while self._done:
            future, on_result = self._done.popleft()
            on_result(future.result())
