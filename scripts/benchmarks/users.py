"""Cycle rate and waiting times with few users and with many.

Problem: all users answer every beacon, but only one is served. By how much do the other users slow
the cycles down? The network runs twice, with few users and with many, and is compared with the
hops of a cycle in bare rclpy, measured in the same run.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rclpy
from parts.hops import hops_of, ping_pong
from system.observer import NetworkObserver

from rhs_isac_ros.codebook import default_codebook_file
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arguments import ArgumentParser, output_file, positive_int
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.ros.command_line import check_domain
from rhs_isac_ros.ros.processes import Processes, private_domain
from rhs_isac_ros.ros.run import use_discovery_profile
from rhs_isac_ros.tools.demo import check_users, start_network

TIMEOUT_S = 600.0


def main() -> int:
    """Run the benchmark."""
    parser = ArgumentParser(
        prog='scripts/benchmark users', description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--few', type=positive_int, default=2,
                        help='number of users in the first run')
    parser.add_argument('--users', type=positive_int, default=64,
                        help='number of users in the second run')
    parser.add_argument('--rounds', type=positive_int, default=5, help='cycles for each user')
    parser.add_argument('--composed', action='store_true',
                        help='run all nodes in one process instead of one process per node')
    parser.add_argument('--json', type=output_file, help='JSON file for the results')
    options = parser.parse_args()
    check_domain(parser)
    if not options.composed:
        check_users(parser, max(options.few, options.users), '--composed')
    os.environ.update(private_domain())
    use_discovery_profile()
    rclpy.init(args=[])
    scenario = Scenario()
    cycles = options.rounds * options.users
    try:
        few, many = (run_network(scenario, users, cycles, options.composed)
                     for users in (options.few, options.users))
        hop_s = np.median(ping_pong(scenario)) / 2
    finally:
        rclpy.try_shutdown()
    hops = hops_of(scenario)
    figures = {
        'composed': options.composed, 'hop_us': 1e6 * hop_s, 'floor_ms': 1e3 * hops * hop_s,
        'few': few, 'many': many, 'rate_ratio': many['rate_hz'] / few['rate_hz'],
        'fair': many['longest_wait_cycles'] <= options.users,
    }
    where = 'one process' if options.composed else 'one process per node'
    for name in ('few', 'many'):
        run = figures[name]
        print(f'{run["users"]:3d} users, {where}: {run["rate_hz"]:.2f} cycles/s, cycle '
              f'{run["cycle_ms"]:.1f} ms, {run["given_up"]} given up; longest wait '
              f'{run["longest_wait_cycles"]} cycles, {run["longest_wait_s"]:.2f} s')
    print(f'bare rclpy: {figures["floor_ms"]:.2f} ms for the {hops} hops of a cycle')
    print(f'rate with {options.users} users relative to that with {options.few}: '
          f'{figures["rate_ratio"]:.2f}; fair, one round at most: {figures["fair"]}')
    if options.json:
        write_whole(options.json, json.dumps(figures, indent=2) + '\n')
    return 0


def run_network(scenario: Scenario, users: int, cycles: int, composed: bool) -> dict:
    """Run a network until each user has been served, then measure a number of cycles."""
    observer = NetworkObserver(scenario)
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        with Processes(Path(logs), {'ROS_LOG_DIR': logs}) as processes:
            if composed:
                processes.start('network', users=users, rest_s=0.0)
            else:
                start_network(
                    processes, users, 0, None, default_codebook_file(), scenario, rest_s=0.0)
            ended = observer.log.ended
            wait_until(
                observer, lambda: {cycle.user for cycle in ended} == {*range(1, users + 1)},
                'a cycle of each user')
            first = len(ended)
            wait_until(observer, lambda: len(ended) >= first + cycles, f'{cycles} cycles')
    observer.destroy_node()
    ends = ended[first:first + cycles]
    served = [end for end in ends if end.outcome == 'served']
    ended_s = np.array([end.ended_s for end in served])
    return {
        'users': users, 'cycles': len(ends), 'given_up': len(ends) - len(served),
        'rate_hz': (len(served) - 1) / (ended_s[-1] - ended_s[0]),
        'cycle_ms': 1e3 * np.median([end.ended_s - end.began_s for end in served]),
        **waits([end.user for end in served], ended_s),
    }


def wait_until(observer: NetworkObserver, done: Callable[[], bool], goal: str) -> None:
    """Process messages until a condition holds, or raise RuntimeError on timeout."""
    if not observer.spin_until(done, TIMEOUT_S):
        raise RuntimeError(f'{goal}: not within {TIMEOUT_S:g} s')


def waits(order: list[int], ended_s: np.ndarray) -> dict:
    """Return the longest wait of any user between two of its cycles, in cycles and in seconds."""
    last: dict[int, int] = {}
    longest, longest_s = 0, 0.0
    for index, user in enumerate(order):
        if user in last:
            longest = max(longest, index - last[user])
            longest_s = max(longest_s, float(ended_s[index] - ended_s[last[user]]))
        last[user] = index
    # Users that are not served again were still waiting at the end.
    for index in last.values():
        longest = max(longest, len(order) - index)
    return {'longest_wait_cycles': longest, 'longest_wait_s': longest_s}


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
