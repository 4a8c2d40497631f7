"""Duration of a protocol cycle, compared with that of its messages alone.

Problem: a cycle is a chain of messages, each sent in response to the previous one, with the
computations of the nodes in between. How much time does the network add to bare rclpy? The floor
is the same number of hops, measured in the same run and with the same executor as ping-pong of a
bare publisher and subscription between two processes.
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import rclpy
from parts.hops import hops_of, ping_pong

from rhs_isac_ros.codebook import default_codebook_file
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arguments import ArgumentParser, output_file, positive_int
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.command_line import check_domain
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.processes import Processes, private_domain
from rhs_isac_ros.ros.run import use_discovery_profile
from rhs_isac_ros.tools.demo import check_users, start_network, watch

# Pause between cycles, so that the report of one does not compete with the next for the cores.
REST_S = 0.05


def main() -> int:
    """Run the benchmark."""
    parser = ArgumentParser(
        prog='scripts/benchmark cycle', description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--users', type=positive_int, default=2, help='number of users')
    parser.add_argument('--cycles', type=positive_int, default=300, help='number of cycles')
    parser.add_argument('--json', type=output_file, help='JSON file for the results')
    options = parser.parse_args()
    check_domain(parser)
    check_users(parser, options.users)
    os.environ.update(private_domain())
    scenario = Scenario()
    hops = hops_of(scenario)
    use_discovery_profile()
    rclpy.init(args=[])
    try:
        before_s = ping_pong(scenario)
        cycles = run_cycles(scenario, options.users, options.cycles)
        after_s = ping_pong(scenario)
    finally:
        rclpy.try_shutdown()
    hop_s = np.median(np.concatenate([before_s, after_s])) / 2
    # Discard the first cycles as warm-up.
    cycles = cycles[10:]
    cycle_s = np.median([record.ended_s - record.began_s for record in cycles])
    figures = {
        'users': options.users, 'cycles': len(cycles), 'hops': hops,
        'cycle_ms': 1e3 * cycle_s, 'floor_ms': 1e3 * hops * hop_s,
        'ratio': cycle_s / (hops * hop_s), 'hop_us': 1e6 * hop_s,
        'estimator_ms': 1e3 * np.median([r.estimate.latency_s for r in cycles]),
        'phases_ms': {phase.name.lower(): 1e3 * np.median(
            [r.durations_s().get(phase, np.nan) for r in cycles]) for phase in m.Phase},
    }
    print(f'cycle     {figures["cycle_ms"]:7.2f} ms  from beacon to end, median of {len(cycles)}, '
          f'{options.users} users, one process per node')
    print(f'floor     {figures["floor_ms"]:7.2f} ms  {hops} hops of {figures["hop_us"]:.0f} us')
    print(f'ratio     {figures["ratio"]:7.2f}')
    print(f'estimator {figures["estimator_ms"]:7.2f} ms')
    for phase, value in figures['phases_ms'].items():
        print(f'  {phase:12s}{value:7.2f} ms')
    if options.json:
        write_whole(options.json, json.dumps(figures, indent=2) + '\n')
    return 0


def run_cycles(scenario: Scenario, users: int, cycles: int) -> list:
    """Run the network and return the records of its complete cycles."""
    observer = CycleObserver()
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        with Processes(Path(logs), {'ROS_LOG_DIR': logs}) as processes:
            start_network(processes, users, 0, None, default_codebook_file(), scenario, REST_S)
            problem = watch(observer, processes, cycles, lambda *_: None)
    observer.destroy_node()
    if problem:
        raise RuntimeError(problem)
    return observer.log.complete


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
