"""Duration of a protocol cycle, compared with that of its messages alone.

Problem: a cycle is a chain of messages, each sent in response to the previous one, with the
computations of the nodes in between. How much time does the network add to bare rclpy? The lower
bound is a ping-pong with as many hops, between a bare publisher and subscription with the same
executor, measured in the same run. If the nodes of the network are processes, it runs between two
processes; otherwise, between two nodes of one process. Messages that need no estimate and no beam
are also compared with as many hops. Unlike a cycle, a ping-pong keeps its processes in the cache.
The messages of a cycle between bare processes, with the same receivers and pauses, therefore show
how much of a cycle is not due to the nodes. The 10th percentile is less sensitive than the median
to other programs on the machine.
"""

import faulthandler
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from parts.bare_cycle import bare_cycles
from parts.chain import ChainObserver, Cycle
from parts.frame import benchmark_parser, run, write_results
from parts.hops import CHAIN, ping_pong
from parts.serializers import SERIALIZERS
from rclpy.experimental import EventsExecutor
from system.trial_processes import TrialProcesses

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.environment import check_environment, private_domain, use_discovery_profile
from rhs_isac_ros.ros.processes import MAX_USER_NODES
from rhs_isac_ros.support.arguments import integer, positive_int
from rhs_isac_ros.tools.demo import start_network

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
WHERE = {'processes': 'one process per node', 'composed': 'all nodes in one process'}


def main() -> int:
    """Run the benchmark."""
    parser = benchmark_parser('cycle', __doc__, default_seed=None)
    parser.add_argument('--users', type=integer(1, MAX_USER_NODES), default=2,
                        help='number of users, each a process')
    parser.add_argument('--cycles', type=positive_int, default=300, help='number of cycles')
    parser.add_argument('--layout', choices=WHERE, action='append',
                        help='only this arrangement of the nodes; by default both')
    parser.add_argument('--serializer', choices=SERIALIZERS,
                        help='convert the messages of the nodes with this library')
    options = parser.parse_args()
    check_environment(parser)
    os.environ.update(private_domain())
    use_discovery_profile()
    results = {}
    for layout in options.layout or WHERE:
        results[layout] = measure(
            options.users, options.cycles, layout == 'composed', options.serializer)
        report(results[layout], layout)
    write_results(options.json, results)
    return 0


def measure(users: int, cycles: int, composed: bool, serializer: str | None) -> dict:
    """Run ping-pong, the network, and ping-pong again; return the figures."""
    scenario = Scenario()
    faulthandler.dump_traceback_later(HANG_S + HANG_CYCLE_S * cycles, exit=True)
    rclpy.init(args=[])
    try:
        before_s = ping_pong(scenario, composed)
        chains, cpu_s = run_cycles(scenario, users, cycles, composed, serializer)
        bare_s = None if composed else np.median(bare_cycles(REST_S))
        after_s = ping_pong(scenario, composed)
    finally:
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()
    hops_s = np.concatenate([before_s, after_s]) / 2
    hop_s, n_hops = float(np.median(hops_s)), len(CHAIN)
    cycles_s = np.array([chain.duration_s for chain in chains])
    messages_s = np.array([sum(link.elapsed_s for link in chain.links()
                               if link.name not in COMPUTED) for chain in chains])
    n_messages = n_hops - len(COMPUTED)
    quick_s, quick_hop_s = np.percentile(cycles_s, 10), np.percentile(hops_s, 10)
    cycle_s, floor_s = float(np.median(cycles_s)), n_hops * hop_s
    return {
        'users': users, 'cycles': len(chains), 'hops': n_hops, 'hop_us': 1e6 * hop_s,
        'hop_p99_us': 1e6 * np.percentile(hops_s, 99), 'floor_ms': 1e3 * floor_s,
        'cycle_ms': 1e3 * cycle_s, 'cycle_p99_ms': 1e3 * np.percentile(cycles_s, 99),
        'ratio': cycle_s / floor_s, 'messages': n_messages,
        'messages_ms': 1e3 * np.median(messages_s),
        'messages_ratio': np.median(messages_s) / (n_messages * hop_s),
        'messages_ratio_p10': np.percentile(messages_s, 10) / (n_messages * quick_hop_s),
        'bare_ms': bare_s and 1e3 * bare_s, 'cpu_ms': 1e3 * cpu_s,
        'cycle_p10_ms': 1e3 * quick_s, 'hop_p10_us': 1e6 * quick_hop_s,
        'ratio_p10': quick_s / (n_hops * quick_hop_s),
        'phases_ms': {phase.name.lower(): value for phase, value in zip(
            m.Phase, 1e3 * np.median([np.diff(chain.began_s()) for chain in chains], axis=0),
            strict=True)},
        'links': links(chains, hop_s),
    }


def run_cycles(
        scenario: Scenario, users: int, cycles: int, composed: bool, serializer: str | None
) -> tuple[list[Cycle], float]:
    """Run the network and return its cycles, and the CPU time of all nodes for each [s]."""
    observer, executor = ChainObserver(), EventsExecutor()
    executor.add_node(observer)
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        prefix = [sys.executable, '-m', 'parts.serializers', serializer] if serializer else []
        paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get('PYTHONPATH', '')])
        with TrialProcesses(Path(logs), {'ROS_LOG_DIR': logs, 'PYTHONPATH': paths},
                            lambda name: prefix) as processes:
            if composed:
                processes.start('network', users=users, rest_s=REST_S, mobility='random_walk',
                                speed_mps=scenario.max_user_speed_mps)
            else:
                start_network(processes, users, scenario, first_cycle=1, rest_s=REST_S)
            served, end_s, before_s = 0, time.monotonic() + TIMEOUT_S, 0.0
            while observer.served < WARM_UP + cycles:
                executor.spin_once(timeout_sec=0.5)
                if observer.served != served:
                    if observer.served == WARM_UP:
                        before_s = sum(processes.cpu_s().values())
                    served, end_s = observer.served, time.monotonic() + TIMEOUT_S
                if processes.ended() or time.monotonic() > end_s:
                    name = next(iter(processes.ended()), 'network' if composed else 'bs')
                    raise RuntimeError(f'{served} cycles; log of {name}:\n{processes.log(name)}')
            cpu_s = (sum(processes.cpu_s().values()) - before_s) / cycles
    executor.shutdown()
    observer.destroy_node()
    return observer.cycles()[WARM_UP:], cpu_s


def links(chains: list[Cycle], hop_s: float) -> list[dict]:
    """Return percentiles of the time between each message of the chain and the previous one."""
    times_s: dict[tuple[str, str], list[float]] = {}
    places: dict[tuple[str, str], list[int]] = {}
    for chain in chains:
        for place, link in enumerate(chain.links()):
            times_s.setdefault((link.name, link.sender), []).append(link.elapsed_s)
            places.setdefault((link.name, link.sender), []).append(place)
    ordered = sorted(times_s, key=lambda key: np.mean(places[key]))
    return [{'message': name, 'sender': sender, 'ms': 1e3 * np.median(values),
             'p10_ms': 1e3 * np.percentile(values, 10), 'p99_ms': 1e3 * np.percentile(values, 99),
             'beyond_hop_ms': 1e3 * (np.median(values) - hop_s)}
            for name, sender in ordered
            if len(values := times_s[name, sender]) > len(chains) / 2]


def report(figures: dict, layout: str) -> None:
    """Print the figures of an arrangement of the nodes."""
    print(f'{WHERE[layout]}, {figures["users"]} users, {figures["cycles"]} cycles')
    print(f'cycle     {figures["cycle_ms"]:7.2f} ms  median; 10th percentile '
          f'{figures["cycle_p10_ms"]:.2f} ms, 99th {figures["cycle_p99_ms"]:.2f} ms')
    print(f'floor     {figures["floor_ms"]:7.2f} ms  {figures["hops"]} hops of '
          f'{figures["hop_us"]:.0f} us; 10th percentile {figures["hop_p10_us"]:.0f} us, 99th '
          f'{figures["hop_p99_us"]:.0f} us')
    print(f'ratio     {figures["ratio"]:7.2f}     of the medians; of the 10th percentiles '
          f'{figures["ratio_p10"]:.2f}')
    print(f'messages  {figures["messages_ms"]:7.2f} ms  {figures["messages"]} hops, those without '
          'estimate and beam')
    print(f'ratio     {figures["messages_ratio"]:7.2f}     of the medians; of the 10th '
          f'percentiles {figures["messages_ratio_p10"]:.2f}')
    if figures['bare_ms']:
        print(f'bare      {figures["bare_ms"]:7.2f} ms  all messages of the cycle between bare '
              'processes, with the same receivers and pauses')
    print(f'CPU time  {figures["cpu_ms"]:7.2f} ms  of all nodes, for each cycle and its pause')
    for phase, value in figures['phases_ms'].items():
        print(f'  {phase:12s}{value:7.2f} ms')
    print('time since the previous message was sent: median, beyond a bare hop, percentiles')
    for link in figures['links']:
        print(f'  {link["message"]:24s} {link["sender"]:15s}{link["ms"]:7.2f} ms '
              f'{link["beyond_hop_ms"]:7.2f} ms; 10th {link["p10_ms"]:.2f} ms, 99th '
              f'{link["p99_ms"]:.2f} ms')


if __name__ == '__main__':
    run(main)
