"""The executable ``demo``: runs a whole network as processes and reports on its cycles."""

import argparse
import contextlib
import dataclasses
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import try_shutdown

from rhs_isac_ros.codebook import Codebook, CodebookError, default_codebook_file
from rhs_isac_ros.executables import exit_code_of, print_error
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.model.arguments import (
    ArgumentParser,
    check_distinct,
    input_file,
    integer,
    output_file,
    picture_file,
    positive_int,
    seed,
)
from rhs_isac_ros.monitoring.cycle_log import CycleLog
from rhs_isac_ros.protocol.impairments import Impairments
from rhs_isac_ros.protocol.settings import PRIORS, REGION
from rhs_isac_ros.protocol.user_scheduler import MAX_USERS
from rhs_isac_ros.ros.command_line import check_domain
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.processes import (
    MAX_USER_NODES,
    Processes,
    max_processes,
    private_domain,
)
from rhs_isac_ros.ros.recording import Recorder, RecordingError
from rhs_isac_ros.ros.run import use_discovery_profile
from rhs_isac_ros.tools.demo_report import draw, prepare_drawing, summary, table

# Maximum time between two complete cycles [s].
_CYCLE_TIMEOUT_S = 60.0
# Processes that are not users.
_N_OTHERS = 6


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demonstration.

    Parameters
    ----------
    arguments
        Command line; by default that of the process.

    Returns
    -------
    int
        Exit code: 0 if every cycle was served or its signals gave no position, including after
        Ctrl-C; 1 if not; 2 if an argument or a file is invalid.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    check_domain(parser)
    together = options.users > min(MAX_USER_NODES, max_user_processes())
    if together:
        print(f'the {options.users} users share one process', file=sys.stderr)
    check_distinct(parser, {'--config': options.config, '--codebook': options.codebook},
                   {'--record': options.record, '--picture': options.picture})
    try:
        scenario, codebook_file = load_files(options.config, options.codebook)
    except ScenarioError as error:
        print_error(error, parser.prog)
        return 2
    except CodebookError as error:
        print_error(f'{error}; to create a codebook for a scenario: python -m '
                    'rhs_isac_ros.codebook --scenario FILE --output FILE', parser.prog)
        return 2
    try:
        recorder = Recorder(options.record, scenario) if options.record else None
    except RecordingError as error:
        print_error(error, parser.prog)
        return 2
    os.environ.update(private_domain())
    use_discovery_profile()
    log = CycleLog()
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        # The log of the cycles is complete when the processes are about to end.
        with Processes(Path(logs), {'ROS_LOG_DIR': logs}) as processes:
            problem = ''
            with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
                start_network(
                    processes, options.users, options.seed, options.config, codebook_file,
                    scenario, together=together,
                    positioner=positioner_parameters(options.prior, scenario))
                problem = _observe(log, processes, recorder, options.cycles)
            processes.interrupt()
            with contextlib.suppress(KeyboardInterrupt):
                return _report(log, scenario, options, problem)
    return 0


def _observe(
        log: CycleLog, processes: Processes, recorder: Recorder | None, cycles: int) -> str:
    """Observe a number of cycles, and return the error that ended them; empty if none did."""
    # The network needs a moment to start.
    prepare_drawing()
    rclpy.init(args=[])
    observer = CycleObserver(recorder, log=log)
    try:
        return watch(observer, processes, cycles, _show_progress)
    finally:
        observer.destroy_node()  # type: ignore[no-untyped-call]
        try_shutdown()
        if recorder is not None:
            recorder.close()


def add_network_options(parser: argparse.ArgumentParser) -> None:
    """Add the seed and the files of a network to the options of a command."""
    parser.add_argument('--seed', type=seed, default=0, help='seed of all random numbers')
    parser.add_argument('--config', type=input_file, metavar='FILE',
                        help="scenario file; by default the paper's Table I")
    parser.add_argument('--codebook', type=input_file, metavar='FILE',
                        help='codebook file; by default that of the package')


def positioner_parameters(prior: str, scenario: Scenario) -> dict[str, Any]:
    """Return the parameters of the positioner for users that move at the maximum speed."""
    if prior == REGION:
        return {}
    # The parameter does not admit 0.
    return {'prior': prior, 'track_speed_mps': max(scenario.max_user_speed_mps, 0.01)}


def check_users(parser: argparse.ArgumentParser, users: int) -> None:
    """Exit with a usage error if a process for each user would overload this machine."""
    limit = max_user_processes()
    if users > limit:
        parser.error(f'argument --users: {users}, expected at most {limit} on this machine, '
                     'because each user is a process')


def max_user_processes() -> int:
    """Return the number of users that this machine can run as processes of their own."""
    return max_processes() - _N_OTHERS


def load_files(config: Path | None, codebook: Path | None) -> tuple[Scenario, Path]:
    """Load a scenario, and check that a codebook matches it.

    Parameters
    ----------
    config
        Scenario file; None for the paper's Table I.
    codebook
        Codebook file; None for that of the package.

    Returns
    -------
    tuple of Scenario and pathlib.Path
        The scenario, and the absolute path of the codebook file.

    Raises
    ------
    ScenarioError
        If the scenario file is invalid.
    CodebookError
        If the codebook file is invalid, or does not match the scenario.
    """
    scenario = Scenario.from_yaml(config) if config else Scenario()
    codebook_file = Path(codebook or default_codebook_file()).resolve()
    Codebook.load(codebook_file).check(scenario)
    return scenario, codebook_file


def start_network(
        processes: Processes, users: int, seed: int, scenario_file: Path | None,
        codebook_file: Path, scenario: Scenario, rest_s: float = 0.1, first_cycle: int = 1,
        impairments: Impairments | None = None, together: bool = False,
        positioner: Mapping[str, Any] | None = None) -> None:
    """Start each node of a network in a process of its own.

    Parameters
    ----------
    users
        Number of users; they walk at random at the scenario's maximum speed.
    seed
        Seed of all random numbers.
    scenario_file
        File of `scenario`; None for the paper's Table I.
    rest_s
        Pause between cycles [s].
    first_cycle
        Number of the first cycle. With 1, cycles are reproducible for a seed; with 0, cycle
        numbers are derived from the clock, so that the base station can be restarted.
    impairments
        Impairments of signals and packets; by default none.
    together
        Whether the users share one node, named ``users``, instead of a node for each.
    positioner
        Further parameters of the positioner.
    """
    common: dict[str, Any] = {}
    if scenario_file:
        common['scenario_file'] = Path(scenario_file).resolve()
    for executable in ('rhs_controller', 'transmission'):
        processes.start(executable, **common)
    processes.start('positioner', **(positioner or {}), **common)
    processes.start('optimizer', codebook_file=codebook_file, **common)
    impaired = dataclasses.asdict(impairments or Impairments())
    processes.start('channel', seed=seed, **impaired, **common)
    nodes = [('users', 1, users)] if together else [
        (f'user_{user}', user, 1) for user in range(1, users + 1)]
    for name, first, count in nodes:
        processes.start('user', name, user_id=first, user_count=count, seed=seed,
                        mobility='random_walk', speed_mps=scenario.max_user_speed_mps, **common)
    processes.start('bs', seed=seed, rest_s=rest_s, first_cycle=first_cycle, **common)


def watch(
        observer: CycleObserver, processes: Processes, cycles: int,
        on_progress: Callable[[int, int], None]) -> str:
    """Spin an observer until it has received enough complete cycles.

    Parameters
    ----------
    cycles
        Number of complete cycles to wait for.
    on_progress
        Called with the number of complete cycles and `cycles` when the former changes.

    Returns
    -------
    str
        Description of the error that ended the wait; empty if there was none.
    """
    seen, changed_s = -1, time.monotonic()
    while seen < cycles:
        rclpy.spin_once(observer, timeout_sec=0.5)
        complete = len(observer.log.complete)
        if complete != seen:
            seen, changed_s = complete, time.monotonic()
            on_progress(complete, cycles)
        for name, code in processes.ended().items():
            return f'{name} ended with exit code {code}:\n{processes.log(name)}'
        if time.monotonic() - changed_s > _CYCLE_TIMEOUT_S:
            return (f'no cycle within {_CYCLE_TIMEOUT_S:.0f} s; log of the base station:\n'
                    f'{processes.log("bs")}')
    return ''


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='demo', description='Start a network, every node as a process, and report on its '
        'cycles.', formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--users', type=integer(1, MAX_USERS), default=2, help='number of users')
    parser.add_argument('--cycles', type=positive_int, default=20, help='cycles to wait for')
    add_network_options(parser)
    parser.add_argument('--prior', choices=PRIORS, default=REGION,
                        help='prior of the positions: the region, or the track of each user')
    parser.add_argument('--record', type=output_file, metavar='FILE',
                        help='recording to write (MCAP)')
    parser.add_argument('--picture', type=picture_file, default='demo.png', metavar='FILE',
                        help='file to draw: PNG, PDF or SVG')
    return parser


def _show_progress(complete: int, goal: int) -> None:
    if complete == 0:
        print(f'network started with ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}, '
              'waiting for the first cycle', file=sys.stderr)
    elif sys.stderr.isatty():
        print(f'\rcycle {complete} of {goal}', end='\n' if complete >= goal else '',
              file=sys.stderr, flush=True)
    elif complete % 10 == 0 or complete >= goal:
        print(f'cycle {complete} of {goal}', file=sys.stderr)


def _report(
        log: CycleLog, scenario: Scenario, options: argparse.Namespace, problem: str) -> int:
    complete, given_up = log.complete, log.given_up
    if complete:
        print(table(complete))
        print(summary(complete, given_up))
        draw(complete, scenario, options.picture)
        print(f'picture: {options.picture}')
    if options.record:
        print(f'recording: {options.record}')
    if problem:
        print_error(problem, 'demo')
    return 1 if problem or log.failed else 0


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
