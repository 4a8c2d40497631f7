"""The chain of messages of a cycle: when each arrived, and how long its sender took."""

import collections
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import OBSERVATION

# The messages of the chain. Others are sent in parallel with them.
KINDS = (m.Beacon, m.Ack, m.RhsCommand, m.RhsConfiguration, m.PilotRequest, m.Pilot, m.FeedSignals,
         m.ReceivedSignals, m.PositionEstimate, m.Beam, m.Data, m.ProtocolState)


class Link(NamedTuple):
    """A message of the chain, its sender, and the time since the previous message was sent [s]."""

    name: str
    sender: str
    elapsed_s: float


class ChainObserver(Node):
    """Stores the messages of the chain with as little work as possible.

    It would otherwise compete with the network for the cores.

    Attributes
    ----------
    served
        Number of cycles that were served.
    """

    def __init__(self) -> None:
        super().__init__('chain_observer')
        self.served = 0
        # With the time of arrival of each [s]: stamps are those of measurements.
        self._stored: dict[type[m.Message], list[tuple[bytes, float]]] = (
            collections.defaultdict(list))
        for kind in KINDS:
            self.create_subscription(
                convert.ros_type(kind), topics.NAMES[kind], self._store(kind), OBSERVATION,
                raw=True, event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))

    def _store(self, kind: type[m.Message]) -> Callable[[bytes], None]:
        stored, ends = self._stored[kind], kind is m.ProtocolState

        def store(content: bytes) -> None:
            stored.append((content, time.monotonic()))
            # The outcome is text on the wire.
            self.served += ends and b'served' in content
        return store

    def cycles(self) -> list['Cycle']:
        """Return the cycles that were served and are complete, in order."""
        cycles: dict[int, Cycle] = {}
        for kind, stored in self._stored.items():
            for content, arrived_s in stored:
                message = convert.from_bytes(kind, content)
                cycle = cycles.setdefault(message.cycle_id, Cycle())
                cycle.sent.append((arrived_s, message))
        return [cycle for _, cycle in sorted(cycles.items()) if cycle.is_served]


class Cycle:
    """The messages of a cycle with the times at which they arrived [s]."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, m.Message]] = []

    @property
    def is_served(self) -> bool:
        """Whether the user was served."""
        return any(state.outcome == 'served' for state in self.all(m.ProtocolState))

    @property
    def duration_s(self) -> float:
        """Time from the beacon to the end, on the clock of the base station."""
        return max(state.elapsed_s for state in self.all(m.ProtocolState))

    def all(self, kind: type[m.Message]) -> list:
        """Return the messages of a class."""
        return [message for _, message in self.sent if type(message) is kind]

    def began_s(self) -> np.ndarray:
        """Return the start of each phase, and the end [s], since the beacon, float64 [5]."""
        last = max(self.all(m.ProtocolState), key=lambda state: state.elapsed_s)
        return np.append(last.began_s, last.elapsed_s)

    def links(self) -> list[Link]:
        """Return the messages of the chain in the order in which they were sent.

        Of several messages that are sent in response to the same one, the last counts.
        """
        last: dict[str, tuple[float, str]] = {}
        for sent_s, message in self.sent:
            step = _step(message)
            if step is not None and (step not in last or sent_s > last[step][0]):
                last[step] = sent_s, _sender_of(message)
        ordered = sorted((sent_s, step, sender) for step, (sent_s, sender) in last.items())
        return [Link(step, sender, sent_s - before_s)
                for (before_s, _, _), (sent_s, step, sender) in zip(
                    ordered, ordered[1:], strict=False)]


_SENDERS = {
    m.Beacon: 'bs', m.Ack: 'user', m.RhsCommand: 'bs', m.RhsConfiguration: 'rhs_controller',
    m.PilotRequest: 'bs', m.Pilot: 'user', m.FeedSignals: 'channel', m.ReceivedSignals: 'bs',
    m.PositionEstimate: 'positioner', m.Beam: 'transmission', m.ProtocolState: 'bs'}


def _sender_of(message: m.Message) -> str:
    match message:
        case m.Data(stage=m.Stage.DELIVERED):
            return 'channel'
        case m.Data():
            return 'bs' if message.direction is m.Direction.DOWNLINK else 'user'
    return _SENDERS[type(message)]


def _step(message: m.Message) -> str | None:
    """Return the step of the chain to which a message belongs, or None."""
    name = topics.NAMES[type(message)]
    match message:
        case m.ProtocolState():
            return 'end' if message.outcome else None
        case m.RhsConfiguration(mode=m.Mode.TRANSMISSION):
            return f'{name} (beam)'
        case m.RhsCommand() | m.RhsConfiguration() if message.band > 0:
            # Sent in parallel with those of the first band.
            return None
        case m.Data():
            return f'{name} {message.direction.name.lower()} {message.stage.name.lower()}'
    return name
