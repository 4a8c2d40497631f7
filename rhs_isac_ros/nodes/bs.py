"""The executable ``bs``: the base station."""

import functools
import time
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model.measurement import receive_feeds
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import create_or_refuse
from rhs_isac_ros.ros.frames import Frame
from rhs_isac_ros.ros.locate import LocateServer
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support import streams

# Time in which a node that stands by sends the results of its goals [s].
_FAREWELL_S = 0.5


class BsNode(RoleNode[BaseStation]):
    """The ROS node of the base station."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('bs', **node_options)
        values = self.values
        rng = streams.generator(values.seed, streams.BASE_STATION)
        self.start(BaseStation(
            self.scenario, self.make_settings(values), rng, self._receive,
            values.first_cycle or _cycle_from_clock()))
        frame = Frame.of(self, values)
        self._make_locate = functools.partial(
            LocateServer, self, lambda user: self.dispatch(events.LocateRequested(user)),
            lambda found: convert.pose(found, convert.stamp_of(found, self), frame),
            values.max_users)
        self._locate: LocateServer | None = self._make_locate()
        self._reply = events.Reply(False, '')
        for name, request in ((topics.PAUSE, events.PauseRequested()),
                              (topics.RESUME, events.ResumeRequested()),
                              (topics.STEP, events.StepRequested())):
            create_or_refuse(self, f'service {name}', functools.partial(
                self.create_service, Trigger, name, functools.partial(self._on_request, request)))

    def stand_by(self) -> None:
        """Abandon the cycle, and wait."""
        self._end_locate(_FAREWELL_S)
        self.dispatch(events.StoodBy())

    def resume(self) -> None:
        """Begin cycles once the other nodes are known to be present."""
        self.dispatch(events.Resumed(_cycle_from_clock()))
        self._locate = self._make_locate()

    def dispatch(self, event: events.Event) -> None:
        """Pass an event to the role, and to the action."""
        super().dispatch(event)
        if self._locate and isinstance(event, m.PositionEstimate | m.NoFix):
            self._locate.observe(event)

    def publish(self, message: m.Message) -> bool:
        """Publish a message, and pass it to the action."""
        is_published = super().publish(message)
        if is_published and self._locate and isinstance(message, m.ProtocolState):
            self._locate.observe(message)
        return is_published

    def destroy_node(self) -> None:
        """End the action, then destroy the node."""
        self._end_locate()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def _end_locate(self, delay_s: float = 0.0) -> None:
        if self._locate:
            self._locate.destroy(delay_s)
        self._locate = None

    def execute(self, action: events.Action) -> None:
        """Store a reply for the service that requested it."""
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

    def _receive(
            self, codebook: Codebook, feeds: np.ndarray, user: int, cycle_id: int,
            noise: bool) -> np.ndarray:
        rng = None
        if noise:
            rng = streams.generator(self.values.seed, streams.RECEIVER, user, cycle_id)
        return receive_feeds(self.scenario, codebook, feeds, rng)


def _cycle_from_clock() -> int:
    """Return the time since 1970 [ms]. Cycles take longer than 1 ms, so no id is reused."""
    return time.time_ns() // 1_000_000


main = entry('bs', lambda: [BsNode()])
