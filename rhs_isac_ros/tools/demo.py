"""The executable ``demo``: the whole network as processes, watched for some cycles."""

import argparse
import dataclasses
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException

from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.protocol.impairments import Impairments
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.processes import Processes, private_domain
from rhs_isac_ros.ros.recording import Recorder, RecordingError
from rhs_isac_ros.ros.resources import default_codebook_file
from rhs_isac_ros.ros.run import use_discovery_profile
from rhs_isac_ros.tools.demo_report import draw, summary, table

# Without a new cycle for this long, something is broken.
_PATIENCE_S = 60.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo.

    Parameters
    ----------
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code: 0 if every cycle was served, also after Ctrl-C; 1 if one was not; 2 if an
        argument or a file is wrong.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    check_directory(parser, '--picture', options.picture)
    try:
        scenario, codebook_file = load_files(options.config, options.codebook)
    except (ScenarioError, CodebookError) as error:
        print(f'error: {error}\nA codebook for a scenario is made by: python -m '
              'rhs_isac_ros.codebook --scenario FILE --output FILE', file=sys.stderr)
        return 2
    try:
        recorder = Recorder(options.record, scenario) if options.record else None
    except RecordingError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    os.environ.update(private_domain())
    use_discovery_profile()
    rclpy.init(args=[])
    observer = CycleObserver(recorder)
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        processes = Processes(Path(logs), {'ROS_LOG_DIR': logs})
        try:
            with processes:
                start_network(processes, options.users, options.seed, options.config,
                              codebook_file, scenario)
                problem = watch(observer, processes, options.cycles, _progress)
        except (KeyboardInterrupt, ExternalShutdownException):
            problem = ''
        finally:
            observer.destroy_node()
            rclpy.try_shutdown()
            if recorder is not None:
                recorder.close()
    try:
        return _report(observer, scenario, options, problem)
    except KeyboardInterrupt:
        return 0


def load_files(config: Path | None, codebook: Path | None) -> tuple[Scenario, Path]:
    """Read a scenario, and see whether a codebook fits it.

    Parameters
    ----------
    config
        File of the scenario, or None for Table I.
    codebook
        File of the codebook, or None for the package's.

    Returns
    -------
    tuple of Scenario and pathlib.Path
        The scenario, and where the codebook lies.

    Raises
    ------
    ScenarioError
        If the scenario file is wrong.
    CodebookError
        If the codebook file is wrong, or does not fit.
    """
    scenario = Scenario.from_yaml(config) if config else Scenario()
    codebook_file = Path(codebook or default_codebook_file()).resolve()
    Codebook.load(codebook_file).check(scenario)
    return scenario, codebook_file


def check_directory(parser: argparse.ArgumentParser, argument: str, file: Path | None) -> None:
    """End with a usage error if a file could not be written at the end of a run.

    Parameters
    ----------
    parser
        The parser of the command line.
    argument
        Name of the argument.
    file
        Its value; None if it was not given.
    """
    if file and not file.resolve().parent.is_dir():
        parser.error(f'argument {argument}: {file}, expected a file in a directory that exists')


def start_network(
        processes: Processes, users: int, seed: int, scenario_file: Path | None,
        codebook_file: Path, scenario: Scenario, rest_s: float = 0.1, first_cycle: int = 1,
        impairments: Impairments | None = None) -> None:
    """Start every node as a process of its own.

    Parameters
    ----------
    processes
        Starts and ends them.
    users
        How many users, numbered from 1, which walk at random at the highest speed.
    seed
        Seed of all random numbers.
    scenario_file
        File of the scenario, or None for Table I.
    codebook_file
        File of the codebook.
    scenario
        The scenario itself.
    rest_s
        Pause between cycles [s].
    first_cycle
        Number of the first cycle. With numbers from 1, a seed gives the same cycles again; 0, for
        a base station that is started anew: numbers from the clock.
    impairments
        What the air does to signals and packets; by default nothing.
    """
    common = {'scenario_file': Path(scenario_file).resolve()} if scenario_file else {}
    for executable in ('rhs_controller', 'positioner', 'transmission'):
        processes.start(executable, **common)
    processes.start('optimizer', codebook_file=codebook_file, **common)
    air = dataclasses.asdict(impairments or Impairments())
    processes.start('channel', seed=seed, **air, **common)
    for user in range(1, users + 1):
        processes.start('user', f'user_{user}', user_id=user, seed=seed, mobility='random_walk',
                        speed_mps=scenario.max_user_speed_mps, **common)
    processes.start('bs', seed=seed, rest_s=rest_s, first_cycle=first_cycle, **common)


def watch(
        observer: CycleObserver, processes: Processes, cycles: int,
        progress: Callable[[int, int], None]) -> str:
    """Spin an observer until it has seen enough cycles.

    Parameters
    ----------
    observer
        The observer.
    processes
        The network.
    cycles
        How many complete cycles to wait for.
    progress
        Called with the number of complete cycles and the goal, whenever the first changes.

    Returns
    -------
    str
        What went wrong, or nothing.
    """
    seen, changed_s = -1, time.monotonic()
    while seen < cycles:
        rclpy.spin_once(observer, timeout_sec=0.5)
        complete = len(observer.log.complete)
        if complete != seen:
            seen, changed_s = complete, time.monotonic()
            progress(complete, cycles)
        for name, code in processes.ended().items():
            return f'{name} ended with exit code {code}:\n{processes.log(name)}'
        if time.monotonic() - changed_s > _PATIENCE_S:
            return f'no cycle for {_PATIENCE_S:.0f} s; the base station says:\n' + (
                processes.log('bs'))
    return ''


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='demo', description='Start the network, every node as a process, and report on '
        'its cycles.', formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--users', type=_positive, default=2, help='number of users')
    parser.add_argument('--cycles', type=_positive, default=20, help='cycles to wait for')
    parser.add_argument('--seed', type=_not_negative, default=0, help='seed of all random numbers')
    parser.add_argument('--config', type=Path, help="scenario file; the paper's Table I if none")
    parser.add_argument('--codebook', type=Path, help="codebook file; the package's if none")
    parser.add_argument('--record', type=Path, metavar='FILE', help='recording to write (MCAP)')
    parser.add_argument('--picture', type=Path, default=Path('demo.png'), help='file to draw')
    return parser


def _positive(text: str) -> int:
    if int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text}, expected at least 1')
    return int(text)


def _not_negative(text: str) -> int:
    if int(text) < 0:
        raise argparse.ArgumentTypeError(f'{text}, expected at least 0')
    return int(text)


def _progress(seen: int, goal: int) -> None:
    if seen == 0:
        print(f'network started with ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}, '
              'waiting for the first cycle', file=sys.stderr)
    elif sys.stderr.isatty():
        print(f'\rcycle {seen} of {goal}', end='\n' if seen >= goal else '', file=sys.stderr,
              flush=True)
    elif seen % 10 == 0 or seen >= goal:
        print(f'cycle {seen} of {goal}', file=sys.stderr)


def _report(
        observer: CycleObserver, scenario: Scenario, options: argparse.Namespace, problem: str
) -> int:
    complete, given_up = observer.log.complete, observer.log.given_up
    if complete:
        print(table(complete))
        print(summary(complete, given_up))
        draw(complete, scenario, options.picture)
        print(f'picture: {options.picture}')
    if options.record:
        print(f'recording: {options.record}')
    if problem:
        print(f'error: {problem}', file=sys.stderr)
    return 1 if problem or given_up else 0


if __name__ == '__main__':
    sys.exit(main())
