"""Crash trials: kill each node in each phase, restart it, and measure the time to recover."""

import dataclasses
import itertools
import time
from collections.abc import Iterator, Sequence

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.roster import ROSTER
from system.chaos.trial import (
    TIMEOUT_S,
    ChaosError,
    Trial,
    measure_recovery,
    wait_for_service,
    warnings_since,
)
from system.observer import NetworkObserver
from system.trial_processes import TrialProcesses

# Messages that each node publishes.
PUBLISHES = {name if member.is_unique else f'{name}_1': member.role.SENDS if member.role else ()
             for name, member in ROSTER.items()}
# Nobody misses a role that no other needs.
_NEEDED = {name for member in ROSTER.values() for name in member.needed}
NODES = tuple(name for name in PUBLISHES if name in _NEEDED or name not in ROSTER)
# The process of a composed network.
ALL = 'network'
PUBLISHES[ALL] = tuple(itertools.chain(*PUBLISHES.values()))
PHASES = tuple(m.Phase)
# A killed node is restarted after this time [s], or once the other nodes have reported that it is
# missing: users wait 1.5 s for a beacon, and diagnostics are published once a second.
_DOWNTIME_S = 3.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class CrashTrial(Trial):
    """Result of killing a node in a phase; the fault ends with the restart of the node."""

    node: str
    phase: str
    kill_delay_s: float  #: From the observed start of the phase to the end of the process [s].


def crash_all(
        observer: NetworkObserver, processes: TrialProcesses, nodes: Sequence[str],
        phases: Sequence[m.Phase]) -> Iterator[CrashTrial]:
    """Kill every node in every phase of a network with the users 1 and 2; yield the trials.

    Raises ChaosError if the network does not serve its users before a trial.
    """
    for node, phase in itertools.product(nodes, phases):
        yield crash(observer, processes, node, phase)


def crash(
        observer: NetworkObserver, processes: TrialProcesses, node: str, phase: m.Phase
) -> CrashTrial:
    """Kill a node in a phase, and restart it.

    Raises ChaosError if the network does not serve its users before, or still reports the node.
    """
    wait_for_service(observer)
    _wait_until_found(observer, node)
    n_violations = len(observer.invariants.violations)
    log_lengths = {name: len(processes.log(name)) for name in processes.names}
    kill_delay_s = _kill_in(observer, processes, node, phase)
    observer.warnings.clear()
    observer.spin_for(_DOWNTIME_S)
    # On a busy machine, the reports take longer.
    others = set(processes.names) - {node}
    observer.spin_until(lambda: bool(not others or (
        observer.warnings and warnings_since(processes, log_lengths, node))), TIMEOUT_S)
    diagnosed = tuple(sorted(observer.warnings))
    logged = tuple(warnings_since(processes, log_lengths, node))
    observer.invariants.expect_rediscovery(PUBLISHES[node])
    n_codebooks = observer.n_codebooks
    restart_s = time.monotonic()
    processes.restart(node)
    user = int(node.removeprefix('user_')) if node.startswith('user_') else None
    recovery_s = measure_recovery(
        observer, restart_s, user,
        lambda: node != 'optimizer' or observer.n_codebooks > n_codebooks)
    return CrashTrial(
        node=node, phase=phase.name.lower(), kill_delay_s=kill_delay_s, recovery_s=recovery_s,
        has_others=bool(others), others_running=not processes.ended(), logged=logged,
        diagnosed=diagnosed, violations=tuple(observer.invariants.violations[n_violations:]))


def _wait_until_found(observer: NetworkObserver, node: str) -> None:
    """Wait until no node reports a fault that names the given node.

    The network also serves without an optimizer. If the restarted optimizer were killed before a
    node had found it, that node would log nothing.
    """
    def faults() -> list[str]:
        return [f'{name}: {report.summary}' for name, report in observer.reports.items()
                if report.fault and node in report.summary]
    if not observer.spin_until(lambda: not faults(), TIMEOUT_S):
        raise ChaosError(f'{node} is still reported after {TIMEOUT_S:g} s: {faults()}')


def _kill_in(
        observer: NetworkObserver, processes: TrialProcesses, node: str, phase: m.Phase) -> float:
    """Kill a node as soon as a cycle enters a phase; return how long that took [s]."""
    delays_s: list[float] = []

    def kill(entered: m.Phase) -> None:
        if entered is phase and not delays_s:
            begin_s = time.monotonic()
            processes.kill(node)
            delays_s.append(time.monotonic() - begin_s)
    observer.on_phase = kill
    try:
        if not observer.spin_until(lambda: bool(delays_s), TIMEOUT_S):
            raise ChaosError(f'no cycle entered the phase {phase.name} within {TIMEOUT_S:g} s')
    finally:
        observer.on_phase = lambda entered: None
    return delays_s[0]
