"""Duration of a protocol cycle, compared with that of its messages alone.

Problem: a cycle is a chain of messages, each sent in response to the previous one, with the
computations of the nodes in between. How much time does the network add to bare rclpy? The lower
bound is a ping-pong with as many hops, between a bare publisher and subscription with the same
executor, measured in the same run. If the nodes of the network are processes, it runs between two
processes; otherwise, between two nodes of one process. Messages that need no estimate and no beam
are also compared with as many hops. Unlike a cycle, a ping-pong keeps its processes in the cache.
The 10th percentile is less sensitive than the median to other programs on the machine.
"""

import collections
import faulthandler
import itertools
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.executables import missing_named

with missing_named('cycle'):
    import rclpy
from parts import frame
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from system.trial_processes import TrialProcesses

from rhs_isac_msgs.msg import FeedSignals
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, OBSERVATION, arrived_s, subscribe
from rhs_isac_ros.ros.environment import check_environment, private_domain, use_discovery_profile
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.tools.demo import start_network

LAYOUTS = {'processes': 'one process per node', 'composed': 'all nodes in one process'}
USERS, CYCLES, ROUND_TRIPS = 2, 300, 2000
# Pause between cycles, so that the report of one does not compete with the next for the cores.
REST_S = 0.05
# Links of the chain that consist of computations.
COMPUTED = ('position_estimate', 'beam')
# Cycles that are not evaluated.
WARM_UP = 10
# Maximum time between two served cycles.
TIMEOUT_S = 60.0
# Maximum time of a measurement, and what a cycle adds to it. Fast DDS 2.14 can wait for itself for
# ever when an endpoint is destroyed; the program then ends with the place where it waits.
HANG_S, HANG_CYCLE_S = 150.0, 0.5
# The messages of the chain, with their senders unless these depend on the content. Others are sent
# in parallel with them.
SENDERS = {
    m.Beacon: 'bs', m.Ack: 'user', m.RhsCommand: 'bs', m.RhsConfiguration: 'rhs_controller',
    m.PilotRequest: 'bs', m.Pilot: 'user', m.FeedSignals: 'channel', m.ReceivedSignals: 'bs',
    m.PositionEstimate: 'positioner', m.Beam: 'transmission', m.Data: '', m.ProtocolState: 'bs'}


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('cycle', __doc__, default_seed=None)
    options = parser.parse_args()
    check_environment(parser)
    os.environ.update(private_domain())
    use_discovery_profile()
    results = {}
    for layout, where in LAYOUTS.items():
        print(f'{where}, {USERS} users, {CYCLES} cycles\n', flush=True)
        cycles, hops_s, cpu_s = measure(CYCLES, layout == 'composed')
        table = frame.Table(['time'], {
            'median': ('median', 2), '10th percentile': ('p10', 2), '99th percentile': ('p99', 2)})
        results[layout] = {
            name: table.row(name, **row) for name, row in figures(cycles, hops_s).items()}
        print(f'\nCPU time of all nodes, for each cycle and its pause: {1e3 * cpu_s:.2f} ms\n')
    frame.write_results(options.json, results)


def measure(n_cycles: int, composed: bool) -> tuple[list['Cycle'], np.ndarray, float]:
    """Run ping-pong, the network, and ping-pong again.

    Returns the cycles, the times of bare hops, float64 [N] [s], and the CPU time of a cycle [s].
    """
    scenario = Scenario()
    faulthandler.dump_traceback_later(HANG_S + HANG_CYCLE_S * n_cycles, exit=True)
    rclpy.init(args=[])
    try:
        before_s = ping_pong(scenario, composed)
        cycles, cpu_s = run_cycles(scenario, n_cycles, composed)
        after_s = ping_pong(scenario, composed)
    finally:
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()
    return cycles, np.concatenate([before_s, after_s]) / 2, cpu_s


def figures(cycles: list['Cycle'], hops_s: np.ndarray) -> dict[str, dict[str, float]]:
    """Return percentiles of the times of cycles, hops, and each message of the chain."""
    def percentiles(times_s: Sequence[float]) -> dict[str, float]:
        middle, low, high = np.percentile(times_s, (50, 10, 99))
        return {'median': 1e3 * middle, 'p10': 1e3 * low, 'p99': 1e3 * high}

    chains = [cycle.links() for cycle in cycles]
    of_link = collections.defaultdict(list)
    for link in itertools.chain(*chains):
        of_link[f'{link.name} from {link.sender} [ms]'].append(link.elapsed_s)
    hop = percentiles(hops_s)
    found = {'bare hop [ms]': hop}
    n_hops = int(np.median([*map(len, chains)]))
    for name, n, times_s in (
            ('cycle', n_hops, [cycle.duration_s for cycle in cycles]),
            ('cycle without estimate and beam', n_hops - len(COMPUTED), [
                sum(link.elapsed_s for link in chain if link.name not in COMPUTED)
                for chain in chains])):
        found[f'{name} [ms]'] = own = percentiles(times_s)
        found[f'{name}, relative to {n} hops'] = {
            key: own[key] / n / hop[key] for key in ('median', 'p10')}
    # After the previous message of the chain.
    return found | {name: percentiles(times_s) for name, times_s in of_link.items()
                    if len(times_s) > len(chains) / 2}


def run_cycles(scenario: Scenario, n_cycles: int, composed: bool) -> tuple[list['Cycle'], float]:
    """Run the network and return its cycles, and the CPU time of all nodes for each [s]."""
    observer, executor = ChainObserver(), EventsExecutor()
    executor.add_node(observer)
    with (tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs,
          TrialProcesses(Path(logs), {'ROS_LOG_DIR': logs}) as processes):
        start_network(
            processes, USERS, scenario, composed=composed, first_cycle=1, rest_s=REST_S)
        served, end_s, before_s = 0, time.monotonic() + TIMEOUT_S, 0.0
        while observer.served < WARM_UP + n_cycles:
            executor.spin_once(timeout_sec=0.5)
            if observer.served != served:
                if observer.served == WARM_UP:
                    before_s = sum(processes.cpu_s().values())
                served, end_s = observer.served, time.monotonic() + TIMEOUT_S
            if processes.ended() or time.monotonic() > end_s:
                name = next(iter(processes.ended()), 'network' if composed else 'bs')
                raise RuntimeError(f'{served} cycles; log of {name}:\n{processes.log(name)}')
        cpu_s = (sum(processes.cpu_s().values()) - before_s) / n_cycles
    executor.shutdown()
    observer.destroy_node()
    return observer.cycles()[WARM_UP:], cpu_s


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
        self._stored: dict[type[m.Message], list[tuple[bytes, float]]] = {}
        for kind in SENDERS:
            self._stored[kind] = []
            subscribe(self, convert.ros_type(kind), topics.NAMES[kind], self._store(kind),
                      OBSERVATION, raw=True)

    def _store(self, kind: type[m.Message]) -> Callable[..., None]:
        stored, ends = self._stored[kind], kind is m.ProtocolState

        def store(content: bytes, info: Mapping[str, int]) -> None:
            stored.append((content, arrived_s(info)))
            # The outcome is text on the wire.
            self.served += ends and b'served' in content
        return store

    def cycles(self) -> list['Cycle']:
        """Return the cycles that were served and are complete, in order."""
        cycles: dict[int, Cycle] = {}
        for kind, stored in self._stored.items():
            for content, time_s in stored:
                message = convert.from_bytes(kind, content)
                cycles.setdefault(message.cycle_id, Cycle([])).sent.append((time_s, message))
        return [cycle for _, cycle in sorted(cycles.items()) if cycle.is_served]


class Cycle(NamedTuple):
    """The messages of a cycle with the times at which they arrived [s]."""

    sent: list[tuple[float, m.Message]]

    @property
    def is_served(self) -> bool:
        """Whether the user was served."""
        return any(getattr(message, 'outcome', '') == 'served' for _, message in self.sent)

    @property
    def duration_s(self) -> float:
        """Time from the beacon to the end, on the clock of the base station."""
        return max(message.elapsed_s for _, message in self.sent
                   if isinstance(message, m.ProtocolState))

    def links(self) -> list[Link]:
        """Return the messages of the chain in the order in which they were sent.

        Of several messages that are sent in response to the same one, the last counts.
        """
        last: dict[tuple[str, str], float] = {}
        for sent_s, message in self.sent:
            if step := step_of(message):
                last[step] = max(sent_s, last.get(step, 0.0))
        ordered = sorted((sent_s, step) for step, sent_s in last.items())
        return [Link(*step, sent_s - before_s) for (before_s, _), (sent_s, step) in zip(
            ordered, ordered[1:], strict=False)]


def step_of(message: m.Message) -> tuple[str, str] | None:
    """Return the step of the chain to which a message belongs, and its sender; or None."""
    name, sender = topics.NAMES[type(message)], SENDERS[type(message)]
    match message:
        case m.ProtocolState():
            return ('end', sender) if message.outcome else None
        case m.RhsConfiguration(mode=m.Mode.TRANSMISSION):
            return f'{name} (beam)', sender
        case m.RhsCommand() | m.RhsConfiguration() if message.band > 0:
            # Sent in parallel with those of the first band.
            return None
        case m.Data():
            delivered = message.stage is m.Stage.DELIVERED
            offers = 'bs' if message.direction is m.Direction.DOWNLINK else 'user'
            return (f'{name} {message.direction.name.lower()} {message.stage.name.lower()}',
                    'channel' if delivered else offers)
    return name, sender


def ping_pong(scenario: Scenario, composed: bool) -> np.ndarray:
    """Measure round trips between nodes of one process or of two, float64 [N] [s]."""
    feeds = np.ones((scenario.n_frames, scenario.n_subbands, scenario.n_feeds), complex)
    message = deserialize_message(convert.to_bytes(
        m.FeedSignals(cycle_id=1, user=1, band=0, signals=feeds), 0), FeedSignals)
    times_s: list[float] = []
    node = Node('ping')
    publisher = node.create_publisher(FeedSignals, 'benchmark/ping', EXCHANGE)

    def send() -> None:
        times_s.append(time.perf_counter())
        publisher.publish(message)

    subscribe(node, FeedSignals, 'benchmark/pong', lambda _: send(), EXCHANGE)
    executor = EventsExecutor()
    nodes = [node, *make_pong()] if composed else [node]
    for each in nodes:
        executor.add_node(each)
    other = multiprocessing.get_context('spawn').Process(target=run, args=(make_pong, []))
    if not composed:
        other.start()
    try:
        while not (publisher.get_subscription_count() and node.count_publishers('benchmark/pong')):
            executor.spin_once(timeout_sec=0.1)
        send()
        while len(times_s) <= ROUND_TRIPS:
            executor.spin_once(timeout_sec=1.0)
    finally:
        if not composed:
            other.terminate()
            other.join()
        executor.shutdown()
        for each in nodes:
            each.destroy_node()
    return np.diff(times_s)[ROUND_TRIPS // 10:]


def make_pong() -> list[Node]:
    """Return a node that echoes each message."""
    node = Node('pong')
    publisher = node.create_publisher(FeedSignals, 'benchmark/pong', EXCHANGE)
    subscribe(node, FeedSignals, 'benchmark/ping', publisher.publish, EXCHANGE)
    return [node]


if __name__ == '__main__':
    frame.run(main)
