"""A crowd: cycles per second and the wait of each user, with few users and with many.

Problem: all users answer every beacon, one is served. What do the others cost? The network runs
twice, with few users and with many, and is compared with bare rclpy: the hops of a cycle, and the
acks of all users as they come to one subscription, both measured in the same run.
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
from system.chaos.watcher import Watcher

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.ros.processes import Processes, private_domain
from rhs_isac_ros.ros.resources import default_codebook_file
from rhs_isac_ros.ros.run import use_discovery_profile
from rhs_isac_ros.tools.demo import start_network

PATIENCE_S = 600.0


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--few', type=int, default=2)
    parser.add_argument('--users', type=int, default=64, help='users of the crowd')
    parser.add_argument('--rounds', type=int, default=5, help='how often each user is served')
    parser.add_argument('--composed', action='store_true',
                        help='all nodes in one process, instead of each in one of its own')
    parser.add_argument('--json', type=Path, help='file for the figures')
    options = parser.parse_args()
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
    where = 'one process' if options.composed else 'every node a process'
    for name in ('few', 'many'):
        one = figures[name]
        print(f'{one["users"]:3d} users, {where}: {one["rate_hz"]:.2f} cycles/s, cycle '
              f'{one["cycle_ms"]:.1f} ms, {one["given_up"]} given up; each waits '
              f'{one["longest_wait_cycles"]} cycles at most, {one["longest_wait_s"]:.2f} s')
    print(f'bare rclpy: {figures["floor_ms"]:.2f} ms for the {hops} hops of a cycle')
    print(f'rate with {options.users} users, of that with {options.few}: '
          f'{figures["rate_ratio"]:.2f}; fair within one round: {figures["fair"]}')
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + '\n', encoding='utf-8')
    return 0


def run_network(scenario: Scenario, users: int, cycles: int, composed: bool) -> dict:
    """Run a network until everybody is known, and so many cycles more."""
    watcher = Watcher(scenario)
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        with Processes(Path(logs), {'ROS_LOG_DIR': logs}) as processes:
            if composed:
                processes.start('network', users=users, rest_s=0.0)
            else:
                start_network(
                    processes, users, 0, None, default_codebook_file(), scenario, rest_s=0.0)
            spin(watcher, lambda: {end.user for end in watcher.ends} == {*range(1, users + 1)},
                 'a cycle of each user')
            first = len(watcher.ends)
            spin(watcher, lambda: len(watcher.ends) >= first + cycles, f'{cycles} cycles')
    watcher.destroy_node()
    ends = watcher.ends[first:first + cycles]
    served = [end for end in ends if end.outcome == 'served']
    ended_s = np.array([end.ended_s for end in served])
    return {
        'users': users, 'cycles': len(ends), 'given_up': len(ends) - len(served),
        'rate_hz': (len(served) - 1) / (ended_s[-1] - ended_s[0]),
        'cycle_ms': 1e3 * np.median([end.ended_s - end.began_s for end in served]),
        **waits([end.user for end in served], ended_s),
    }


def spin(watcher: Watcher, done: Callable[[], bool], what: str) -> None:
    """Hear messages until something is so."""
    if not watcher.spin_until(done, PATIENCE_S):
        raise RuntimeError(f'{what}: not within {PATIENCE_S:g} s')


def waits(order: list[int], ended_s: np.ndarray) -> dict:
    """Longest wait of any user, in cycles and in time, from one of its cycles to the next."""
    last: dict[int, int] = {}
    longest, longest_s = 0, 0.0
    for index, user in enumerate(order):
        if user in last:
            longest = max(longest, index - last[user])
            longest_s = max(longest_s, float(ended_s[index] - ended_s[last[user]]))
        last[user] = index
    # Who does not come again still waits.
    for index in last.values():
        longest = max(longest, len(order) - index)
    return {'longest_wait_cycles': longest, 'longest_wait_s': longest_s}


if __name__ == '__main__':
    sys.exit(main())
