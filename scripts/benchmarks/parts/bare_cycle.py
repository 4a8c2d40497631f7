"""The messages of a cycle between bare processes, without the computations of the nodes."""

import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from parts.chain import KINDS
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert
from rhs_isac_ros.ros.cdr import HEADER
from rhs_isac_ros.ros.endpoints import EXCHANGE
from rhs_isac_ros.ros.roster import ROSTER
from rhs_isac_ros.ros.run import run

CYCLES = 200
# Cycles that are not evaluated.
WARM_UP = 20
# Time after which a cycle is begun again, because a process had not discovered another one [s].
TIMEOUT_S = 1.0


class Step(NamedTuple):
    """A message, the process that sends it, its size [bytes], and the steps that it follows."""

    kind: type[m.Message]
    sender: str
    size: int
    after: tuple[int, ...]


# A cycle with two bands and two users, of whom the first is granted. Sizes are those of Table I.
STEPS = (
    Step(m.Beacon, 'bs', 72, ()),
    Step(m.Ack, 'user_1', 64, (0,)), Step(m.Ack, 'user_2', 64, (0,)),
    Step(m.Grant, 'bs', 76, (1, 2)),
    Step(m.RhsCommand, 'bs', 87, (1, 2)), Step(m.RhsCommand, 'bs', 87, (1, 2)),
    Step(m.ProtocolState, 'bs', 116, (1, 2)), Step(m.GroundTruth, 'user_1', 116, (3,)),
    Step(m.RhsConfiguration, 'rhs_controller', 3308, (4,)),
    Step(m.RhsConfiguration, 'rhs_controller', 3308, (5,)),
    Step(m.PilotRequest, 'bs', 88, (8, 9)),
    Step(m.Pilot, 'user_1', 156, (10,)), Step(m.Pilot, 'user_1', 156, (10,)),
    Step(m.FeedSignals, 'channel', 1644, (11,)), Step(m.FeedSignals, 'channel', 1644, (12,)),
    Step(m.ReceivedSignals, 'bs', 1156, (13, 14)), Step(m.ProtocolState, 'bs', 116, (13, 14)),
    Step(m.PositionEstimate, 'positioner', 228, (15,)),
    Step(m.Beam, 'transmission', 1324, (17,)),
    Step(m.RhsConfiguration, 'rhs_controller', 908, (18,)),
    Step(m.Data, 'bs', 84, (19,)), Step(m.ProtocolState, 'bs', 116, (19,)),
    Step(m.Data, 'channel', 84, (20,)), Step(m.Data, 'user_1', 84, (22,)),
    Step(m.Data, 'channel', 84, (23,)))
PROCESSES = ('rhs_controller', 'channel', 'user_1', 'user_2', 'positioner', 'transmission',
             'observer')


class BareNode(Node):
    """Sends the steps of one process, without content.

    Attributes
    ----------
    durations_s
        Durations of the complete cycles [s], of ``bs`` alone.
    """

    def __init__(self, process: str, rest_s: float) -> None:
        super().__init__(f'bare_{process}')
        self._received: set[int] = set()
        self.durations_s: list[float] = []
        steps = [(number, step) for number, step in enumerate(STEPS) if step.sender == process]
        self._steps = [(number, {*step.after}, HEADER + bytes([number]) + bytes(step.size))
                       for number, step in steps]
        self._senders = {number: self.create_publisher(
            convert.ros_type(step.kind), _topic(step.kind), EXCHANGE)
            for number, step in steps}
        member = ROSTER.get(process.rstrip('_12'))
        for kind in member.role.RECEIVES if member else KINDS:
            self.create_subscription(
                convert.ros_type(kind), _topic(kind), self._receive if member else _ignore,
                EXCHANGE, raw=True,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))
        if process == 'bs':
            self._began_s, self._is_resting = time.perf_counter(), True
            self.create_timer(rest_s, self._begin)

    def _begin(self) -> None:
        if self._is_resting or time.perf_counter() > self._began_s + TIMEOUT_S:
            self._received.clear()
            self._began_s, self._is_resting = time.perf_counter(), False
            self._send(0)

    def _receive(self, content: bytes) -> None:
        number = content[len(HEADER)]
        if number == 0:
            self._received.clear()
        self._received.add(number)
        if number == len(STEPS) - 1 and 0 in self._senders:
            self.durations_s.append(time.perf_counter() - self._began_s)
            self._is_resting = True
        for own, after, _ in self._steps:
            if number in after and after <= self._received:
                self._send(own)

    def _send(self, number: int) -> None:
        content = next(content for own, _, content in self._steps if own == number)
        self._senders[number].publish(content)


def _topic(kind: type[m.Message]) -> str:
    return f'bare/{kind.__name__}'


def _ignore(content: bytes) -> None:
    return


def bare_cycles(rest_s: float) -> np.ndarray:
    """Measure cycles without content, with a pause between them, float64 [N] [s]."""
    others = [subprocess.Popen([sys.executable, '-m', 'parts.bare_cycle', process],
                               cwd=Path(__file__).parents[1]) for process in PROCESSES]
    node, executor = BareNode('bs', rest_s), EventsExecutor()
    executor.add_node(node)
    try:
        while len(node.durations_s) < WARM_UP + CYCLES:
            executor.spin_once(timeout_sec=1.0)
            if any(other.poll() is not None for other in others):
                raise RuntimeError('a bare process has ended')
    finally:
        for other in others:
            other.terminate()
        for other in others:
            other.wait()
        executor.shutdown()
        node.destroy_node()
    return np.array(node.durations_s[WARM_UP:])


if __name__ == '__main__':
    sys.exit(run(lambda: [BareNode(sys.argv[1], 0.0)], ['bare_cycle']))
