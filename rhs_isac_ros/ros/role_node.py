"""The adapter between a role of the protocol and ROS 2."""

import contextlib
import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.publisher import Publisher

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.role_statistics import Report, RoleStatistics
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.messages import started
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.ros import convert, endpoints, topics
from rhs_isac_ros.ros.diagnostics import publish_reports
from rhs_isac_ros.ros.frames import surface_frame
from rhs_isac_ros.ros.parameters import CODEBOOK, ParameterizedNode, scenario_of
from rhs_isac_ros.ros.peers import Peers, new_instance
from rhs_isac_ros.ros.roster import ROSTER

_NAMES = list(CODEBOOK)
_RETRY_S = 0.1
_RESPONSE_TIMEOUT_S = 2.0


class CodebookClient:
    """Fetches the codebook from the parameters of the optimizer whenever it changes.

    A message on the latched topic announces the codebook and triggers a request to the parameter
    service. If there are two optimizers, `Presences` selects the one that announces its codebook,
    but either may respond. If the response differs or is missing, the announced codebook is used,
    whose content is verified by its id. `codebook_id` is the id of the latest codebook, or ''.
    """

    def __init__(
            self, node: Node, scenario: Scenario, on_codebook: Callable[[Codebook], None]
    ) -> None:
        self._node, self._scenario, self._on_codebook = node, scenario, on_codebook
        # This is the only parameter service that a security policy has to allow.
        name = f'{topics.OPTIMIZER_NODE}/get_parameters'
        self._client = endpoints.create_or_refuse(
            node, f'client of {name}', lambda: node.create_client(GetParameters, name))
        # The announced codebook until it is used, its arrival [s], and whether it is requested.
        self._announced: Codebook | None = None
        self._announced_s, self._is_requested = math.inf, False
        # Reason why the latest codebook was rejected; empty if it was not.
        self._problem = ''
        self.codebook_id = ''
        endpoints.subscribe(node, ros.Codebook, topics.CODEBOOK, self._on_announcement,
                            endpoints.LATCHED, raw=True)
        self._timer = endpoints.steady_timer(node, _RETRY_S, self._request)

    def _on_announcement(self, content: bytes) -> None:
        try:
            message = convert.from_bytes(convert.CodebookMessage, content)
            codebook = message.codebook()
        # Anything may be published on the topic.
        except ValueError:
            return
        if message.codebook_id != codebook.id or not self._fits(message, codebook):
            return
        # Even if the id is unchanged, a response with a withdrawn codebook may be in transit.
        self._announced, self._is_requested = codebook, False
        self._announced_s = time.monotonic()
        self._timer.reset()
        self._request()

    def _fits(self, message: convert.CodebookMessage, codebook: Codebook) -> bool:
        """Return whether a codebook fits the scenario; if not, log the reason if it is new."""
        before, self._problem = self._problem, ''
        try:
            codebook.check(self._scenario)
            if message.scenario_id not in ('', self._scenario.id):
                raise CodebookError(
                    f'scenario {message.scenario_id}, expected {self._scenario.id}')
        except CodebookError as error:
            self._problem = f'codebook of the optimizer rejected: {error}'
            if self._problem != before:
                self._node.get_logger().error(self._problem)
        return not self._problem

    def _request(self) -> None:
        if self._announced is None:
            self._timer.cancel()
        elif time.monotonic() - self._announced_s > _RESPONSE_TIMEOUT_S:
            self._use(self._announced, ())
        elif self._client and not self._is_requested and self._client.service_is_ready():
            self._is_requested = True
            future = self._client.call_async(GetParameters.Request(names=_NAMES))
            future.add_done_callback(functools.partial(self._on_response, self._announced))

    def _on_response(self, announced: Codebook, future: Any) -> None:
        values = future.result().values if future.exception() is None else ()
        # A response to a request before the latest announcement is stale.
        if announced is self._announced:
            self._use(announced, values)

    def _use(self, codebook: Codebook, values: Sequence[ParameterValue]) -> None:
        """Use the codebook in a response if it was announced, otherwise the announced one."""
        self._announced = None
        # An invalid or incomplete response is ignored.
        with contextlib.suppress(CodebookError, ValueError):
            fetched = Codebook.from_parameters(
                dict(zip(_NAMES, map(parameter_value_to_python, values), strict=True)))
            codebook = fetched if fetched.id == codebook.id else codebook
        if codebook.id != self.codebook_id:
            self.codebook_id = codebook.id
            self._on_codebook(codebook)


# With simulated time, period of checking whether a state of the emulated world has ended [s].
_WORLD_POLL_S = 0.002
# Maximum number of senders with another scenario that are logged.
_MAX_LOGGED = 16

_RoleT = TypeVar('_RoleT', bound=Role)


class Clocks:
    """The clocks of the emulated world and of the roles, which start together and never go back.

    The world follows the clock of ROS if the node uses simulated time, otherwise the steady clock.
    The clock of the roles follows the steady clock, except in states that belong to the world,
    such as the rest between cycles. In such a state, it follows the world.
    """

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()
        self._steady_s = self._world_s = self._role_s = time.monotonic()
        self._simulated_s: float | None = None

    @property
    def is_simulated(self) -> bool:
        """Whether the node uses simulated time."""
        return bool(self._clock.ros_time_is_active)  # type: ignore[attr-defined]

    def world_s(self) -> float:
        """Return the time in the emulated world [s]."""
        self._advance(False)
        return self._world_s

    def role_s(self, in_world: bool) -> float:
        """Return the time of the roles [s], which follows the world if `in_world` is True."""
        self._advance(in_world)
        return self._role_s

    def _advance(self, in_world: bool) -> None:
        steady_s = time.monotonic()
        elapsed_s, self._steady_s = steady_s - self._steady_s, steady_s
        if not self.is_simulated:
            self._simulated_s = None
            self._world_s += elapsed_s
            self._role_s += elapsed_s
            return
        simulated_s = 1e-9 * self._clock.now().nanoseconds
        before_s = simulated_s if self._simulated_s is None else self._simulated_s
        self._simulated_s = simulated_s
        # When a simulation restarts, its time goes back; the time of the world then stands still.
        world_s = max(simulated_s - before_s, 0.0)
        self._world_s += world_s
        self._role_s += world_s if in_world else elapsed_s


class RoleNode(ParameterizedNode, Generic[_RoleT]):
    """A node that passes messages to a role and performs the returned actions.

    A subclass creates the role from the parameters and the `scenario`, and passes it to `start`.
    The `instance` is the value of `Message.sender`. Raises ParameterError or ScenarioError if a
    parameter or the scenario file is invalid.
    """

    role: _RoleT

    def __init__(self, executable: str, name: str = '', **node_options: Any) -> None:
        super().__init__(executable, name, **node_options)
        self.scenario = scenario_of(self.values)
        self._sizes = self.scenario.sizes
        self.instance = new_instance()
        self._identity = self.instance, self.scenario.id
        self._surface_frame = surface_frame(self.get_namespace())
        self.clocks = Clocks(self)
        self._missing: dict[str, str] | None = None
        self._lacking = ''
        self._foreign: set[int] = set()
        self._is_advertised = False
        # Whether a newer node has the role.
        self.stands_by = False
        self._has_optimizer = True
        self._sending: dict[type[m.Message], Publisher] = {}
        self._receiving: set[type[m.Message]] = set()
        # Subjects of logged errors; each is logged once, so that no faulty sender fills the disk.
        self._logged: set[str] = set()
        self._statistics = RoleStatistics()
        # The same timer serves all deadlines. It is set only if it would expire too late, or after
        # it has expired too early.
        self._timer = endpoints.steady_timer(self, 3600.0, self._on_timer)
        self._timer.cancel()
        self._timer_due_s: float | None = None

    def start(
            self, role: _RoleT, *, subscribe: bool = True, needs_codebook: bool = False) -> None:
        """Connect a role to its topics, and publish its diagnostics.

        With `needs_codebook`, the node advertises and subscribes when the first codebook arrives.
        Without `subscribe`, the subclass calls the method `subscribe` when the role is ready.
        """
        self.role, self._needs_codebook = role, needs_codebook
        if not needs_codebook:
            self.advertise()
        publish_reports(self, self.report)
        self._peers = Peers(
            self, self._executable, self.instance, self.scenario, self._on_missing,
            self._on_rival)
        self.endings.callback(self._peers.close)
        if subscribe and not needs_codebook:
            self.subscribe()
        if ROSTER[self._executable].has_codebook:
            self._codebook_client = CodebookClient(self, self.scenario, self._on_codebook)

    def advertise(self) -> None:
        """Create the publishers, so that the graph shows that the role is present.

        A node that stands by creates them when it resumes.
        """
        self._is_advertised = True
        for kind in () if self.stands_by else self.role.SENDS:
            if kind not in self._sending:
                self._sending[kind] = endpoints.create_publisher(
                    self, convert.ros_type(kind), topics.NAMES[kind], endpoints.profile_for(kind))

    def subscribe(self) -> None:
        """Create the subscriptions, which show that the role is ready, and announce the role."""
        kinds = [kind for kind in self.role.RECEIVES if kind not in self._receiving]
        self._receiving.update(kinds)
        endpoints.subscribe_messages(
            self, kinds, self._sizes, self._on_message, self._on_malformed, self.scenario.id,
            on_foreign=self._on_foreign, on_arrival=self._statistics.count_received)
        self._peers.take_role()

    def report(self) -> Report:
        """Return the diagnostics of the role, with the faults since the last report."""
        state = self.role.state
        return self._statistics.report(
            '' if state is None else state.value, self.role.counters,
            state in self.role.BLOCKED_STATES,
            {**self.role.status(), **self._peers.conflicts()})

    def stand_by(self) -> None:
        """Handle the takeover of the role by a newer node."""

    def resume(self) -> None:
        """Handle the return to service, after the newer node has gone."""

    def _on_missing(self, missing: dict[str, str]) -> None:
        if self.stands_by:
            return
        self._missing = missing
        self._report_missing(missing)
        has_optimizer = topics.OPTIMIZER_NODE not in missing
        if has_optimizer == self._has_optimizer:
            return
        self._has_optimizer = has_optimizer
        if has_optimizer:
            self.get_logger().info('optimizer is present again')  # type: ignore[no-untyped-call]
        else:
            self.get_logger().warning(  # type: ignore[no-untyped-call]
                'optimizer is not present; the codebook in use is '
                f'{self._codebook_client.codebook_id or "none"}')

    def set_lacking(self, text: str) -> None:
        """Set the description of a missing requirement that is not a role; '' if there is none."""
        if text != self._lacking:
            self._lacking = text
            # Before discovery, it is unknown which roles are missing.
            if self._missing is not None:
                self._report_missing(self._missing)

    def _report_missing(self, missing: dict[str, str]) -> None:
        lacking = (self._lacking,) if self._lacking else ()
        self._statistics.missing = (*missing.values(), *lacking)
        if ROSTER[self._executable].requires:
            self.dispatch(events.PeersChanged((*(
                text for role, text in missing.items() if role != topics.OPTIMIZER_NODE),
                *lacking)))

    def _on_rival(self, stands_by: bool) -> None:
        if stands_by == self.stands_by:
            return
        self.stands_by = stands_by
        if stands_by:
            self.stand_by()
            # Subscriptions remain, because the executor may hold messages for them.
            for publisher in self._sending.values():
                self.destroy_publisher(publisher)
            self._sending.clear()
        else:
            if self._is_advertised:
                self.advertise()
            self.resume()
            # The other nodes have to discover the new publishers.
            self._peers.restart()

    def on_settings_changed(self, settings: Any) -> None:
        """Pass new settings to the role."""
        self.dispatch(events.SettingsOffered(settings))

    def _on_codebook(self, codebook: Codebook) -> None:
        self.dispatch(events.CodebookOffered(codebook))
        if self._needs_codebook:
            self.advertise()
            self.subscribe()

    def now_s(self) -> float:
        """Return the time on the monotonic clock of the roles [s], whose epoch is arbitrary."""
        return self.clocks.role_s(self._in_world())

    def _in_world(self) -> bool:
        return self.role.state in self.role.WORLD_STATES

    def dispatch(self, event: events.Event) -> None:
        """Pass an event to the role, then a `Timeout` for each deadline that has passed."""
        now_s = self.now_s()
        self._handle(event, now_s)
        self._expire(now_s)

    def _expire(self, now_s: float) -> None:
        """Handle the deadlines that have passed, and set the timer for the next one."""
        while (deadline_s := self.role.next_deadline()) is not None and deadline_s <= now_s:
            self._handle(events.Timeout(), now_s)
        if deadline_s is not None and (
                self._timer_due_s is None or deadline_s < self._timer_due_s):
            self._set_timer(deadline_s - now_s, deadline_s)

    def publish(self, message: m.Message) -> bool:
        """Publish a message; return False if it is invalid (logged), or if the node stands by."""
        if self.stands_by:
            return False
        stamp_ns = message.stamp_ns or self.get_clock().now().nanoseconds
        try:
            m.check(message, self._sizes)
            content = convert.to_bytes(
                message, stamp_ns, self._identity, self._surface_frame)
        except m.MessageError as error:
            self._log_error('not sent', error)
            return False
        self._sending[type(message)].publish(content)
        return True

    def execute(self, action: events.Action) -> None:
        """Raise TypeError; subclasses override this method to execute actions of their roles."""
        raise TypeError(f'{type(action).__name__} is not an action of {self.get_name()}')

    def _on_message(self, message: m.Message) -> None:
        if not self.stands_by:
            self.dispatch(message)

    def _on_malformed(self, error: m.MessageError) -> None:
        self.role.counters['malformed'] += 1
        self._log_error('dropped', error)

    def _on_foreign(self, message: m.Message) -> None:
        """Count a message of another scenario, and log the first from each sender."""
        self.role.counters[events.Outcome.WRONG_SCENARIO.value] += 1
        if message.sender not in self._foreign and len(self._foreign) < _MAX_LOGGED:
            self._foreign.add(message.sender)
            self.get_logger().warning(  # type: ignore[no-untyped-call]
                f'{type(message).__name__} dropped: sent with scenario {message.scenario_id}, '
                f'expected {self.scenario.id}; sender {started(message.sender)}')

    def _handle(self, event: events.Event, now_s: float) -> None:
        start_s = time.perf_counter()
        actions = self.role.handle(event, now_s)
        handling_s = time.perf_counter() - start_s
        for action in actions:
            self._perform(action)
        # Last, because other nodes wait for the messages.
        self._statistics.record(event, actions, handling_s)

    def _perform(self, action: events.Action) -> None:
        match action:
            case events.Send(message):
                self.publish(message)
            case events.LogMessage(text, True):
                self.get_logger().warning(text)  # type: ignore[no-untyped-call]
            case events.LogMessage(text):
                self.get_logger().info(text)  # type: ignore[no-untyped-call]
            case events.RevertSettings(settings):
                self.revert_parameters(settings)
            case _:
                self.execute(action)

    def _log_error(self, consequence: str, error: m.MessageError) -> None:
        """Log an error once for each field; the text starts with the name of the field."""
        subject = f'{consequence} {str(error).partition(":")[0]}'
        if subject not in self._logged:
            self._logged.add(subject)
            self.get_logger().error(  # type: ignore[no-untyped-call]
                f'{consequence}: {error}')

    def _set_timer(self, delay_s: float, due_s: float) -> None:
        # The timer follows the steady clock, but the speed of a simulation is unknown, so poll.
        if self.clocks.is_simulated and self._in_world():
            delay_s = min(delay_s, _WORLD_POLL_S)
        self._timer.timer_period_ns = max(int(delay_s * 1e9), 1)
        self._timer.reset()
        self._timer_due_s = due_s

    def _on_timer(self) -> None:
        self._timer.cancel()
        self._timer_due_s = None
        self._expire(self.now_s())
