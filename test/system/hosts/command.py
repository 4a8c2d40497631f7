"""The command line of ``scripts/hosts``."""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.executables import print_error
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.ros.startup import discovery_profile_file
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    check_distinct,
    integer,
    output_file,
    positive_float,
)
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.tools.demo import (
    add_network_options,
    load_files,
    max_user_processes,
    start_network,
)
from system.hosts import plan
from system.hosts.namespaces import Hosts, NamespacesUnavailable, interruptible
from system.hosts.trial import NetworkBroken, Trial
from system.hosts.verdict import Outage, figures, table
from system.observer import NetworkObserver
from system.recovery import RECOVERY_LIMIT_S
from system.trial_processes import TrialProcesses

# Exit code of a skipped test, as test drivers define it.
SKIPPED = 77


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments
        Command line; by default that of the process.

    Returns
    -------
    int
        Exit code: 0 if all outages passed, otherwise 1; 2 if an argument or a file is invalid; 77
        if network namespaces are unavailable; 130 after Ctrl-C or SIGTERM.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    check_distinct(parser, options)
    try:
        scenario, codebook_file = load_files(options.config, options.codebook)
    except (ScenarioError, CodebookError) as error:
        print_error(error, parser.prog)
        return 2
    profile = None if options.usual_discovery else discovery_profile_file()
    try:
        return interruptible(lambda: _run(options, scenario, codebook_file, profile))
    except NamespacesUnavailable as error:
        print(f'hosts: skipped: no network namespaces: {error}', file=sys.stderr)
        return SKIPPED
    except NetworkBroken as error:
        print_error(error, parser.prog)
        return 1
    except KeyboardInterrupt:
        return 130


def _run(
        options: argparse.Namespace, scenario: Scenario, codebook_file: Path,
        profile: Path | None) -> int:
    _set_environment(profile, options.static_peers)
    with Hosts() as hosts, tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs, \
            TrialProcesses(Path(logs), {'ROS_LOG_DIR': logs}, hosts.command_prefix) as processes:
        start_network(processes, options.users, scenario, first_cycle=1, seed=options.seed,
                      scenario_file=options.config, codebook_file=codebook_file)
        hosts.enter(plan.OBSERVER)
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        observer = NetworkObserver(scenario)
        try:
            trial = Trial(hosts, processes, observer)
            trial.wait_until_served()
            outages = []
            for host in options.pull or plan.HOSTS:
                print(f'taking the link of {host} down for {options.seconds:g} s',
                      file=sys.stderr, flush=True)
                outages.append(trial.interrupt(host, options.seconds))
            trial.settle()
            packets = hosts.packets()
        finally:
            observer.destroy_node()
            rclpy.try_shutdown()
    return _report(outages, observer, packets, options.json)


def _set_environment(profile: Path | None, static_peers: bool) -> None:
    """Set the environment variables of ROS 2 and Fast DDS for this process and all nodes."""
    for name in ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'):
        os.environ.pop(name, None)
    os.environ.update({
        'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp',
        # The hosts belong to this run alone.
        'ROS_DOMAIN_ID': '0',
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
        # The namespaces share memory, which would bypass the links.
        'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
    })
    if static_peers:
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        os.environ['ROS_STATIC_PEERS'] = ';'.join(plan.addresses().values())
    # An empty value keeps nodes from loading the profile of the package.
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(profile or '')


def _report(
        outages: Sequence[Outage], observer: NetworkObserver, packets: dict[str, int],
        file: Path | None) -> int:
    violations, log = observer.invariants.violations, observer.log
    print(table(outages))
    print(f'{len(log.complete)} cycles served, {len(log.given_up)} given up, '
          f'{len(violations)} wrong publications')
    print('packets sent: ' + ', '.join(f'{host} {n}' for host, n in packets.items()))
    for text in violations:
        print(f'wrong: {text}')
    passed = not violations and all(outage.passed for outage in outages)
    if file is not None:
        write_whole(file, json.dumps({
            **figures(outages), 'wrong_publications': len(violations), 'violations': violations,
            'cycles_served': len(log.complete), 'cycles_given_up': len(log.given_up),
            'packets': packets, 'passed': passed}, indent=1) + '\n')
    return 0 if passed else 1


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='scripts/hosts', formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Run the network on several hosts of this machine, which are network '
        'namespaces, and take their links down: cycles must be served again within '
        f'{RECOVERY_LIMIT_S:g} s after a link is restored. Needs root; exits with {SKIPPED} if '
        'network namespaces are unavailable.')
    parser.add_argument('--pull', action='append', choices=list(plan.HOSTS), metavar='NAME',
                        help=f'host to disconnect: {", ".join(plan.HOSTS)}; may be repeated; by '
                        'default, each host in turn')
    parser.add_argument('--seconds', type=_positive, default=6.0,
                        help='duration of each outage')
    parser.add_argument('--users', type=integer(1, min(64, max_user_processes())), metavar='N',
                        default=2, help='number of users, each in its own process')
    add_network_options(parser)
    parser.add_argument('--usual-discovery', action='store_true',
                        help="use Fast DDS's default settings instead of the package's profile")
    parser.add_argument('--static-peers', action='store_true',
                        help='discover nodes by their addresses, without multicast')
    parser.add_argument('--json', type=output_file, metavar='PATH',
                        help='JSON file for the results')
    return parser


def _positive(text: str) -> float:
    seconds = positive_float(text)
    if seconds > 3600:
        raise argparse.ArgumentTypeError(f'{text}, expected at most 3600 s')
    return seconds
