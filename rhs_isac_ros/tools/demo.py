"""The executable ``demo``: runs a whole network as processes and reports on its cycles."""

import argparse
import contextlib
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import try_shutdown

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.executables import STARTED_S, exit_code_of, print_error
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle, CycleLog, CycleRecord
from rhs_isac_ros.protocol.messages import Phase
from rhs_isac_ros.protocol.settings import PRIORS, REGION
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros.processes import (
    MAX_USER_NODES,
    Processes,
    private_domain,
)
from rhs_isac_ros.ros.recording import CycleObserver, Recorder, RecordingError
from rhs_isac_ros.ros.run import check_domain
from rhs_isac_ros.ros.startup import (
    WITHOUT_SERVICES,
    SecurityError,
    one_line,
    prepare,
    use_discovery_profile,
)
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    check_distinct,
    integer,
    output_file,
    picture_file,
    positive_int,
)
from rhs_isac_ros.tools.pictures import draw_cycles, prepare_drawing
from rhs_isac_ros.tools.process_network import (
    add_network_options,
    load_files,
    max_user_processes,
    positioner_parameters,
    start_network,
    watch,
)

_PHASES = (Phase.BEACONING, Phase.POSITIONING, Phase.ESTIMATING, Phase.TRANSMITTING)


def table(cycles: Sequence[CompleteCycle]) -> str:
    """Return a table with one line for each cycle."""
    head = ('cycle user  true position [m]      estimate [m]           error  '
            '√CRLB   beacon   sound  locate    data   capacity     loss\n'
            '                                                            [m]    '
            '[m]     [ms]    [ms]    [ms]    [ms]   [Mbit/s]      [%]')
    return '\n'.join([head, *(_row(cycle) for cycle in cycles)])


def _row(cycle: CompleteCycle) -> str:
    durations = cycle.durations_s()
    times = ''.join(f'{1e3 * durations.get(phase, math.nan):8.1f}' for phase in _PHASES)
    return (f'{cycle.cycle_id:5d} {cycle.user:4d}  {_coordinates(cycle.truth.position):22s}'
            f' {_coordinates(cycle.estimate.position):22s}{cycle.error_m:6.2f} '
            f'{math.sqrt(cycle.estimate.crlb_m2):6.2f} {times}'
            f' {cycle.capacity.actual_bps / 1e6:10.3f} {cycle.capacity.loss_percent:8.3f}')


def _coordinates(position: np.ndarray) -> str:
    return ' '.join(f'{coordinate:6.2f}' for coordinate in position)


def summary(cycles: Sequence[CompleteCycle], given_up: Sequence[CycleRecord]) -> str:
    """Return statistics of at least one complete cycle, and a line for each that was given up."""
    errors = np.array([cycle.error_m for cycle in cycles])
    bounds = np.sqrt([cycle.estimate.crlb_m2 for cycle in cycles])
    lengths = np.array([cycle.duration_s for cycle in cycles])
    losses = np.array([cycle.capacity.loss_percent for cycle in cycles])
    users = len({cycle.user for cycle in cycles})
    lines = [
        f'{len(cycles)} cycles of {users} users served, {len(given_up)} given up',
        f'position error: median {np.median(errors):.2f} m, root mean square '
        f'{np.sqrt(np.mean(errors**2)):.2f} m; median √CRLB {np.median(bounds):.2f} m',
        f'cycle: median {1e3 * np.nanmedian(lengths):.1f} ms; estimator: median '
        f'{1e3 * np.median([cycle.estimate.latency_s for cycle in cycles]):.1f} ms',
        f'capacity: median {np.median([c.capacity.actual_bps for c in cycles]) / 1e6:.2f} '
        f'Mbit/s; loss: median {np.median(losses):.3f} %, worst {losses.max():.3f} %']
    lines += [f'cycle {record.cycle_id} of user {record.user} given up: {record.outcome}'
              for record in given_up]
    return '\n'.join(lines)


_STAT_FILE = Path('/proc/self/stat')
# Index of the time of the start among the fields that follow the name of the program.
_START_FIELD = 19


def process_age_s() -> float | None:
    """Return the time since the start of this process [s]; None if the system does not provide it.

    A script that ends with ``exec`` is part of the process.
    """
    try:
        # The name of the program, in parentheses, may have spaces.
        fields = _STAT_FILE.read_text(encoding='utf-8').rpartition(')')[2].split()
        started_s = int(fields[_START_FIELD]) / os.sysconf('SC_CLK_TCK')
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - started_s, 0.0)
    except (OSError, ValueError, IndexError, AttributeError):
        return None


class Parts:
    """Consecutive parts of a duration; times are those of `time.monotonic` [s]."""

    def __init__(self, begin_s: float) -> None:
        self._begin_s = self._last_s = begin_s
        self._parts: list[tuple[str, float]] = []

    def end(self, part: str, now_s: float) -> None:
        """End a part, which began at the end of the previous one."""
        self._parts.append((part, now_s - self._last_s))
        self._last_s = now_s

    def text(self) -> str:
        """Return a line with the total and the parts, such as ``time: 2.1 s (first 0.4, ...)``."""
        parts = ', '.join(f'{name} {duration_s:.2f}' for name, duration_s in self._parts)
        return f'time: {self._last_s - self._begin_s:.2f} s ({parts})'


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
        recorder = Recorder(options.record, scenario) if options.record else None
    except CodebookError as error:
        print_error(f'{error}; to create a codebook for a scenario: python3 -m '
                    'rhs_isac_ros.codebook --scenario FILE --output FILE', parser.prog)
        return 2
    except (ScenarioError, RecordingError) as error:
        print_error(error, parser.prog)
        return 2
    os.environ.update(private_domain())
    use_discovery_profile()
    try:
        return _run(scenario, codebook_file, recorder, options, together, _parts())
    except SecurityError as error:
        print_error(error, parser.prog)
        return 2


def _run(
        scenario: Scenario, codebook_file: Path, recorder: Recorder | None,
        options: argparse.Namespace, together: bool, parts: Parts) -> int:
    """Run the network until its cycles are complete, and report on them; return the exit code."""
    log, code = CycleLog(), 0
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        # The log of the cycles is complete when the processes are about to end.
        with Processes(Path(logs), {'ROS_LOG_DIR': logs}) as processes:
            problem = ''
            try:
                with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
                    start_network(
                        processes, options.users, options.seed, options.config, codebook_file,
                        scenario, together=together,
                        positioner=positioner_parameters(options.prior, scenario))
                    problem = _observe(log, processes, recorder, options.cycles, parts)
            finally:
                # Also if a signal arrives before the observer exists.
                if recorder is not None:
                    recorder.close()
            processes.interrupt()
            with contextlib.suppress(KeyboardInterrupt):
                code = _report(log, scenario, options, problem)
    if log.complete:
        parts.end('end', time.monotonic())
        print(parts.text())
    return code


def _parts() -> Parts:
    """Return the parts of the run so far: the scripts, and the imports of this process."""
    now_s, age_s = time.monotonic(), process_age_s()
    if age_s is None:
        parts = Parts(STARTED_S)
    else:
        parts = Parts(now_s - age_s)
        parts.end('environment', STARTED_S)
    parts.end('imports', now_s)
    return parts


def _observe(
        log: CycleLog, processes: Processes, recorder: Recorder | None, cycles: int,
        parts: Parts) -> str:
    """Observe a number of cycles, and return the error that ended them; empty if none did."""
    # The network needs a moment to start.
    prepare_drawing()
    rclpy.init(args=prepare(['demo']))
    with one_line():
        observer = CycleObserver(recorder, log=log, **WITHOUT_SERVICES)
    discovered_s: list[float] = []
    try:
        return watch(observer, processes, cycles, _show_progress,
                     lambda: discovered_s.append(time.monotonic()))
    finally:
        if log.complete:
            begin_s = log.complete[0].began_s
            # On a busy machine, a cycle may end before this process has discovered all nodes.
            parts.end('start and discovery of the nodes', min([*discovered_s, begin_s]))
            parts.end('codebook and tables', begin_s)
            parts.end('cycles', log.complete[-1].ended_s)
        observer.destroy_node()  # type: ignore[no-untyped-call]
        try_shutdown()


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
        draw_cycles(complete, scenario, options.picture)
        print(f'picture: {options.picture}')
    if options.record:
        print(f'recording: {options.record}')
    if problem:
        print_error(problem, 'demo')
    return 1 if problem or log.failed else 0


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
