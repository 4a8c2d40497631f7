"""Crash trials: kill each node in each phase, restart it, and measure the time to recover."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.protocol.user import User
from rhs_isac_ros.ros.processes import Processes
from system.observer import NetworkObserver

# Messages that each node publishes.
PUBLISHES = {
    'bs': BaseStation.SENDS,
    'rhs_controller': RhsController.SENDS,
    'channel': Channel.SENDS,
    'positioner': Positioner.SENDS,
    'transmission': Transmission.SENDS,
    'optimizer': (),
    'user_1': User.SENDS,
}
NODES = tuple(PUBLISHES)
PHASES = tuple(m.Phase)
# Maximum time to recover [s].
RECOVERY_LIMIT_S = 3.0
_TIMEOUT_S = 30.0
# A killed node is restarted after this time [s]. Until then, the other nodes must report that it
# is missing: users wait 1.5 s for a beacon, and diagnostics are published once a second.
_DOWNTIME_S = 3.0


class ChaosError(RuntimeError):
    """The network does not reach the state in which a trial can begin."""


@dataclasses.dataclass(frozen=True)
class CrashTrial:
    """Result of one trial.

    Attributes
    ----------
    node, phase
        The node that was killed, and the phase.
    kill_delay_s
        Time from the observed start of the phase to the end of the process [s].
    recovery_s
        Time from the restart of the process to the end of the first cycle that was served after
        it, for a user of one of its own cycles [s]; infinite if there was none.
    others_running
        Whether all other processes kept running.
    logged
        Warnings that other nodes logged about the missing node, each as ``<node>: <text>``.
    diagnosed
        Nodes whose diagnostics reported a fault while the node was missing.
    violations
        Results that violate an invariant.
    """

    node: str
    phase: str
    kill_delay_s: float
    recovery_s: float
    others_running: bool
    logged: tuple[str, ...]
    diagnosed: tuple[str, ...]
    violations: tuple[str, ...]

    @property
    def recovered(self) -> bool:
        """Whether cycles were served in time and all other processes kept running."""
        return self.recovery_s <= RECOVERY_LIMIT_S and self.others_running

    @property
    def reported(self) -> bool:
        """Whether logs and diagnostics reported the missing node, without repeated warnings."""
        return bool(self.logged and self.diagnosed
                    and len(set(self.logged)) == len(self.logged))


def crash_all(
        observer: NetworkObserver, processes: Processes, nodes: Sequence[str],
        phases: Iterable[m.Phase], on_trial: Callable[[CrashTrial], None]) -> list[CrashTrial]:
    """Kill every node in every phase.

    Parameters
    ----------
    processes
        The network, with the users 1 and 2.
    nodes
        Names of the nodes to kill.
    on_trial
        Called after each trial.

    Raises
    ------
    ChaosError
        If the network does not serve its users before a trial.
    """
    trials = []
    for node in nodes:
        for phase in phases:
            trials.append(crash(observer, processes, node, phase))
            on_trial(trials[-1])
    return trials


def crash(
        observer: NetworkObserver, processes: Processes, node: str, phase: m.Phase) -> CrashTrial:
    """Kill a node in a phase, and restart it.

    Raises
    ------
    ChaosError
        If the network does not serve its users before.
    """
    wait_for_service(observer)
    n_violations = len(observer.invariants.violations)
    log_lengths = {name: len(processes.log(name)) for name in processes.names}
    kill_delay_s = _kill_in(observer, processes, node, phase)
    observer.warnings.clear()
    observer.spin_for(_DOWNTIME_S)
    diagnosed = tuple(sorted(observer.warnings))
    logged = tuple(warnings_since(processes, log_lengths, node))
    observer.invariants.expect_rediscovery(PUBLISHES[node])
    n_codebooks = observer.n_codebooks
    restart_s = time.monotonic()
    processes.restart(node)
    user = int(node.removeprefix('user_')) if node.startswith('user_') else None

    def served() -> bool:
        found = any(record.outcome == 'served' and record.began_s > restart_s
                    and user in (None, record.user) for record in observer.log.ended[-20:])
        return found and (node != 'optimizer' or observer.n_codebooks > n_codebooks)
    recovered = observer.spin_until(served, _TIMEOUT_S)
    recovery_s = time.monotonic() - restart_s if recovered else float('inf')
    return CrashTrial(
        node, phase.name.lower(), kill_delay_s, recovery_s, not processes.ended(), logged,
        diagnosed, tuple(observer.invariants.violations[n_violations:]))


def both_served(observer: NetworkObserver, first: int) -> bool:
    """Return whether users 1 and 2 were served in the cycles from the index `first` on."""
    return {1, 2} <= {
        record.user for record in observer.log.ended[first:] if record.outcome == 'served'}


def wait_for_service(observer: NetworkObserver) -> None:
    """Wait until both users have been served in cycles that end from now on."""
    first = len(observer.log.ended)
    if not observer.spin_until(lambda: both_served(observer, first), _TIMEOUT_S):
        outcomes = [record.outcome for record in observer.log.ended[first:]]
        raise ChaosError(f'the users were not served within {_TIMEOUT_S:g} s; outcomes of the '
                         f'cycles: {outcomes or "none"}')


def _kill_in(
        observer: NetworkObserver, processes: Processes, node: str, phase: m.Phase) -> float:
    """Kill a node as soon as a cycle enters a phase; return how long that took [s]."""
    delays_s: list[float] = []

    def kill(entered: m.Phase) -> None:
        if entered is phase and not delays_s:
            begin_s = time.monotonic()
            processes.kill(node)
            delays_s.append(time.monotonic() - begin_s)
    observer.on_phase = kill
    try:
        if not observer.spin_until(lambda: bool(delays_s), _TIMEOUT_S):
            raise ChaosError(f'no cycle entered the phase {phase.name} within {_TIMEOUT_S:g} s')
    finally:
        observer.on_phase = lambda entered: None
    return delays_s[0]


def warnings_since(
        processes: Processes, log_lengths: dict[str, int], excluded: str = '') -> list[str]:
    """Return new warnings in the logs of all nodes but one, each with the name of its node.

    Parameters
    ----------
    log_lengths
        Length of each log at the beginning, by name of the process.
    """
    return [f'{name}: {line.split("]: ", 1)[-1]}'
            for name, length in log_lengths.items() if name != excluded
            for line in processes.log(name)[length:].splitlines() if '[WARN]' in line]
