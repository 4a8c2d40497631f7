"""Kills each node in each phase, starts it again, and sees how long the network takes to serve."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.processes import Processes
from system.chaos.watcher import Watcher

# What each node publishes of what the promises are judged by.
PUBLISHES = {
    'bs': (m.Grant, m.ReceivedSignals),
    'rhs_controller': (m.RhsConfiguration,),
    'channel': (m.FeedSignals,),
    'positioner': (m.PositionEstimate,),
    'transmission': (m.Beam, m.Capacity),
    'optimizer': (),
    'user_1': (),
}
NODES = tuple(PUBLISHES)
PHASES = tuple(m.Phase)
# What counts as recovered [s].
LIMIT_S = 3.0
_PATIENCE_S = 30.0
# Who tells of a node that is missing has so long to do so: users wait 1.5 s for a beacon, and
# diagnostics come once a second.
_DOWN_S = 3.0


class ChaosError(RuntimeError):
    """The network does not do what every trial begins with."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One trial.

    Attributes
    ----------
    node, phase
        Which node was killed, in which phase.
    late_s
        How long after the phase was seen to begin it was dead [s].
    recovered_s
        From the start of its process to the end of the first cycle that was served after that,
        for a user: of one of its own cycles [s]; infinite if there was none.
    survivors
        Whether all other processes lived on.
    told_log
        Warnings of the others about it, each with the name of who said it.
    told_diagnostics
        Nodes whose diagnostics showed that something was amiss, while it was missing.
    broken
        Results that should not have been published.
    """

    node: str
    phase: str
    late_s: float
    recovered_s: float
    survivors: bool
    told_log: tuple[str, ...]
    told_diagnostics: tuple[str, ...]
    broken: tuple[str, ...]

    @property
    def recovered(self) -> bool:
        """Whether the network served again in time and lost nobody else."""
        return self.recovered_s <= LIMIT_S and self.survivors

    @property
    def told(self) -> bool:
        """Whether others told of it, in log and diagnostics, and nobody twice the same."""
        return bool(self.told_log and self.told_diagnostics
                    and len(set(self.told_log)) == len(self.told_log))


def crash_all(
        watcher: Watcher, processes: Processes, nodes: Sequence[str],
        phases: Iterable[m.Phase], done: Callable[[Cell], None]) -> list[Cell]:
    """Try every node in every phase.

    Parameters
    ----------
    watcher
        Hears the network.
    processes
        The network, with users 1 and 2.
    nodes
        Names of the nodes to kill.
    phases
        Phases to kill them in.
    done
        Called after each trial.

    Returns
    -------
    list of Cell
        The trials.

    Raises
    ------
    ChaosError
        If the network does not serve its users before a trial.
    """
    cells = []
    for node in nodes:
        for phase in phases:
            cells.append(crash(watcher, processes, node, phase))
            done(cells[-1])
    return cells


def crash(watcher: Watcher, processes: Processes, node: str, phase: m.Phase) -> Cell:
    """Kill a node in a phase, and start it again.

    Parameters
    ----------
    watcher
        Hears the network.
    processes
        The network.
    node
        Name of the node.
    phase
        The phase.

    Returns
    -------
    Cell
        What came of it.

    Raises
    ------
    ChaosError
        If the network does not serve its users before.
    """
    _await_service(watcher)
    broken = len(watcher.promises.broken)
    logs = _log_lengths(processes)
    late_s = _kill_in(watcher, processes, node, phase)
    warned = set()
    down_s = time.monotonic() + _DOWN_S
    watcher.told.clear()
    while time.monotonic() < down_s:
        watcher.spin_until(lambda: False, 0.1)
        warned |= set(watcher.warnings())
    watcher.promises.expect_silence(PUBLISHES[node])
    told_log = tuple(_warnings_since(processes, logs, node))
    heard = watcher.codebooks_heard
    began_s = time.monotonic()
    processes.restart(node)
    wanted = int(node.removeprefix('user_')) if node.startswith('user_') else None

    def serves() -> bool:
        again = any(end.outcome == 'served' and end.began_s > began_s and
                    wanted in (None, end.user) for end in reversed(watcher.ends[-20:]))
        return again and (node != 'optimizer' or watcher.codebooks_heard > heard)
    again = watcher.spin_until(serves, _PATIENCE_S)
    recovered_s = time.monotonic() - began_s if again else float('inf')
    return Cell(
        node, phase.name.lower(), late_s, recovered_s, not processes.ended(), told_log,
        tuple(sorted(warned)), tuple(watcher.promises.broken[broken:]))


def _await_service(watcher: Watcher) -> None:
    """Wait until both users are served in cycles that begin now."""
    begin = len(watcher.ends)

    def both() -> bool:
        return {1, 2} <= {end.user for end in watcher.ends[begin:] if end.outcome == 'served'}
    if not watcher.spin_until(both, _PATIENCE_S):
        reasons = [end.outcome for end in watcher.ends[begin:]]
        raise ChaosError(f'the users are not served within {_PATIENCE_S:g} s; cycles end '
                         f'with {reasons or "nothing"}')


def _kill_in(watcher: Watcher, processes: Processes, node: str, phase: m.Phase) -> float:
    """Kill a node as soon as a cycle enters a phase; return how long that took [s]."""
    late_s: list[float] = []

    def strike(entered: m.Phase, cycle_id: int) -> None:
        if entered is phase and not late_s:
            begin_s = time.monotonic()
            processes.kill(node)
            late_s.append(time.monotonic() - begin_s)
    watcher.on_phase = strike
    try:
        if not watcher.spin_until(lambda: bool(late_s), _PATIENCE_S):
            raise ChaosError(f'no cycle enters the phase {phase.name} in {_PATIENCE_S:g} s')
    finally:
        watcher.on_phase = lambda phase, cycle_id: None
    return late_s[0]


def _log_lengths(processes: Processes) -> dict[str, int]:
    return {name: len(processes.log(name)) for name in processes.names}


def _warnings_since(
        processes: Processes, lengths: dict[str, int], without: str) -> list[str]:
    """Warnings in the logs of all but one process, each with the name of its node."""
    return [f'{name}: {line.split("]: ", 1)[-1]}'
            for name, length in lengths.items() if name != without
            for line in processes.log(name)[length:].splitlines() if '[WARN]' in line]
