"""The command line of ``scripts/chaos``."""

import argparse
import json
import math
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.monitoring.invariants import SETTLE_S
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.processes import Processes, private_domain
from rhs_isac_ros.ros.run import use_discovery_profile
from rhs_isac_ros.tools.demo import check_directory, load_files, start_network
from system.chaos import crashes, fuzzing, report, soaking
from system.chaos.watcher import Watcher

# Pause between cycles; beside lies, so long that true messages leave room in the queues [s].
_REST_S, _REST_BESIDE_LIES_S = 0.02, 0.2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code: 0 if all promises held, also after Ctrl-C; 1 if one was broken; 2 if an
        argument or a file is wrong.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    check_directory(parser, '--json', options.json)
    try:
        scenario, codebook_file = load_files(options.config, options.codebook)
    except (ScenarioError, CodebookError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    os.environ.update(private_domain())
    use_discovery_profile()
    rclpy.init(args=[])
    watcher = Watcher(scenario)
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        processes = Processes(Path(logs), {'ROS_LOG_DIR': logs})
        try:
            with processes:
                start_network(
                    processes, 2, options.seed, options.config, codebook_file, scenario,
                    rest_s=_REST_BESIDE_LIES_S if options.fuzz else _REST_S, first_cycle=0,
                    impairments=soaking.AIR if options.soak else None)
                figures = _run(watcher, processes, scenario, options)
        except crashes.ChaosError as error:
            print(f'error: {error}', file=sys.stderr)
            return 1
        except (KeyboardInterrupt, ExternalShutdownException):
            return 0
        finally:
            watcher.destroy_node()
            rclpy.try_shutdown()
    if options.json:
        write_whole(options.json, json.dumps(figures, indent=2) + '\n')
    return 0 if figures['passed'] else 1


def _run(
        watcher: Watcher, processes: Processes, scenario: Scenario, options: argparse.Namespace
) -> dict:
    if options.soak:
        return _soak(watcher, processes, options)
    if options.fuzz:
        return _fuzz(watcher, processes, scenario, options)
    return _crash(watcher, processes, options)


def _soak(watcher: Watcher, processes: Processes, options: argparse.Namespace) -> dict:
    soaked = soaking.soak(
        watcher, processes, options.soak, lambda minutes, cycles: _progress(
            f'{minutes:.1f} of {options.soak:g} minutes, {cycles} cycles'))
    # What came last cannot be judged yet, and what comes now need not be.
    watcher.spin_until(lambda: False, SETTLE_S)
    figures = report.soak_figures(soaked, watcher.promises)
    print(report.soak_text(soaked, figures))
    return figures


def _fuzz(
        watcher: Watcher, processes: Processes, scenario: Scenario, options: argparse.Namespace
) -> dict:
    fuzzed = fuzzing.fuzz(
        watcher, processes, scenario, options.fuzz, np.random.default_rng(options.seed),
        lambda sent: _progress(f'{sent} of {options.fuzz} lies'))
    print(report.fuzz_text(fuzzed))
    return report.fuzz_figures(fuzzed)


def _progress(text: str) -> None:
    if sys.stderr.isatty():
        print(f'\r{text}', end='', file=sys.stderr, flush=True)


def _crash(watcher: Watcher, processes: Processes, options: argparse.Namespace) -> dict:
    print(report.CRASH_HEAD)
    cells = crashes.crash_all(
        watcher, processes, options.nodes, [m.Phase[name.upper()] for name in options.phases],
        lambda cell: print(report.crash_line(cell), flush=True))
    watcher.spin_until(lambda: False, SETTLE_S)
    figures = report.crash_figures(cells, watcher.promises)
    print(report.crash_summary(figures))
    return figures


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='chaos', formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Start a network of processes, kill and restart each node in each phase, and '
                    'watch from outside whether the network keeps its promises.')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--soak', type=_positive(float), metavar='MINUTES',
                      help='kill nobody: run so long through an air that loses 5 %% of signals '
                      'and packets, doubles 5 %%, and delays and reorders them')
    what.add_argument('--fuzz', type=_positive(int), metavar='N',
                      help='kill nobody: publish so many random and mutated messages of every '
                      'type on every topic')
    phases = [phase.name.lower() for phase in crashes.PHASES]
    parser.add_argument('--nodes', nargs='+', default=crashes.NODES, choices=crashes.NODES,
                        metavar='NODE', help='nodes to kill')
    parser.add_argument('--phases', nargs='+', default=phases, choices=phases, metavar='PHASE',
                        help='phases to kill them in')
    parser.add_argument('--seed', type=int, default=0, help='seed of all random numbers')
    parser.add_argument('--config', type=Path, help="scenario file; the paper's Table I if none")
    parser.add_argument('--codebook', type=Path, help="codebook file; the package's if none")
    parser.add_argument('--json', type=Path, metavar='PATH', help='file to write the figures to')
    return parser


def _positive(kind: type) -> Callable[[str], float]:
    def number(text: str) -> float:
        value = kind(text)
        if not 0 < value < math.inf:
            raise argparse.ArgumentTypeError(f'{text}, expected a number above 0')
        return value
    return number
