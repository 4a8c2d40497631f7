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
from pathlib import Path

import cycle
import numpy as np
import rclpy

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.demo import start_network, watch
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.processes import Processes, private_domain
from rhs_isac_ros.ros.resources import default_codebook_file
from rhs_isac_ros.ros.run import find_each_other_quickly


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
    find_each_other_quickly()
    rclpy.init(args=[])
    scenario = Scenario()
    cycles = options.rounds * options.users
    try:
        few, many = (run_network(scenario, users, cycles, options.composed)
                     for users in (options.few, options.users))
        hop_s = np.median(cycle.ping_pong(scenario)) / 2
    finally:
        rclpy.try_shutdown()
    hops = len(cycle.BEFORE) + scenario.n_bands * len(cycle.PER_BAND) + len(cycle.AFTER)
    figures = {
        'composed': options.composed, 'hop_us': 1e6 * hop_s, 'floor_ms': 1e3 * hops * hop_s,
        'few': few, 'many': many, 'rate_ratio': many['rate_hz'] / few['rate_hz'],
        'fair': many['longest_wait_cycles'] <= options.users,
    }
    where = 'one process' if options.composed else 'every node a process'
    for name in ('few', 'many'):
        one = figures[name]
        print(f'{one["users"]:3d} users, {where}: {one["rate_hz"]:.2f} cycles/s, cycle '
              f'{one["cycle_ms"]:.1f} ms from the grant, {one["beaconing_ms"]:.1f} ms for beacon '
              f'and acks; each waits {one["longest_wait_cycles"]} cycles at most, '
              f'{one["longest_wait_s"]:.2f} s')
    print(f'bare rclpy: {figures["floor_ms"]:.2f} ms for the {hops} hops of a cycle')
    print(f'rate with {options.users} users, of that with {options.few}: '
          f'{figures["rate_ratio"]:.2f}; fair within one round: {figures["fair"]}')
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + '\n', encoding='utf-8')
    return 0


def run_network(scenario: Scenario, users: int, cycles: int, composed: bool) -> dict:
    """Run a network until everybody is known, and so many cycles more."""
    observer = CycleObserver()
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        with Processes(Path(logs), {'ROS_LOG_DIR': logs}) as processes:
            if composed:
                processes.start('network', users=users, rest_s=0.0)
            else:
                start_network(
                    processes, users, 0, None, default_codebook_file(), scenario, rest_s=0.0)
            problem = wait_for_all(observer, processes, users)
            first = len(observer.log.complete)
            problem = problem or watch(observer, processes, first + cycles, lambda *_: None)
    observer.destroy_node()
    if problem:
        raise RuntimeError(problem)
    records = observer.log.complete[first:]
    begins_s = np.array([record.began_s for record in records])
    spans = [record.durations_s() for record in records]
    beaconing = next(iter(spans[0]))
    return {
        'users': users, 'cycles': len(records), 'given_up': len(observer.log.given_up),
        'rate_hz': (len(records) - 1) / (begins_s[-1] - begins_s[0]),
        'beaconing_ms': 1e3 * np.median([span[beaconing] for span in spans]),
        'cycle_ms': 1e3 * np.median(
            [sum(span.values()) - span[beaconing] for span in spans]),
        **waits([record.user for record in records], begins_s),
    }


def wait_for_all(observer: CycleObserver, processes: Processes, users: int) -> str:
    """Watch until every user was served; return what went wrong, or nothing."""
    problem, served = '', set()
    while len(served) < users and not problem:
        problem = watch(observer, processes, len(observer.log.complete) + 1, lambda *_: None)
        served = {record.user for record in observer.log.complete}
    return problem


def waits(order: list[int], begins_s: np.ndarray) -> dict:
    """Longest wait of any user, in cycles and in time, from one of its cycles to the next."""
    last: dict[int, int] = {}
    longest, longest_s = 0, 0.0
    for index, user in enumerate(order):
        if user in last:
            longest = max(longest, index - last[user])
            longest_s = max(longest_s, float(begins_s[index] - begins_s[last[user]]))
        last[user] = index
    # Who does not come again still waits.
    for index in last.values():
        longest = max(longest, len(order) - index)
    return {'longest_wait_cycles': longest, 'longest_wait_s': longest_s}


if __name__ == '__main__':
    sys.exit(main())
