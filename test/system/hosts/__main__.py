"""The command ``scripts/hosts``: outages of the links of a network on several hosts."""

import argparse
import collections
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python.packages import get_package_share_directory
from rclpy.signals import SignalHandlerOptions

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.monitoring.cycle_log import CycleTimes
from rhs_isac_ros.protocol.presences import SILENCE_S
from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.support.arguments import ArgumentParser, integer
from rhs_isac_ros.support.exits import exit_code_of, on_end_signals
from rhs_isac_ros.tools.demo import add_network_options, load_files, start_network
from system import invariants
from system.hosts import namespaces
from system.hosts.namespaces import HOSTS, NamespacesUnavailable
from system.observer import RECOVERY_LIMIT_S, NetworkObserver
from system.trial_processes import TrialProcesses

# Exit code of a skipped test, as test drivers define it.
SKIPPED = 77
# Nodes that wait for a node of the disconnected host.
WAITING: dict[str, tuple[str, ...]] = {
    'base_station': ('user',), 'surface': ('bs',), 'channel': ('bs', 'user'),
    'positioner': ('bs',), 'users': ()}
# Time until a node reports that it is waiting [s]: 3 s after bs misses announcements, or after
# Fast DDS removes an unreachable node from the graph, on which users rely.
_REPORTED_AFTER_S = {'bs': SILENCE_S + 3.0, 'user': 23.0}
# Time within which messages that were sent before an outage arrive [s].
_IN_FLIGHT_S = 0.2
# Maximum time until cycles are served before an outage, and after it [s]; on a busy machine, the
# start of the nodes takes long.
_BEFORE_S, _AFTER_S = 240.0, 60.0


def evaluate(
        host: str, down_s: float, restored_s: float, cycles: Sequence[CycleTimes],
        logs: Mapping[str, str], warnings: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Return the figures of an outage of a host, from its start and end [s] and complete cycles.

    `logs` and `warnings` contain the log of each node, and the warnings in its diagnostics, during
    the outage.
    """
    spans_s = [(cycle.began_s, cycle.ended_s) for cycle in cycles]
    awaited = {node: collections.Counter(
        line.partition('waiting for ')[2] for line in log.splitlines() if 'waiting for ' in line)
        for node, log in logs.items()}
    required = [kind for kind in WAITING[host] if restored_s - down_s >= _REPORTED_AFTER_S[kind]]
    # Until the end of the first cycle that began after the restoration.
    recovery_s = min((end - restored_s for begin, end in spans_s if begin >= restored_s),
                     default=None)
    faults = {
        # Cycles that have bypassed the link: a cycle needs all hosts.
        'during': sum(
            down_s + _IN_FLIGHT_S <= begin and end < restored_s for begin, end in spans_s),
        # Nodes whose log or diagnostics lack the required report of a missing node, and nodes that
        # logged more than once that they wait for the same node.
        'unreported': [
            node for node in logs if node.partition('_')[0] in required and not (awaited[node]
            and any(text.startswith('waiting for ') for text in warnings.get(node, ())))],
        'repeated': [node for node, counts in awaited.items()
                     if max(counts.values(), default=0) > 1]}
    in_time = recovery_s is not None and recovery_s <= RECOVERY_LIMIT_S
    return {'host': host, 'outage_s': restored_s - down_s, 'recovery_s': recovery_s, **faults,
            'passed': in_time and not any(faults.values())}


def observe(processes: Processes, observer: NetworkObserver, seconds: float,
            cycles: int = sys.maxsize) -> bool:
    """Observe for a time [s], or until a number of cycles have begun and been served.

    Returns whether they were served. If a node ends, the command ends, too.
    """
    begin_s = time.monotonic()

    def served() -> bool:
        for node, code in processes.ended().items():
            sys.exit(f'{node} ended with exit code {code}:\n{processes.log(node)}')
        return sum(one.began_s >= begin_s for one in observer.log.complete[-cycles:]) == cycles
    return observer.spin_until(served, seconds)


def interrupt(processes: Processes, observer: NetworkObserver, host: str, seconds: float
              ) -> dict[str, Any]:
    """Take a link down for a time [s], restore it, and wait until cycles are served again."""
    log_lengths = {node: len(processes.log(node)) for node in processes.names}
    observer.warnings.clear()
    namespaces.connect(host, up=False)
    down_s = time.monotonic()
    observe(processes, observer, seconds)
    logs = {node: processes.log(node)[n:] for node, n in log_lengths.items()}
    warnings = {node: tuple(texts) for node, texts in observer.warnings.items()}
    restored_s = time.monotonic()
    observer.invariants.expect_rediscovery(invariants.RECEIVES)
    namespaces.connect(host, up=True)
    observe(processes, observer, _AFTER_S, 3)
    return evaluate(host, down_s, restored_s, observer.log.complete, logs, warnings)


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0 if all outages passed, otherwise 1; 77 without namespaces; 130 after Ctrl-C."""
    parser = ArgumentParser(
        prog='scripts/hosts', description='Run the network on several hosts, which are network '
        'namespaces of this machine, and take their links down: cycles must be served again '
        f'within {RECOVERY_LIMIT_S:g} s after a link is restored. Needs root; exits with '
        f'{SKIPPED} without network namespaces.')
    parser.add_argument('--pull', nargs='+', choices=list(HOSTS), default=list(HOSTS),
                        metavar='NAME', help=f'hosts to disconnect, out of {", ".join(HOSTS)}')
    parser.add_argument('--seconds', type=integer(1, 3600), default=6,
                        help='duration of each outage, by default 6')
    add_network_options(parser)
    parser.add_argument('--usual-discovery', action='store_true',
                        help="use Fast DDS's default settings instead of the package's profile")
    options = parser.parse_args(arguments)
    try:
        return _run(options, *load_files(options.config, options.codebook))
    except NamespacesUnavailable as error:
        print(f'hosts: skipped: no network namespaces: {error}', file=sys.stderr)
        return SKIPPED
    except KeyboardInterrupt:
        return 130


def _run(options: argparse.Namespace, scenario: Scenario, codebook_file: Path) -> int:
    """Interrupt the links in turn, and print the figures."""
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    os.environ.update({
        'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp',
        # The hosts belong to this run alone.
        'ROS_DOMAIN_ID': '0',
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
        # The namespaces share memory, which would bypass the links.
        'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
        # An empty value keeps nodes from loading the profile of the package.
        'FASTRTPS_DEFAULT_PROFILES_FILE': '' if options.usual_discovery else
        f'{get_package_share_directory("rhs_isac_ros")}/config/discovery.xml',
    })
    with namespaces.connected_hosts(), \
            tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs, TrialProcesses(
                Path(logs), {'ROS_LOG_DIR': logs}, namespaces.command_prefix) as processes:
        print('hosts created', file=sys.stderr, flush=True)
        start_network(processes, 2, scenario, first_cycle=1, seed=options.seed,
                      scenario_file=options.config, codebook_file=codebook_file)
        namespaces.enter(namespaces.OBSERVER)
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        observer = NetworkObserver(scenario)
        try:
            outages = []
            for host in options.pull:
                if not observe(processes, observer, _BEFORE_S, 3):
                    sys.exit(f'no cycles within {_BEFORE_S:g} s:\n{processes.log("bs")}')
                outages.append(interrupt(processes, observer, host, options.seconds))
            # The last results are checked after the settling time.
            observer.spin_for(invariants.CHECK_DELAY_S)
        finally:
            observer.destroy_node()
            rclpy.try_shutdown()
    violations = observer.invariants.violations
    passed = not violations and all(outage['passed'] for outage in outages)
    print(json.dumps({
        'outages': outages, 'wrong_publications': len(violations), 'violations': violations,
        'passed': passed}, indent=1, allow_nan=False))
    return 0 if passed else 1


def _interrupted(number: int, frame: object) -> None:
    """Treat a signal like Ctrl-C, and ignore further ones."""
    on_end_signals(signal.SIG_IGN)
    raise KeyboardInterrupt


if __name__ == '__main__':
    on_end_signals(_interrupted)
    sys.exit(exit_code_of(main, (ScenarioError, CodebookError)))
