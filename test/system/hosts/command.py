"""Runs the network on several hosts, pulls the link of one after the other, and reports."""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.monitoring import invariants
from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.ros.resources import discovery_profile_file
from rhs_isac_ros.tools.demo import check_directory, load_files, start_network
from system.hosts import plan
from system.hosts.namespaces import Hosts, NamespacesRefused, guarded
from system.hosts.observer import HostsObserver
from system.hosts.verdict import PROMISE_S, Pull, figures, judge, table

# Exit code of what could not be tried, as test drivers know it.
SKIPPED = 77
# Without a cycle for this long at the start, something is broken [s].
_PATIENCE_S = 60.0
# How long the network is watched before a pull at most, and after one at most [s].
_CALM_S = 5.0
_WATCH_S = 20.0
# A node notices that another one is gone this long after the lease at the latest [s].
_NOTICE_S = 3.0


class NetworkBroken(RuntimeError):
    """A node has ended, or no cycle is served."""


class Trial:
    """A network on several hosts, watched while links are pulled.

    Parameters
    ----------
    hosts
        The hosts.
    processes
        The nodes.
    observer
        Watches them.
    lease_s
        After how long a silent participant is taken for gone [s].
    """

    def __init__(
            self, hosts: Hosts, processes: Processes, observer: HostsObserver, lease_s: float
    ) -> None:
        self._hosts, self._processes, self._observer = hosts, processes, observer
        self._lease_s = lease_s

    def wait_until_served(self) -> None:
        """Wait until cycles are served.

        Raises
        ------
        NetworkBroken
            If a node ends or there are none.
        """
        self._spin(_PATIENCE_S, 3)
        if not self._observer.log.complete:
            raise NetworkBroken(f'no cycle for {_PATIENCE_S:.0f} s; the base station says:\n'
                                f'{self._processes.log("bs")}')

    def pull(self, host: str, seconds: float) -> Pull:
        """Pull the link of a host, put it back, and watch until cycles are served again.

        Parameters
        ----------
        host
            Name of the host.
        seconds
            For how long [s].

        Returns
        -------
        Pull
            The verdict.

        Raises
        ------
        NetworkBroken
            If a node ends.
        """
        marks_s = [time.monotonic()]
        self._spin(min(seconds, _CALM_S))
        sizes = {node: len(self._processes.log(node)) for node in self._processes.names}
        self._observer.warnings.clear()
        self._hosts.pull(host)
        marks_s.append(time.monotonic())
        self._spin(seconds)
        said = {node: self._processes.log(node)[size:] for node, size in sizes.items()}
        warnings = {node: tuple(texts) for node, texts in self._observer.warnings.items()}
        marks_s.append(time.monotonic())
        # Others may find those behind the link again before this observer does.
        self._observer.promises.expect_silence(invariants.RECEIVES)
        self._hosts.put_back(host)
        self._spin(_WATCH_S, 3)
        marks_s.append(time.monotonic())
        kinds = plan.WAITERS[host] if seconds >= self._lease_s + _NOTICE_S else ()
        return judge(
            host, marks_s, self._observer.log.complete, said, warnings,
            [node for node in sizes if node.partition('_')[0] in kinds])

    def settle(self) -> None:
        """Watch until all that is still on its way has come."""
        self._spin(invariants.SETTLE_S)

    def _spin(self, seconds: float, cycles: int = 0) -> None:
        """Watch for a time, or until that many more cycles began and were served."""
        begin_s = time.monotonic()
        while (left_s := begin_s + seconds - time.monotonic()) > 0:
            rclpy.spin_once(self._observer, timeout_sec=min(left_s, 0.1))
            for node, code in self._processes.ended().items():
                raise NetworkBroken(
                    f'{node} ended with exit code {code}:\n{self._processes.log(node)}')
            fresh = [c for c in self._observer.log.complete[-cycles:] if c.began_s >= begin_s]
            if cycles and len(fresh) == cycles:
                return


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code: 0 if all went as promised; 1 if not; 2 if an argument or a file is wrong; 77
        if network namespaces are not allowed; 130 after Ctrl-C or SIGTERM.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    check_directory(parser, '--json', options.json)
    try:
        scenario, codebook_file = load_files(options.config, options.codebook)
    except (ScenarioError, CodebookError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    profile = None if options.usual_discovery else discovery_profile_file()
    try:
        return guarded(lambda: _try(options, scenario, codebook_file, profile))
    except NamespacesRefused as error:
        print(f'hosts: skipped: no network namespaces: {error}', file=sys.stderr)
        return SKIPPED
    except NetworkBroken as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _try(
        options: argparse.Namespace, scenario: Scenario, codebook_file: Path,
        profile: Path | None) -> int:
    _set_environment(profile, options.static_peers)
    with Hosts() as hosts, tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs, \
            Processes(Path(logs), {'ROS_LOG_DIR': logs}, hosts.inside) as processes:
        start_network(processes, options.users, options.seed, options.config, codebook_file,
                      scenario)
        hosts.enter(plan.OBSERVER)
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        observer = HostsObserver(scenario)
        try:
            trial = Trial(hosts, processes, observer, plan.lease_s(profile))
            trial.wait_until_served()
            pulls = []
            for host in options.pull or plan.HOSTS:
                _say(f'pulling {host} for {options.seconds:g} s')
                pulls.append(trial.pull(host, options.seconds))
            trial.settle()
            packets = hosts.packets()
        finally:
            observer.destroy_node()
            rclpy.try_shutdown()
    return _report(pulls, observer, packets, options.json)


def _set_environment(profile: Path | None, static_peers: bool) -> None:
    """Set what this process and all nodes need to know of the network."""
    for name in ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'):
        os.environ.pop(name, None)
    os.environ.update({
        'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp',
        # Nobody else is on these hosts.
        'ROS_DOMAIN_ID': '0',
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
        # The hosts have one memory: nothing may go through it.
        'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
    })
    if static_peers:
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        os.environ['ROS_STATIC_PEERS'] = ';'.join(plan.addresses().values())
    # Without a value, nodes would take the profile of the package by themselves.
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(profile or '')


def _report(
        pulls: Sequence[Pull], observer: HostsObserver, packets: dict[str, int],
        file: Path | None) -> int:
    wrong = observer.promises.broken
    print(table(pulls))
    print(f'{len(observer.log.complete)} cycles served, {len(observer.log.given_up)} given up, '
          f'{len(wrong)} wrong publications')
    print('packets sent: ' + ', '.join(f'{host} {n}' for host, n in packets.items()))
    for text in wrong:
        print(f'wrong: {text}')
    good = not wrong and all(pull.holds for pull in pulls)
    if file is not None:
        write_whole(file, json.dumps({
            **figures(pulls), 'wrong_publications': len(wrong), 'wrong': wrong,
            'cycles_served': len(observer.log.complete),
            'cycles_given_up': len(observer.log.given_up),
            'packets': packets, 'passed': good}, indent=1) + '\n')
    return 0 if good else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='scripts/hosts', formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Run the network on several hosts of this machine, which are network '
        f'namespaces, and pull their links: cycles must be served again within {PROMISE_S:g} s. '
        f'Needs root; exits with {SKIPPED} where namespaces are not allowed.')
    parser.add_argument('--pull', action='append', choices=list(plan.HOSTS), metavar='NAME',
                        help=f'host to cut off: {", ".join(plan.HOSTS)}; may be repeated; each '
                        'in turn if none')
    parser.add_argument('--seconds', type=_positive, default=6.0, help='for how long')
    parser.add_argument('--users', type=int, choices=range(1, 65), metavar='N', default=2,
                        help='number of users')
    parser.add_argument('--seed', type=int, default=0, help='seed of all random numbers')
    parser.add_argument('--config', type=Path, help="scenario file; the paper's Table I if none")
    parser.add_argument('--codebook', type=Path, help="codebook file; the package's if none")
    parser.add_argument('--usual-discovery', action='store_true',
                        help='as Fast DDS comes, without the profile of the package')
    parser.add_argument('--static-peers', action='store_true',
                        help='find each other by addresses, without multicast')
    parser.add_argument('--json', type=Path, metavar='PATH', help='file for all figures')
    return parser


def _positive(text: str) -> float:
    if not 0 < float(text) <= 3600:
        raise argparse.ArgumentTypeError(f'{text}, expected more than 0 s and at most 3600 s')
    return float(text)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
