"""The command line of ``scripts/chaos``."""

import argparse
import dataclasses
import itertools
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException

from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.environment import check_environment, private_domain, use_discovery_profile
from rhs_isac_ros.support.arguments import ArgumentParser, positive_float, positive_int
from rhs_isac_ros.support.exits import print_error
from rhs_isac_ros.tools.demo import add_network_options, load_files, start_network
from system.chaos import crashes, fuzzing, intruders, soaking
from system.chaos.trial import ChaosError, Trial
from system.invariants import CHECK_DELAY_S
from system.observer import NetworkObserver
from system.trial_processes import TrialProcesses

# Pause between cycles [s]; a longer one during fuzzing leaves room for messages in the queues.
_REST_S, _FUZZING_REST_S = 0.02, 0.2
_PHASES = [phase.name.lower() for phase in crashes.PHASES]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command, and return its exit code.

    It is 0 if all trials passed, or after Ctrl-C; 1 if a trial failed; 2 if an argument or a file
    is invalid.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.composed and (options.nodes or intruders.USER in (options.intruders or ())):
        parser.error('argument --composed: not allowed with --nodes or --intruders user, which '
                     'kill a single node')
    check_environment(parser)
    try:
        scenario, codebook_file = load_files(options.config, options.codebook)
    except (ScenarioError, CodebookError) as error:
        print_error(error, parser.prog)
        return 2
    os.environ.update(private_domain())
    use_discovery_profile()
    rclpy.init(args=[])
    observer = NetworkObserver(scenario)
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs:
        processes = TrialProcesses(Path(logs), {'ROS_LOG_DIR': logs})
        try:
            with processes:
                start_network(
                    processes, 2, scenario, composed=options.composed, seed=options.seed,
                    scenario_file=options.config,
                    codebook_file=codebook_file,
                    rest_s=_FUZZING_REST_S if options.fuzz else _REST_S,
                    **(dataclasses.asdict(soaking.IMPAIRMENTS) if options.soak else {}))
                figures, passed = _run(observer, processes, scenario, options, codebook_file)
                # The last results are checked after the settling time.
                observer.spin_for(CHECK_DELAY_S)
                for name, code in processes.ended().items():
                    last = '\n  '.join(processes.log(name).splitlines()[-12:])
                    print(f'ENDED: {name}, exit code {code}\n  {last}', file=sys.stderr)
        except ChaosError as error:
            print_error(error, parser.prog)
            return 1
        except (KeyboardInterrupt, ExternalShutdownException):
            return 0
        finally:
            observer.destroy_node()
            rclpy.try_shutdown()
    checker = observer.invariants
    # Results of messages that were forged may be wrong.
    passed = passed and (bool(options.fuzz) or not checker.violations)
    print(json.dumps({
        **figures, 'wrong_publications': len(checker.violations),
        'checked_publications': checker.checked, 'unverified_publications': checker.unverified,
        'violations': checker.violations, 'passed': passed}, indent=2))
    return 0 if passed else 1


def _run(
        observer: NetworkObserver, processes: TrialProcesses, scenario: Scenario,
        options: argparse.Namespace, codebook_file: Path) -> tuple[dict[str, Any], bool]:
    """Return the figures of the chosen trials, and whether these have passed."""
    if options.soak:
        soaked = soaking.soak(observer, processes, options.soak, lambda minutes, n: _progress(
            f'{minutes:.1f} of {options.soak:g} minutes, {n} cycles'))
        return soaked.figures(), soaked.passed
    if options.fuzz:
        fuzzed = fuzzing.fuzz(
            observer, processes, scenario, Codebook.load(codebook_file), options.fuzz,
            np.random.default_rng(options.seed),
            lambda n: _progress(f'{n} of {options.fuzz} mutations'))
        return dataclasses.asdict(fuzzed), fuzzed.passed
    crashes_chosen = options.nodes is not None or options.phases is not None
    chosen: list[Iterator[Trial]] = []
    if crashes_chosen or options.intruders is None:
        chosen.append(crashes.crash_all(
            observer, processes, options.nodes or (
                [crashes.ALL] if options.composed else crashes.NODES), options.repeat * [
                m.Phase[name.upper()] for name in options.phases or _PHASES]))
    if options.intruders is not None or not crashes_chosen:
        common = {'scenario_file': options.config.resolve()} if options.config else {}
        # The trial with two users kills the process of the first.
        chosen.append(intruders.intrude_all(
            observer, processes, options.intruders or [
                one for one in intruders.INTRUDERS
                if not (options.composed and one == intruders.USER)], options.seconds,
            common, scenario, Codebook.load(codebook_file)))
    trials = []
    for trial in itertools.chain(*chosen):
        trials.append(trial)
        print(json.dumps(dataclasses.asdict(trial)), file=sys.stderr, flush=True)
    times_s = [trial.recovery_s for trial in trials]
    return {
        'trials': len(trials),
        'trials_recovered': sum(trial.recovered for trial in trials),
        'trials_reported': sum(trial.reported for trial in trials),
        'worst_recovery_s': None if None in times_s else max(times_s),
        'table': [dataclasses.asdict(trial) for trial in trials],
    }, all(trial.recovered and trial.reported for trial in trials)


def _progress(text: str) -> None:
    if sys.stderr.isatty():
        print(f'\r{text}', end='', file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='scripts/chaos',
        description='Start a network of processes, kill and restart each node in each phase, '
                    'start a second node of each role, and check from outside that no invariant '
                    'of the results is violated.')
    test = parser.add_mutually_exclusive_group()
    test.add_argument('--soak', type=positive_float, metavar='MINUTES',
                      help='instead of killing nodes, run for this time with an impaired channel '
                      'that loses 5 %% of signals and packets, duplicates 5 %%, and delays and '
                      'reorders them')
    test.add_argument('--fuzz', type=positive_int, metavar='N',
                      help='instead of killing nodes, publish this number of random and mutated '
                      'messages of every type on every topic')
    parser.add_argument('--composed', action='store_true',
                        help='run all nodes in one process, which is killed as a whole; '
                             'without the trial with two users of one number')
    parser.add_argument('--nodes', nargs='+', choices=crashes.NODES, metavar='NODE',
                        help=f'only kill these nodes; one or more of {", ".join(crashes.NODES)}')
    parser.add_argument('--phases', nargs='+', choices=_PHASES, metavar='PHASE',
                        help=f'only kill nodes in these phases, out of {", ".join(_PHASES)}')
    parser.add_argument('--repeat', type=positive_int, default=1, metavar='N',
                        help='number of times that each node is killed in each phase')
    parser.add_argument('--intruders', nargs='+', choices=intruders.INTRUDERS, metavar='NODE',
                        help='only start these second nodes, which may be repeated, out of '
                             f'{", ".join(intruders.INTRUDERS)}')
    parser.add_argument('--seconds', type=positive_float, default=intruders.SECONDS,
                        metavar='S', help='duration of each intrusion')
    add_network_options(parser)
    return parser
