"""The adapter between a role of the protocol and ROS 2."""

import contextlib
import functools
import time
from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.publisher import Publisher

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.library import EMPTY, Library
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.role_statistics import Report, RoleStatistics
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.messages import started
from rhs_isac_ros.protocol.role import Role
from rhs_isac_ros.ros import convert, endpoints, topics
from rhs_isac_ros.ros.diagnostics import make_reporter
from rhs_isac_ros.ros.node_surface import NodeSurface
from rhs_isac_ros.ros.parameters import CODEBOOK, ParameterizedNode
from rhs_isac_ros.ros.peers import Peers
from rhs_isac_ros.ros.roster import MEMBERS
from rhs_isac_ros.ros.topics import Frame
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import ParameterError
from rhs_isac_ros.support.plugins import PluginError

_NAMES = list(CODEBOOK)
# Time without a response after which a request is repeated [s]: a killed optimizer does not
# respond, but remains in the ROS graph for some time.
_RETRY_S = 0.25
# Time after which an announced codebook that the optimizer does not hold is reported, because an
# optimizer that starts or ends may differ for a moment; period of the requests from then on [s].
_PATIENCE_S, _SLOW_RETRY_S = 3.0, 2.0


class CodebookClient:
    """Fetches the codebook from the parameters of the optimizer whenever it changes.

    The latched topic announces the id of the codebook. The client requests the parameters until
    they contain the codebook with this id: while the optimizer restarts, a response may be missing
    or contain an earlier codebook. If the difference lasts, another node announces a codebook, as
    a player of a recording does, and the client reports it. `codebook_id` is the id of the latest
    codebook, or ''.
    """

    def __init__(
            self, node: Node, scenario: Scenario, on_codebook: Callable[[Codebook], None]
    ) -> None:
        self._node, self._scenario, self._on_codebook = node, scenario, on_codebook
        # This is the only parameter service that a security policy has to allow.
        name = f'{topics.OPTIMIZER_NODE}/get_parameters'
        self._client = endpoints.create_or_refuse(
            node, f'client of {name}', lambda: node.create_client(GetParameters, name))
        # Id of the announced codebook while it is requested.
        self._announced_id, self._announced_s = '', 0.0
        self._conflict = ''
        self.codebook_id = ''
        endpoints.subscribe(
            node, ros.Codebook, topics.CODEBOOK, self._on_announcement, endpoints.LATCHED)
        self._timer = endpoints.steady_timer(node, _RETRY_S, self._request)

    def _on_announcement(self, announcement: ros.Codebook) -> None:
        if announcement.codebook_id != self._announced_id:
            self._announced_id, self._announced_s = announcement.codebook_id, time.monotonic()
            endpoints.set_period(self._timer, _RETRY_S)
        self._request()

    def _request(self) -> None:
        if self._announced_id in ('', self.codebook_id):
            self._end()
        elif self._client and self._client.service_is_ready():
            future = self._client.call_async(GetParameters.Request(names=_NAMES))
            future.add_done_callback(self._on_response)

    def _on_response(self, future: Any) -> None:
        # A response without the parameters is ignored.
        with contextlib.suppress(CodebookError, ValueError):
            codebook = Codebook.from_parameters(dict(zip(
                _NAMES, map(parameter_value_to_python, future.result().values), strict=True)))
            if codebook.id == self._announced_id:
                self._end()
                self._use(codebook)
            elif self._announced_id and time.monotonic() > self._announced_s + _PATIENCE_S:
                self._report(codebook.id)

    def _end(self) -> None:
        """End the requests."""
        self._announced_id = ''
        self._timer.cancel()
        self._set_conflict('')

    def _report(self, held_id: str) -> None:
        """Report that the optimizer holds another codebook, unless the other node has gone."""
        if self._node.count_publishers(self._node.resolve_topic_name(topics.CODEBOOK)) < 2:
            self._end()
            return
        endpoints.set_period(self._timer, _SLOW_RETRY_S)
        self._set_conflict(f'{topics.CODEBOOK}: another node announces {self._announced_id}, but '
                           f'{topics.OPTIMIZER_NODE} holds {held_id}, which is used')

    def _set_conflict(self, text: str) -> None:
        before, self._conflict = self._conflict, text
        if text != before:
            endpoints.journal(self._node).state(
                'announced', text or f'no longer: {before}', bool(text))

    def conflicts(self) -> dict[str, str]:
        """Return the codebook that the optimizer does not hold, if any, for the diagnostics."""
        return {'conflict.codebook': self._conflict} if self._conflict else {}

    def _use(self, codebook: Codebook) -> None:
        try:
            codebook.check(self._scenario)
        except CodebookError as error:
            endpoints.journal(self._node).event(
                'codebook', f'codebook of the optimizer rejected: {error}', error=True)
            return
        self.codebook_id = codebook.id
        self._on_codebook(codebook)


# Messages that are also sent while no user is served.
_WITHOUT_WORK = m.Beacon, m.ProtocolState, m.GroundTruth, m.GroundTruths
# With simulated time, period of checking whether a state of the emulated world has ended [s].
_WORLD_POLL_S = 0.002

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
        simulated_s = 1e-9 * self._clock.now().nanoseconds if self.is_simulated else None
        before_s, self._simulated_s = self._simulated_s, simulated_s
        world_s = elapsed_s
        if simulated_s is not None:
            # When a simulation restarts, its time goes back; that of the world then stands still.
            world_s = 0.0 if before_s is None else max(simulated_s - before_s, 0.0)
        self._world_s += world_s
        self._role_s += world_s if in_world else elapsed_s


class RoleNode(ParameterizedNode, Generic[_RoleT]):
    """A node that passes messages to a role and performs the returned actions.

    A subclass creates the role from the parameters, the `scenario` and, if it has the parameter
    ``library_file``, the `library`, and passes it to `start`.
    The `instance` is the value of `Message.sender`. Raises ParameterError or ScenarioError if a
    parameter or the scenario file is invalid.
    """

    role: _RoleT

    def __init__(self, executable: str, name: str = '', **node_options: Any) -> None:
        super().__init__(executable, name, **node_options)
        self.surface = NodeSurface.of(
            self.values, self.get_namespace(), MEMBERS[executable].of_site)
        self.scenario = self.surface.scenario
        self.library = self._load_library(getattr(self.values, 'library_file', ''))
        if hasattr(self.values, 'seed'):
            self.values.seed = self.surface.seed(self.values.seed)
        self.instance = time.time_ns()
        self.frame = Frame.of(self, self.values)
        self.clocks = Clocks(self)
        self._missing: tuple[str, ...] | None = None
        self._lacking = ''
        # Whether a newer node has the role.
        self.stands_by = False
        self._sending: dict[type[m.Message], Publisher] = {}
        self._receiving: set[type[m.Message]] = set()
        self._statistics = RoleStatistics(self.library.by_id)
        # The same timer serves all deadlines. It is set only if it would expire too late, or after
        # it has expired too early.
        self._timer = endpoints.steady_timer(self, 3600.0, self._on_timer)
        self._timer.cancel()
        self._timer_due_s: float | None = None

    def start(
            self, role: _RoleT, *, subscribe: bool = True, needs_codebook: bool = False) -> None:
        """Connect a role to its topics, and publish its diagnostics.

        With `needs_codebook`, the node subscribes when the first codebook arrives. Without
        `subscribe`, the subclass calls the method `subscribe` when the role is ready.
        """
        self.role, self._needs_codebook = role, needs_codebook
        self._advertise()
        self._peers = Peers(
            self, self._executable, self.instance, self.scenario, self._on_missing,
            self._on_rival, self.surface.site_prefix,
            self.library.id if hasattr(self.values, 'library_file') else '',
            make_reporter(self, self.report),
            self.frame.name if hasattr(self.values, 'frame_id') else '')
        self.endings.callback(self._peers.close)
        if subscribe and not needs_codebook:
            self.subscribe()
        if MEMBERS[self._executable].has_codebook:
            self._codebook_client = CodebookClient(self, self.scenario, self._on_codebook)

    def _load_library(self, file: str) -> Library:
        if not file:
            return EMPTY
        if self.surface.site:
            # The fusion, which locates the users of a site, proposes no codebooks.
            raise ParameterError(f'library_file: {file!r}, expected none in a site')
        with translated((CodebookError, OSError), ParameterError, 'library_file'):
            library = Library.load(file)
            library.check(self.scenario)
        return library

    def _advertise(self) -> None:
        self._sending = {kind: endpoints.create_publisher(
            self, convert.ros_type(kind), topics.NAMES[kind], endpoints.profile_for(kind))
            for kind in self.role.SENDS}

    def subscribe(self) -> None:
        """Create the subscriptions, and announce the role, which is now ready."""
        kinds = [kind for kind in self.role.RECEIVES if kind not in self._receiving]
        self._receiving.update(kinds)
        for kind, prefix, scenario in self.surface.sources(
                kinds, MEMBERS[self._executable].from_all):
            endpoints.subscribe_messages(
                self, [kind], scenario, self._on_message, self._on_malformed,
                on_foreign=functools.partial(self._on_foreign, scenario),
                on_arrival=self._statistics.count_received,
                on_frame=self._peers.note_frame, prefix=prefix)
        self._peers.take_role()

    def report(self) -> Report:
        """Return the diagnostics of the role, with the faults since the last report."""
        state = self.role.state
        codebook = (self._codebook_client.conflicts() if MEMBERS[self._executable].has_codebook
                    else {})
        return self._statistics.report(
            '' if state is None else state.value, self.role.counters,
            state in self.role.BLOCKED_STATES,
            {**self.role.status(), **self._peers.conflicts(), **codebook, **self.details()})

    def details(self) -> Mapping[str, str]:
        """Return further values of the diagnostics; by default, there are none."""
        return {}

    def stand_by(self) -> None:
        """Handle the takeover of the role by a newer node."""

    def resume(self) -> None:
        """Handle the return to service, after the newer node has gone."""

    def _on_missing(self, missing: tuple[str, ...]) -> None:
        if self.stands_by:
            return
        had_optimizer = topics.OPTIMIZER_NODE not in (self._missing or ())
        self._missing = missing
        self._report_missing(missing)
        has_optimizer = topics.OPTIMIZER_NODE not in missing
        if has_optimizer != had_optimizer:
            codebook_id = self._codebook_client.codebook_id
            endpoints.journal(self).state(
                'optimizer', 'optimizer is present' if has_optimizer else
                f'optimizer is not present; the codebook in use is {codebook_id or "none"}',
                not has_optimizer, warning=bool(codebook_id) and not has_optimizer)

    def set_lacking(self, text: str) -> None:
        """Set the description of a missing requirement that is not a role; '' if there is none."""
        if text != self._lacking:
            self._lacking = text
            # Before discovery, it is unknown which roles are missing.
            if self._missing is not None:
                self._report_missing(self._missing)

    def _report_missing(self, missing: tuple[str, ...]) -> None:
        self._statistics.missing = tuple(filter(None, (*missing, self._lacking)))
        if MEMBERS[self._executable].requires:
            self.dispatch(events.PeersChanged(tuple(
                role for role in missing if role != topics.OPTIMIZER_NODE), self._lacking))

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
            self._advertise()
            self.resume()
            # The other nodes have to discover the new publishers.
            self._peers.restart()

    def on_settings_changed(self, settings: Any) -> None:
        """Pass new settings to the role."""
        self.dispatch(events.SettingsOffered(settings))

    def _on_codebook(self, codebook: Codebook) -> None:
        self.dispatch(events.CodebookOffered(codebook))
        if self._needs_codebook:
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
        if deadline_s is None or (
                self._timer_due_s is not None and self._timer_due_s <= deadline_s):
            return
        delay_s, self._timer_due_s = deadline_s - now_s, deadline_s
        # The timer follows the steady clock, but the speed of a simulation is unknown, so poll.
        if self.clocks.is_simulated and self._in_world():
            delay_s = min(delay_s, _WORLD_POLL_S)
        endpoints.set_period(self._timer, delay_s)

    def publish(self, message: m.Message) -> bool:
        """Publish a message; return False if it is invalid (logged), or if the node stands by."""
        if self.stands_by:
            return False
        stamp_ns = message.stamp_ns or self.get_clock().now().nanoseconds
        scenario_id = message.scenario_id if self.surface.is_carried(message) else self.scenario.id
        try:
            m.check(message, self.scenario)
            content = convert.to_bytes(
                message, stamp_ns, (self.instance, scenario_id),
                self.frame.name if isinstance(message, m.POSITIONS) else self.frame.surface)
        except m.MessageError as error:
            endpoints.journal(self).event(
                f'not sent {str(error).partition(":")[0]}', f'not sent: {error}',
                error=True)
            return False
        self._sending[type(message)].publish(content)
        if not isinstance(message, _WITHOUT_WORK):
            self._peers.note_work()
        return True

    def is_observed(self, kind: type[m.Message]) -> bool:
        """Return whether a message of the role has subscribers."""
        publisher = self._sending.get(kind)
        return publisher is not None and publisher.get_subscription_count() > 0

    def execute(self, action: events.Action) -> None:
        """Raise TypeError; subclasses override this method to execute actions of their roles."""
        raise TypeError(f'{type(action).__name__} is not an action of {self.get_name()}')

    def _on_message(self, message: m.Message, _: float) -> None:
        if not self.stands_by:
            self.dispatch(message)

    def _on_malformed(self, error: m.MessageError) -> None:
        self.role.counters['malformed'] += 1
        endpoints.log_dropped(self, error)

    def _on_foreign(self, scenario: Scenario, message: m.Message) -> None:
        """Count and log a message of another scenario, but no data of another surface."""
        if self.surface.is_carried(message):
            return
        self.role.counters[events.Outcome.WRONG_SCENARIO.value] += 1
        endpoints.journal(self).event(
            'foreign', f'{type(message).__name__} dropped: sent with scenario '
            f'{message.scenario_id}, expected {scenario.id}; sender '
            f'{started(message.sender)}')

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
            case events.LogMessage(text, warning, key, bool(holds)):
                endpoints.journal(self).state(key, text, holds, warning)
            case events.LogMessage(text, True, key):
                endpoints.journal(self).event(key or text, text)
            case events.LogMessage(text):
                endpoints.log(self, text)
            case events.RevertSettings(settings):
                self.revert_parameters(settings)
            case _:
                self.execute(action)

    def note(self, error: PluginError) -> None:
        """Count and log a failure of a plug-in, as the role does when it handles an event."""
        self._perform(self.role.noted(error))

    def _on_timer(self) -> None:
        self._timer.cancel()
        self._timer_due_s = None
        self._expire(self.now_s())
