"""A network of which each node is a process: its options, files, start and progress."""

import argparse
import dataclasses
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rclpy

from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol.settings import REGION, Impairments
from rhs_isac_ros.ros import parameters
from rhs_isac_ros.ros.processes import Processes, max_processes
from rhs_isac_ros.ros.recording import CycleObserver
from rhs_isac_ros.ros.roster import ROSTER, UNIQUE
from rhs_isac_ros.support.arguments import input_file, seed

# Maximum time between two complete cycles [s].
_CYCLE_TIMEOUT_S = 60.0
# Time between two looks at the nodes that have been discovered [s].
_DISCOVERY_PERIOD_S = 0.02


def add_network_options(parser: argparse.ArgumentParser) -> None:
    """Add the seed and the files of a network to the options of a command."""
    parser.add_argument('--seed', type=seed, default=0, help='seed of all random numbers')
    parser.add_argument('--config', '--scenario', type=input_file, metavar='FILE',
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
    return max_processes() - len(UNIQUE)


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
        File of ``scenario``; None for the paper's Table I.
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
    given: dict[str, Any] = {
        'seed': seed, 'codebook_file': codebook_file, 'rest_s': rest_s,
        'first_cycle': first_cycle, **dataclasses.asdict(impairments or Impairments())}
    if scenario_file:
        given['scenario_file'] = Path(scenario_file).resolve()
    for role in ROSTER:
        known = {parameter.name for parameter in parameters.NODES[role]}
        values = {name: value for name, value in given.items() if name in known}
        if role == 'positioner':
            values |= positioner or {}
        if ROSTER[role].is_unique:
            processes.start(role, **values)
            continue
        for name, first, count in [('users', 1, users)] if together else [
                (f'user_{user}', user, 1) for user in range(1, users + 1)]:
            processes.start(
                role, name, **values, user_id=first, user_count=count, mobility='random_walk',
                speed_mps=scenario.max_user_speed_mps)


def watch(
        observer: CycleObserver, processes: Processes, cycles: int,
        on_progress: Callable[[int, int], None],
        on_discovered: Callable[[], None] | None = None) -> str:
    """Spin an observer until it has received enough complete cycles.

    Parameters
    ----------
    cycles
        Number of complete cycles to wait for.
    on_progress
        Called with the number of complete cycles and `cycles` when the former changes.
    on_discovered
        Called when the observer has discovered all nodes.

    Returns
    -------
    str
        Description of the error that ended the wait; empty if there was none.
    """
    seen, changed_s = -1, time.monotonic()
    while seen < cycles:
        rclpy.spin_once(observer, timeout_sec=_DISCOVERY_PERIOD_S if on_discovered else 0.5)
        if on_discovered and set(processes.names) <= set(observer.get_node_names()):
            on_discovered()
            on_discovered = None
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
