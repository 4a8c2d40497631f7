"""The command line of ``scripts/hosts``."""

import argparse
import json
import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import rclpy
from ament_index_python.packages import get_package_share_directory
from rclpy.signals import SignalHandlerOptions

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.support.arguments import ArgumentParser, check_distinct, integer, output_file
from rhs_isac_ros.support.exits import exit_code_of, print_error
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.tools.demo import (
    add_network_options,
    load_files,
    start_network,
)
from system import invariants
from system.hosts import namespaces
from system.hosts.namespaces import HOSTS, NamespacesUnavailable
from system.hosts.trial import NetworkBroken, Outage, Trial
from system.observer import NetworkObserver
from system.recovery import RECOVERY_LIMIT_S
from system.trial_processes import TrialProcesses

# Exit code of a skipped test, as test drivers define it.
SKIPPED = 77


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command, and return its exit code.

    It is 0 if all outages passed, otherwise 1; 2 if an argument or a file is invalid; 77 if
    network namespaces are unavailable; 130 after Ctrl-C or SIGTERM.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    check_distinct(parser, options)
    try:
        return _run(options, *load_files(options.config, options.codebook))
    except NamespacesUnavailable as error:
        print(f'hosts: skipped: no network namespaces: {error}', file=sys.stderr)
        return SKIPPED
    except (ScenarioError, CodebookError, NetworkBroken) as error:
        print_error(error, parser.prog)
        return 1 if isinstance(error, NetworkBroken) else 2
    except KeyboardInterrupt:
        return 130


def _run(options: argparse.Namespace, scenario: Scenario, codebook_file: Path) -> int:
    profile = None if options.usual_discovery else (
        Path(get_package_share_directory('rhs_isac_ros')) / 'config' / 'discovery.xml')
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    os.environ.update({
        'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp',
        # The hosts belong to this run alone.
        'ROS_DOMAIN_ID': '0',
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST' if options.static_peers else 'SUBNET',
        'ROS_STATIC_PEERS': ';'.join(namespaces.ADDRESSES.values()) * options.static_peers,
        # The namespaces share memory, which would bypass the links.
        'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
        # An empty value keeps nodes from loading the profile of the package.
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile or ''),
    })
    with namespaces.connected_hosts(), \
            tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs, TrialProcesses(
                Path(logs), {'ROS_LOG_DIR': logs}, namespaces.command_prefix) as processes:
        start_network(processes, options.users, scenario, first_cycle=1, seed=options.seed,
                      scenario_file=options.config, codebook_file=codebook_file)
        namespaces.enter(namespaces.OBSERVER)
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        observer = NetworkObserver(scenario)
        try:
            trial = Trial(processes, observer)
            trial.wait_until_served()
            outages = []
            for host in options.pull or namespaces.HOSTS:
                print(f'taking the link of {host} down for {options.seconds:g} s',
                      file=sys.stderr, flush=True)
                outages.append(trial.interrupt(host, options.seconds))
            # The last results are checked after the settling time.
            observer.spin_for(invariants.CHECK_DELAY_S)
            return _report(outages, observer, namespaces.packets(), options.json)
        finally:
            observer.destroy_node()
            rclpy.try_shutdown()


def _report(
        outages: Sequence[Outage], observer: NetworkObserver, packets: dict[str, int],
        file: Path | None) -> int:
    violations, log = observer.invariants.violations, observer.log
    passed = not violations and all(outage.passed for outage in outages)
    text = json.dumps({
        'outages': [outage.figures() for outage in outages],
        'wrong_publications': len(violations), 'violations': violations,
        'cycles_served': len(log.complete), 'cycles_given_up': len(log.given_up),
        'packets': packets, 'passed': passed}, indent=1, allow_nan=False)
    print(text)
    if file is not None:
        write_whole(file, text + '\n')
    return 0 if passed else 1


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='scripts/hosts', formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Run the network on several hosts of this machine, which are network '
        'namespaces, and take their links down: cycles must be served again within '
        f'{RECOVERY_LIMIT_S:g} s after a link is restored. Needs root; exits with {SKIPPED} if '
        'network namespaces are unavailable.')
    parser.add_argument('--pull', action='append', choices=list(HOSTS), metavar='NAME',
                        help=f'host to disconnect: {", ".join(HOSTS)}; may be repeated; by '
                        'default, each host in turn')
    parser.add_argument('--seconds', type=integer(1, 3600), default=6,
                        help='duration of each outage')
    parser.add_argument('--users', type=integer(1, 64), metavar='N',
                        default=2, help='number of users, each in its own process')
    add_network_options(parser)
    parser.add_argument('--usual-discovery', action='store_true',
                        help="use Fast DDS's default settings instead of the package's profile")
    parser.add_argument('--static-peers', action='store_true',
                        help='discover nodes by their addresses, without multicast')
    parser.add_argument('--json', type=output_file, metavar='PATH',
                        help='JSON file for the results')
    return parser


def interrupt_on_signals() -> None:
    """Treat SIGTERM and SIGHUP like Ctrl-C, and ignore signals after the first: see `main`."""
    def interrupt(number: int, frame: object) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    for each in numbers:
        signal.signal(each, interrupt)


if __name__ == '__main__':
    interrupt_on_signals()
    sys.exit(exit_code_of(main))
