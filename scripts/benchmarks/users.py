"""Cycle rate and waiting times with few users and with many.

Problem: a cycle serves one user. How much do other users slow it down, in separate processes or in
one process? Networks with many users are compared with a network of few users.
"""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rhs_isac_ros.executables import missing_named

with missing_named('users'):
    import rclpy
from parts import frame
from system.observer import NetworkObserver
from system.trial_processes import TrialProcesses

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.ros.environment import check_environment, private_domain, use_discovery_profile
from rhs_isac_ros.support.arguments import positive_int
from rhs_isac_ros.tools.demo import start_network

TIMEOUT_S = 600.0
# Minimum number of measured cycles.
MIN_CYCLES = 200
# Users of the network to compare with, users as processes of their own, and users that share one
# process. In the discovery range LOCALHOST, 32 processes of one machine discover each other.
FEW, SEPARATE, TOGETHER = 2, 25, 1000


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('users', __doc__, default_seed=None)
    parser.add_argument('--rounds', type=positive_int, default=2, help='cycles for each user')
    options = parser.parse_args()
    check_environment(parser)
    networks = {'separate': (SEPARATE, False), 'together': (TOGETHER, True)}
    os.environ.update(private_domain())
    use_discovery_profile()
    rclpy.init(args=[])
    scenario = Scenario()
    try:
        # Before and after, because other programs may slow down the machine for a while.
        few = [run_network(scenario, FEW, options.rounds, False)]
        many = {name: run_network(scenario, users, options.rounds, together)
                for name, (users, together) in networks.items()}
        few.append(run_network(scenario, FEW, options.rounds, False))
    finally:
        rclpy.try_shutdown()
    rate_hz = np.mean([one['rate_hz'] for one in few])
    for one in many.values():
        one['rate_ratio'] = one['rate_hz'] / rate_hz
    table = frame.Table(['users'], {
        'cycles/s': ('rate_hz', 2), 'relative to few users': ('rate_ratio', 2),
        'cycle [ms]': ('cycle_ms', 1), 'CPU time of a cycle [ms]': ('cpu_ms', 1),
        'given up': ('given_up', 0), 'longest wait [cycles]': ('longest_wait_cycles', 0),
        'longest wait [s]': ('longest_wait_s', 2)})
    for one in (*few, *many.values()):
        where = 'in one process' if one['together'] else 'as processes'
        table.row(f'{one["users"]} {where}', **one)
    frame.write_results(options.json, {'few': few, **many})


def run_network(scenario: Scenario, users: int, rounds: int, together: bool) -> dict:
    """Run a network until each user has been served, then measure a number of rounds."""
    cycles = max(rounds * users, MIN_CYCLES)
    observer = NetworkObserver(scenario)
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        with TrialProcesses(Path(logs), {'ROS_LOG_DIR': logs}) as processes:
            start_network(
                processes, users, scenario, together=together, first_cycle=1, rest_s=0.0)
            ended = observer.log.ended
            wait_until(
                observer, lambda: {cycle.user for cycle in ended} == {*range(1, users + 1)},
                'a cycle of each user')
            first, before_s = len(ended), sum(processes.cpu_s().values())
            wait_until(observer, lambda: len(ended) >= first + cycles, f'{cycles} cycles')
            cpu_s = sum(processes.cpu_s().values()) - before_s
    observer.destroy_node()
    ends = ended[first:first + cycles]
    served = [end for end in ends if end.outcome == 'served']
    ended_s = np.array([end.ended_s for end in served])
    # A cycle that is given up is a turn of its user, too.
    longest, longest_s = longest_wait(
        [end.user for end in ends], np.array([end.ended_s for end in ends]))
    return {
        'users': users, 'together': together, 'cycles': len(ends),
        'given_up': len(ends) - len(served),
        'rate_hz': (len(served) - 1) / (ended_s[-1] - ended_s[0]),
        'cycle_ms': 1e3 * np.median([end.ended_s - end.began_s for end in served]),
        # Other programs hardly affect it, unlike the rate.
        'cpu_ms': 1e3 * cpu_s / len(ends),
        'longest_wait_cycles': longest, 'longest_wait_s': longest_s}


def wait_until(observer: NetworkObserver, done: Callable[[], bool], goal: str) -> None:
    """Process messages until a condition holds, or raise RuntimeError on timeout."""
    if not observer.spin_until(done, TIMEOUT_S):
        raise RuntimeError(f'{goal}: not within {TIMEOUT_S:g} s')


def longest_wait(order: list[int], ended_s: np.ndarray) -> tuple[int, float]:
    """Return the longest wait of any user between two of its turns, in cycles and in seconds."""
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
    return longest, longest_s


if __name__ == '__main__':
    frame.run(main)
