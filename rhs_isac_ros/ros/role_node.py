"""The adapter between a role of the protocol and ROS 2."""

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

from rclpy.publisher import Publisher

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.role_statistics import Report, RoleStatistics
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import (
    Action,
    Event,
    LogMessage,
    Send,
    SettingsOffered,
    SettingsReverted,
    Tick,
)
from rhs_isac_ros.ros import convert, parameters, qos, topics
from rhs_isac_ros.ros.codebook_source import CodebookSource
from rhs_isac_ros.ros.diagnostics import Diagnostics
from rhs_isac_ros.ros.settable_node import SettableNode
from rhs_isac_ros.ros.subscriptions import subscribe
from rhs_isac_ros.ros.timers import steady_timer


class Role(Protocol):
    """What drives a node: a state machine or anything that looks like one."""

    counters: Any

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take an event."""
        ...

    def next_deadline(self) -> float | None:
        """Return when the role wants a `Tick`."""
        ...

    def status(self) -> Mapping[str, str]:
        """Return what is in use and what waits, by name."""
        ...


class RoleNode(SettableNode):
    """A node that hands messages to a role and publishes what it answers.

    Parameters
    ----------
    executable
        Name of the executable, and of the node unless `name` is given.
    sends
        Messages that the role sends.
    name
        Name of the node.

    Attributes
    ----------
    values
        The parameters at the start, by name.
    scenario
        The scenario of the parameter ``scenario_file``.

    Raises
    ------
    ParameterError
        If a parameter is wrong.
    ScenarioError
        If the scenario file is wrong.
    """

    def __init__(
            self, executable: str, sends: Iterable[type[m.Message]], name: str = '',
            **node_options: Any) -> None:
        super().__init__(executable, name, **node_options)
        file = self.values.scenario_file
        self.scenario = Scenario.from_yaml(file) if file else Scenario()
        self._sizes = self.scenario.sizes
        self._role: Role | None = None
        self._listening: set[type[m.Message]] = set()
        if self.scenario.n_frames > qos.EXCHANGE.depth:
            raise parameters.ParameterError(
                f'scenario_file: n_frames {self.scenario.n_frames}, expected at most '
                f'{qos.EXCHANGE.depth}, the depth of the topics')
        self._outlets: dict[type[m.Message], Publisher] = {}
        self.advertise(sends)
        self._complaints: set[str] = set()
        self._statistics = RoleStatistics()
        # One timer for all deadlines. It is set anew only when it rings too early or too late.
        self._timer = steady_timer(self, 3600.0, self._ring)
        self._timer.cancel()
        self._rings_s: float | None = None

    def start(self, role: Role, receives: Iterable[type[m.Message]]) -> None:
        """Connect a role.

        Parameters
        ----------
        role
            The role.
        receives
            Messages that it wants from now on.
        """
        self._role = role
        self._diagnostics = Diagnostics(self, self.report)
        self.listen(receives)

    def report(self) -> Report:
        """Tell how the role fares, for the diagnostics.

        Returns
        -------
        Report
            The report; what is new is what came after the last one.
        """
        state = getattr(self._role, 'state', None)
        if state is None:
            return self._statistics.report(
                '', self._role.counters, status=self._role.status())
        return self._statistics.report(
            state.value, self._role.counters, state in self._role.LACKING,
            self._role.status())

    def offer(self, settings: Any) -> None:
        """Offer the role other settings.

        Parameters
        ----------
        settings
            The settings.
        """
        self.dispatch(SettingsOffered(settings))

    def follow_codebook(self, on_codebook: Callable[[Codebook], None]) -> None:
        """Fetch the codebook from the optimizer, and every change of it.

        Parameters
        ----------
        on_codebook
            Called with each new codebook.
        """
        self._codebook_source = CodebookSource(
            self, self.scenario, on_codebook,
            lambda there: self._statistics.set_available(topics.OPTIMIZER_NODE, there))

    def advertise(self, sends: Iterable[type[m.Message]]) -> None:
        """Create publishers; the graph then shows that the role is there.

        Parameters
        ----------
        sends
            Messages that the role sends.
        """
        for kind in sends:
            if kind not in self._outlets:
                self._outlets[kind] = self.create_publisher(
                    convert.ros_type(kind), topics.NAMES[kind], qos.of(kind))

    def listen(self, receives: Iterable[type[m.Message]]) -> None:
        """Subscribe to messages; the graph then shows that the role is ready for them.

        Parameters
        ----------
        receives
            Messages; those that the node listens to already stay as they are.
        """
        for kind in receives:
            if kind not in self._listening:
                self._listening.add(kind)
                subscribe(self, convert.ros_type(kind), topics.NAMES[kind],
                          self._receiver(kind), qos.of(kind), raw=True)

    @staticmethod
    def now_s() -> float:
        """Return the time on the clock of the roles [s]; it has no epoch and never goes back.

        Returns
        -------
        float
            The time [s].
        """
        return time.monotonic()

    def dispatch(self, event: Event) -> None:
        """Hand an event to the role and do what it asks for.

        Parameters
        ----------
        event
            The event.
        """
        now_s = self.now_s()
        self._hand(event, now_s)
        while (deadline_s := self._role.next_deadline()) is not None and deadline_s <= now_s:
            self._hand(Tick(), now_s)
        if deadline_s is not None and (self._rings_s is None or deadline_s < self._rings_s):
            self._set_timer(deadline_s - now_s, deadline_s)

    def publish(self, message: m.Message) -> bool:
        """Check a message and publish it; a wrong one is dropped with an error.

        Parameters
        ----------
        message
            The message.

        Returns
        -------
        bool
            Whether it was published.
        """
        try:
            m.check(message, self._sizes)
        except m.MessageError as error:
            self._complain('not sent', error)
            return False
        stamp = self.get_clock().now().to_msg()
        self._outlets[type(message)].publish(convert.to_ros(message, stamp))
        return True

    def perform(self, action: Action) -> None:
        """Do what only this node can do for its role.

        Parameters
        ----------
        action
            Neither a message to send nor a note.

        Raises
        ------
        TypeError
            If the node knows no such action.
        """
        raise TypeError(f'{type(action).__name__} is no action of {self.get_name()}')

    def _receiver(self, kind: type[m.Message]) -> Callable[[bytes], None]:
        def receive(serialized: bytes) -> None:
            self._statistics.count_received(kind)
            try:
                message = convert.from_bytes(kind, serialized)
                m.check(message, self._sizes)
            except m.MessageError as error:
                self._role.counters['malformed'] += 1
                self._complain('dropped', error)
                return
            self.dispatch(message)
        return receive

    def _hand(self, event: Event, now_s: float) -> None:
        begin_s = time.perf_counter()
        actions = self._role.handle(event, now_s)
        self._statistics.record(event, actions, now_s, time.perf_counter() - begin_s)
        self._do(actions)

    def _do(self, actions: list[Action]) -> None:
        for action in actions:
            match action:
                case Send(message):
                    self.publish(message)
                case LogMessage(text, True):
                    self.get_logger().warning(text)
                case LogMessage(text):
                    self.get_logger().info(text)
                case SettingsReverted(settings):
                    self.restore(settings)
                case _:
                    self.perform(action)

    def _complain(self, what: str, error: m.MessageError) -> None:
        """Log an error, once for each field: a babbling sender must not fill the disk."""
        field = f'{what} {str(error).partition(":")[0]}'
        if field not in self._complaints:
            self._complaints.add(field)
            self.get_logger().error(f'{what}: {error}')

    def _set_timer(self, delay_s: float, rings_s: float) -> None:
        self._timer.timer_period_ns = max(int(delay_s * 1e9), 1)
        self._timer.reset()
        self._rings_s = rings_s

    def _ring(self) -> None:
        now_s = self.now_s()
        self._timer.cancel()
        self._rings_s = None
        deadline_s = self._role.next_deadline()
        if deadline_s is None:
            return
        if deadline_s <= now_s:
            self.dispatch(Tick())
        else:
            self._set_timer(deadline_s - now_s, deadline_s)
