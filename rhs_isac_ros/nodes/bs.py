"""The executable ``bs``: the base station."""

import collections
import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from rhs_isac_msgs.action import Locate
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.cdr import TINY
from rhs_isac_ros.ros.endpoints import SERVICES, create_or_refuse, once
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support import streams

_DEFAULT_TIMEOUT_S = 10.0
_MAX_TIMEOUT_S = 3600.0
# Maximum number of goals in progress: each takes memory and a timer.
_MAX_GOALS = 100
# Time for which a result is kept; each status message lists all goals with results [s].
_RESULT_S = 10

# Minimum time between two answers of the action, in all and for each client [s]. By default, a
# client of rclpy keeps the latest ten answers, including those to other clients, so it would lose
# most of many answers at once. All clients may be in one process, which takes one after the other.
_ANSWER_S, _ANSWER_PER_CLIENT_S = 0.01, 0.001


class _Slots:
    """Separates answers to many goals at once, so that each client can take them."""

    def __init__(self, node: Node) -> None:
        self._node, self._next_s = node, 0.0
        self._feedback = f'{node.resolve_topic_name(topics.LOCATE)}/_action/feedback'
        self._waiting: collections.deque[Future] = collections.deque()

    async def wait(self) -> None:
        """Return at the next slot; at once if there is none before."""
        delay_s = self._next_s - time.monotonic()
        if self._waiting or delay_s > 0:
            future: Future = Future()
            self._waiting.append(future)
            if len(self._waiting) == 1:
                once(self._node, delay_s, self._end_slot)
            await future
        else:
            self._begin_slot()

    def _begin_slot(self) -> float:
        """Set the time of the next slot, and return the time until then [s]."""
        length_s = max(_ANSWER_S,
                       _ANSWER_PER_CLIENT_S * self._node.count_subscribers(self._feedback))
        self._next_s = time.monotonic() + length_s
        return length_s

    def _end_slot(self) -> None:
        # The next slot begins when this one has ended. With times that are fixed in advance, a
        # delayed process would send all overdue answers at once.
        length_s = self._begin_slot()
        self._waiting.popleft().set_result(None)
        if self._waiting:
            once(self._node, length_s, self._end_slot)


@dataclasses.dataclass(eq=False)
class _Goal:
    """A goal in progress; `cycle_id` is the cycle that positions its user; 0 if there is none."""

    handle: Any
    future: Future
    cycle_id: int = 0
    has_answered: bool = False  # whether the user has answered a beacon


class LocateServer:
    """Serves the action ``locate``, based on messages that the base station sends and receives.

    `request` asks the base station to serve a user; `pose` converts an estimate to a pose.
    """

    def __init__(
            self, node: Node, request: Callable[[int], None],
            pose: Callable[[m.PositionEstimate], PoseWithCovarianceStamped],
            max_users: int, max_goals: int = _MAX_GOALS) -> None:
        self._node, self._request, self._pose = node, request, pose
        self._max_users, self._max_goals = max_users, max_goals
        # Number of goals that were accepted and have not ended, and those that have begun.
        self._n_accepted = 0
        self._goals: list[_Goal] = []
        self._slots = _Slots(node)
        self._server = create_or_refuse(node, f'action {topics.LOCATE}', lambda: ActionServer(
            node, Locate, topics.LOCATE, self._execute, goal_callback=self._accept,
            cancel_callback=self._cancel, goal_service_qos_profile=SERVICES,
            result_service_qos_profile=SERVICES, cancel_service_qos_profile=SERVICES,
            feedback_pub_qos_profile=SERVICES, callback_group=ReentrantCallbackGroup(),
            result_timeout=_RESULT_S))

    def observe(self, message: m.Ack | m.ProtocolState | m.PositionEstimate | m.NoFix) -> None:
        """Update the goals with a message that the base station has sent or received."""
        phase = message.phase if isinstance(message, m.ProtocolState) else None
        for goal in [one for one in self._goals if one.handle.request.user == message.user]:
            goal.has_answered |= isinstance(message, m.Ack)
            if phase is m.Phase.POSITIONING:
                goal.cycle_id = message.cycle_id
            if goal.cycle_id != message.cycle_id:
                continue
            if phase is m.Phase.BEACONING:
                # The cycle has ended without a position, so the user needs another cycle.
                goal.cycle_id = 0
                self._request(message.user)
            match message:
                case m.ProtocolState():
                    self._feed_back(goal, message.phase)
                case m.PositionEstimate():
                    self._end(goal, '', Locate.Result(
                        pose=self._pose(message), cycle_id=message.cycle_id))
                case m.NoFix():
                    self._end(goal, f'no fix: {message.reason}')

    def destroy(self, delay_s: float = 0.0) -> None:
        """Abort all goals; withdraw the action `delay_s` [s] later, once the results are sent."""
        for goal in list(self._goals):
            self._end(goal, 'the base station ends or stands by')
        if delay_s:
            once(self._node, delay_s, self._withdraw)
        else:
            self._withdraw()

    def _withdraw(self) -> None:
        server, self._server = self._server, None
        if server:
            server.destroy()

    async def _accept(self, request: Locate.Goal) -> GoalResponse:
        await self._slots.wait()
        valid = 1 <= request.user <= self._max_users and (
            request.timeout_s == 0 or TINY <= request.timeout_s <= _MAX_TIMEOUT_S)
        if valid and self._n_accepted < self._max_goals:
            self._n_accepted += 1
            return GoalResponse.ACCEPT
        self._node.get_logger().warning(
            f'{topics.LOCATE}: {self._max_goals} goals are in progress' if valid else
            f'{topics.LOCATE}: user {request.user}, timeout_s {request.timeout_s:g}, expected a '
            f'user from 1 to {self._max_users} and a timeout from 0 to {_MAX_TIMEOUT_S:g} s, as a '
            'float such as 5.0',
            throttle_duration_sec=1.0)
        return GoalResponse.REJECT

    def _cancel(self, handle: Any) -> CancelResponse:
        for goal in self._goals:
            if goal.handle.goal_id == handle.goal_id:
                # Not at once: the handle enters the state CANCELING after this callback.
                once(self._node, 0.0, functools.partial(self._end, goal, 'canceled'))
        return CancelResponse.ACCEPT

    async def _execute(self, handle: Any) -> Locate.Result:
        goal = _Goal(handle, Future())
        self._goals.append(goal)
        timeout_s = handle.request.timeout_s or _DEFAULT_TIMEOUT_S
        timer = once(self._node, timeout_s, lambda: self._end(goal, (
            'no position' if goal.has_answered else
            f'user {handle.request.user} has answered no beacon') + f' within {timeout_s:g} s'))
        self._feed_back(goal, m.Phase.BEACONING)
        self._request(handle.request.user)
        result = await goal.future
        self._n_accepted -= 1
        self._node.destroy_timer(timer)
        await self._slots.wait()
        return result

    def _feed_back(self, goal: _Goal, phase: m.Phase) -> None:
        goal.handle.publish_feedback(Locate.Feedback(phase=int(phase), cycle_id=goal.cycle_id))

    def _end(self, goal: _Goal, reason: str, result: Locate.Result | None = None) -> None:
        """End a goal as canceled (if requested), as successful (with a result) or as aborted."""
        if goal not in self._goals:
            return
        self._goals.remove(goal)
        if goal.handle.is_cancel_requested:
            goal.handle.canceled()
        elif result:
            goal.handle.succeed()
        else:
            goal.handle.abort()
        goal.future.set_result(result or Locate.Result(reason=reason))


# Time in which a node that stands by can still send the results of its goals [s].
_FAREWELL_S = 0.5


class BsNode(RoleNode[BaseStation]):
    """The ROS node of the base station."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('bs', **node_options)
        values = self.values
        rng = streams.generator(values.seed, streams.BASE_STATION)
        self.start(BaseStation(
            self.scenario, self.make_settings(values), rng, values.seed,
            values.first_cycle or _cycle_from_clock(), self.library, self.clocks.world_s))
        self._locate: LocateServer | None = None
        self._begin_locate()
        self._reply = events.Reply(False, '')
        for name, request in ((topics.PAUSE, events.PauseRequested()),
                              (topics.RESUME, events.ResumeRequested()),
                              (topics.STEP, events.StepRequested())):
            create_or_refuse(self, f'service {name}', functools.partial(
                self.create_service, Trigger, name, functools.partial(self._on_request, request),
                qos_profile=SERVICES))

    def stand_by(self) -> None:
        """Withdraw the action ``locate``, and abandon the cycle."""
        if self._locate:
            self._locate.destroy(_FAREWELL_S)
        self._locate = None
        self.dispatch(events.StoodBy())

    def resume(self) -> None:
        """Offer the action again, and begin cycles once the other nodes are present."""
        self.dispatch(events.Resumed(_cycle_from_clock()))
        self._begin_locate()

    def dispatch(self, event: events.Event) -> None:
        """Pass an event to the role, and that of a user or positioner also to ``locate``."""
        super().dispatch(event)
        if self._locate and isinstance(event, m.Ack | m.PositionEstimate | m.NoFix):
            self._locate.observe(event)

    def publish(self, message: m.Message) -> bool:
        """Publish a message, and pass a published `ProtocolState` to the action ``locate``."""
        is_published = super().publish(message)
        if is_published and self._locate and isinstance(message, m.ProtocolState):
            self._locate.observe(message)
        return is_published

    def _begin_locate(self) -> None:
        self._locate = LocateServer(
            self, lambda user: self.dispatch(events.LocateRequested(user)),
            lambda found: convert.pose(found, convert.stamp_of(found, self), self.frame),
            self.values.max_users)
        # An action that is still to be withdrawn would outlive its node.
        self.endings.callback(self._locate.destroy)

    def execute(self, action: events.Action) -> None:
        """Store a reply for the service call that caused it."""
        if isinstance(action, events.Reply):
            self._reply = action
        else:
            super().execute(action)

    def _on_request(
            self, event: events.Event, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self.dispatch(event)
        response.success, response.message = self._reply.success, self._reply.text
        return response


def _cycle_from_clock() -> int:
    """Return the milliseconds since 1970: an unused id, because a cycle takes more than 1 ms."""
    return time.time_ns() // 1_000_000


main = entry('bs', lambda: [BsNode()])
