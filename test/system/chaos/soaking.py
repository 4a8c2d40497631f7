"""Lets a network run through a bad air, and sees what becomes of cycles and memory."""

import collections
import dataclasses
import time
from collections.abc import Callable, Mapping

from rhs_isac_ros.protocol.impairments import Impairments
from rhs_isac_ros.ros.processes import Processes
from system.chaos.crashes import ChaosError
from system.chaos.watcher import Watcher

AIR = Impairments(
    loss_probability=0.05, double_probability=0.05, delay_s=0.001, jitter_s=0.005)
# What is asked for: cycles that end in an estimate, and growth of the memory.
LEAST_SHARE, MOST_GROWTH = 0.99, 0.05
# Memory is compared with what it was after so long, or a third of the time if that is shorter.
_SETTLED_S = 60.0
_PATIENCE_S = 30.0


@dataclasses.dataclass(frozen=True)
class Soaked:
    """What became of a long run.

    Attributes
    ----------
    minutes
        How long it was.
    outcomes
        Cycles by how they ended.
    estimates
        Cycles that led to an estimate.
    retries
        Steps that were asked for again, by step.
    air
        What the air did, by kind.
    memory_bytes
        By node: resident memory when it was settled, and at the end.
    ended
        Processes that ended.
    """

    minutes: float
    outcomes: Mapping[str, int]
    estimates: int
    retries: Mapping[str, int]
    air: Mapping[str, int]
    memory_bytes: Mapping[str, tuple[int, int]]
    ended: tuple[str, ...]

    @property
    def cycles(self) -> int:
        """Cycles that ended."""
        return sum(self.outcomes.values())

    @property
    def share(self) -> float:
        """Share of the cycles that led to an estimate."""
        return self.estimates / max(self.cycles, 1)

    @property
    def growth(self) -> dict[str, float]:
        """Growth of the memory by node, as a share."""
        return {name: last / first - 1 for name, (first, last) in self.memory_bytes.items()}

    @property
    def passed(self) -> bool:
        """Whether enough cycles led to an estimate, and nobody died or grew."""
        return (not self.ended and self.share >= LEAST_SHARE
                and max(self.growth.values(), default=0.0) < MOST_GROWTH)


def soak(
        watcher: Watcher, processes: Processes, minutes: float,
        progress: Callable[[float, int], None]) -> Soaked:
    """Let a network run.

    Parameters
    ----------
    watcher
        Hears the network.
    processes
        The network.
    minutes
        How long.
    progress
        Called now and then with the minutes so far and the cycles that have ended.

    Returns
    -------
    Soaked
        What became of it.

    Raises
    ------
    ChaosError
        If the first cycle does not come.
    """
    if not watcher.spin_until(lambda: bool(watcher.ends), _PATIENCE_S):
        raise ChaosError(f'no cycle within {_PATIENCE_S:g} s')
    begin_s, begin = time.monotonic(), len(watcher.ends)
    estimates = watcher.estimates
    span_s = 60.0 * minutes
    settled_s = min(_SETTLED_S, span_s / 3)
    first: dict[str, int] = {}
    while (elapsed_s := time.monotonic() - begin_s) < span_s and not processes.ended():
        if not first and elapsed_s >= settled_s:
            first = processes.memory_bytes()
        watcher.spin_until(lambda: False, min(5.0, settled_s - elapsed_s if elapsed_s < settled_s
                                              else span_s - elapsed_s))
        progress((time.monotonic() - begin_s) / 60, len(watcher.ends) - begin)
    last = processes.memory_bytes()
    outcomes = collections.Counter(end.outcome for end in watcher.ends[begin:])
    told = [(key, int(value)) for node in ('bs', 'channel')
            for key, value in watcher.values(node).items()
            if key.startswith(('retries.', 'dropped.emulated'))]
    return Soaked(
        (time.monotonic() - begin_s) / 60, dict(outcomes), watcher.estimates - estimates,
        {key.partition('.')[2]: n for key, n in told if key.startswith('retries.')},
        {key.partition('emulated_')[2]: n for key, n in told if 'emulated_' in key},
        {name: (first[name], last[name]) for name in first if name in last},
        tuple(processes.ended()))
