"""Intrusion trials: start a second node of a role, and stop it again."""

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import yaml
from rclpy.node import Node

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import LATCHED, subscribe
from rhs_isac_ros.ros.roster import UNIQUE
from system.chaos.crashes import PUBLISHES
from system.chaos.trial import TIMEOUT_S, Trial, measure_recovery, wait_for_service, warnings_since
from system.observer import NetworkObserver
from system.trial_processes import TrialProcesses

# A channel with another scenario, a node with the number of user 1, and a second base station
# together with an observer that requests an incompatible quality of service.
SCENARIO, USER, OBSERVER = 'scenario', 'user', 'observer'
# All second nodes, among them one of each role.
INTRUDERS = (*UNIQUE, USER, SCENARIO, OBSERVER)
SECONDS = 4.0
_PROCESS = 'intruder'
_USER_NODE = 'user_1'
# Texts that name a conflict with the intruder, and one with the observer beside it.
_OF_INTRUDERS = 'two nodes', 'another scenario', 'serves instead of', 'stands by for'
_NAMES_OF_CONFLICTS = *_OF_INTRUDERS, 'no messages between'


@dataclasses.dataclass(frozen=True, kw_only=True)
class IntrusionTrial(Trial):
    """Result of starting a second node; the fault ends with this node, the intruder.

    With two users of the same number, the first user is killed, and the second is then served.
    """

    intruder: str
    served: int  #: Number of cycles served while the intruder was present.


def intrude_all(
        observer: NetworkObserver, processes: TrialProcesses, intruders: Iterable[str],
        seconds: float, parameters: dict[str, Any], scenario: Scenario, codebook: Codebook
) -> Iterator[IntrusionTrial]:
    """Add each intruder, of `INTRUDERS`, to a network with the users 1 and 2; yield the trials.

    An intrusion lasts `seconds` [s] after it has first been reported. `parameters` are those of
    all nodes. Raises ChaosError if the network does not serve its users before a trial.
    """
    with tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as folder:
        commands = _commands(Path(folder), parameters, scenario, codebook)
        for intruder in intruders:
            wait_for_service(observer)
            with _incompatible_observer() if intruder == OBSERVER else contextlib.nullcontext():
                yield _intrude(observer, processes, intruder, commands[intruder], seconds)


@contextlib.contextmanager
def _incompatible_observer() -> Iterator[None]:
    """Run a node that requests every topic as latched, which most publishers do not offer."""
    node = Node('incompatible')
    for kind, name in topics.NAMES.items():
        subscribe(node, convert.ros_type(kind), name, lambda *_: None, LATCHED, raw=True)
    try:
        yield
    finally:
        node.destroy_node()


def _commands(
        folder: Path, parameters: dict[str, Any], scenario: Scenario, codebook: Codebook
) -> dict[str, tuple[str, str, dict[str, Any]]]:
    """Return executable, name of the node and parameters of each intruder."""
    # A codebook of the same quality.
    Codebook(codebook.analog, -codebook.digital).save(folder / 'codebook.yaml')
    frequencies = [1.1 * frequency for frequency in scenario.center_frequencies_hz]
    (folder / 'scenario.yaml').write_text(yaml.safe_dump(
        {**scenario.changes(), 'center_frequencies_hz': frequencies}), encoding='utf-8')
    commands: dict[str, tuple[str, str, dict[str, Any]]] = {
        role: (role, '', parameters) for role in INTRUDERS if role in PUBLISHES}
    commands['optimizer'] = (
        'optimizer', '', {**parameters, 'codebook_file': folder / 'codebook.yaml'})
    commands[USER] = (
        'user', _USER_NODE, {**parameters, 'user_id': 1, 'seed': 99, 'mobility': 'random_walk',
                             'speed_mps': scenario.max_user_speed_mps})
    commands[OBSERVER] = commands['bs']
    commands[SCENARIO] = (
        'channel', '', {**parameters, 'scenario_file': folder / 'scenario.yaml'})
    return commands


def _intrude(
        observer: NetworkObserver, processes: TrialProcesses, intruder: str,
        command: tuple[str, str, dict[str, Any]], seconds: float) -> IntrusionTrial:
    executable, node, parameters = command
    n_violations = len(observer.invariants.violations)
    log_lengths = {_PROCESS: 0, **{name: len(processes.log(name)) for name in processes.names}}
    observer.warnings.clear()
    observer.invariants.expect_rediscovery(
        PUBLISHES[node or executable], by_another=True)
    first = len(observer.log.ended)
    processes.start(executable, node, _PROCESS, **parameters)
    # A process takes seconds to start on a loaded machine.
    observer.spin_until(lambda: bool(_diagnosed(observer, _OF_INTRUDERS)), TIMEOUT_S)
    observer.spin_for(seconds)
    served = sum(record.outcome == 'served' for record in observer.log.ended[first:])
    # A user number belongs to the first node that has it, and a role to the last.
    processes.kill(_USER_NODE if intruder == USER else _PROCESS)
    # The older node creates its publishers again.
    observer.invariants.expect_rediscovery(
        PUBLISHES[node or executable], by_another=True)
    recovery_s = measure_recovery(
        observer, time.monotonic(), 1 if intruder == USER else None)
    if intruder == USER:
        processes.kill(_PROCESS)
        processes.restart(_USER_NODE)
    logged = tuple(line for line in warnings_since(processes, log_lengths)
                   if any(text in line for text in _NAMES_OF_CONFLICTS))
    return IntrusionTrial(
        intruder=intruder, served=served, recovery_s=recovery_s,
        others_running=not processes.ended(), logged=logged, diagnosed=_diagnosed(observer),
        violations=tuple(observer.invariants.violations[n_violations:]))


def _diagnosed(
        observer: NetworkObserver, texts: Iterable[str] = _NAMES_OF_CONFLICTS) -> tuple[str, ...]:
    """Return the nodes whose diagnostics named a conflict."""
    return tuple(sorted(
        name for name, summaries in observer.warnings.items()
        if any(text in summary for text in texts for summary in summaries)))
