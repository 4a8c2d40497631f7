"""Soak test: a long run with an impaired channel, with statistics of cycles and memory."""

import collections
import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

from rhs_isac_ros.protocol.settings import Impairments
from system.chaos.trial import TIMEOUT_S, ChaosError
from system.observer import NetworkObserver
from system.trial_processes import TrialProcesses

IMPAIRMENTS = Impairments(
    loss_probability=0.05, double_probability=0.05, delay_s=0.001, jitter_s=0.005)
# Requirements: share of the cycles that lead to an estimate, and relative growth of the memory.
MIN_ESTIMATE_SHARE, MAX_MEMORY_GROWTH = 0.99, 0.05
# Start of the measurement of growth [s], or a third of the run if that is earlier.
_WARM_UP_S = 60.0


@dataclasses.dataclass(frozen=True)
class SoakResult:
    """Result of a soak test."""

    minutes: float  #: Duration of the run [min].
    outcomes: Mapping[str, int]  #: Number of cycles by outcome.
    estimates: int  #: Number of cycles that led to an estimate.
    retries: Mapping[str, int]  #: Number of repeated requests by step.
    impaired: Mapping[str, int]  #: Number of impaired messages by kind of impairment.
    #: Resident memory by node, after the warm-up and at the end.
    memory_bytes: Mapping[str, tuple[int, int]]
    ended: tuple[str, ...]  #: Processes that ended.

    @property
    def cycles(self) -> int:
        """Number of cycles that ended."""
        return sum(self.outcomes.values())

    @property
    def estimate_share(self) -> float:
        """Share of the cycles that led to an estimate."""
        return self.estimates / max(self.cycles, 1)

    @property
    def memory_growth(self) -> dict[str, float]:
        """Relative growth of the memory by node."""
        return {name: last / first - 1 for name, (first, last) in self.memory_bytes.items()}

    def figures(self) -> dict[str, Any]:
        """Return all fields and properties but `passed`, for JSON."""
        return {**dataclasses.asdict(self), 'cycles': self.cycles,
                'estimate_share': self.estimate_share, 'memory_growth': self.memory_growth}

    @property
    def passed(self) -> bool:
        """Whether the requirements are met and all processes kept running."""
        return (not self.ended and self.estimate_share >= MIN_ESTIMATE_SHARE
                and max(self.memory_growth.values(), default=0.0) < MAX_MEMORY_GROWTH)


def soak(
        observer: NetworkObserver, processes: TrialProcesses, minutes: float,
        on_progress: Callable[[float, int], None]) -> SoakResult:
    """Observe a network for a time [min].

    `on_progress` is called every few seconds with the elapsed minutes and the number of cycles
    that ended. Raises ChaosError if no cycle ends at the start.
    """
    log = observer.log
    if not observer.spin_until(lambda: bool(log.ended), TIMEOUT_S):
        raise ChaosError(f'no cycle within {TIMEOUT_S:g} s')
    begin_s, first = time.monotonic(), len(log.ended)
    duration_s = 60.0 * minutes
    warm_up_s = min(_WARM_UP_S, duration_s / 3)
    memory_before: dict[str, int] = {}
    while (elapsed_s := time.monotonic() - begin_s) < duration_s and not processes.ended():
        if not memory_before and elapsed_s >= warm_up_s:
            memory_before = processes.memory_bytes()
        next_s = warm_up_s if elapsed_s < warm_up_s else duration_s
        observer.spin_for(min(5.0, next_s - elapsed_s))
        on_progress((time.monotonic() - begin_s) / 60, len(log.ended) - first)
    memory = processes.memory_bytes()
    cycles = log.ended[first:]
    return SoakResult(
        (time.monotonic() - begin_s) / 60,
        dict(collections.Counter(cycle.outcome for cycle in cycles)),
        sum(cycle.estimate is not None for cycle in cycles),
        _counts(observer, 'bs', 'retries.'), _counts(observer, 'channel', 'dropped.emulated_'),
        {name: (memory_before[name], memory[name]) for name in memory_before if name in memory},
        tuple(processes.ended()))


def _counts(observer: NetworkObserver, node: str, prefix: str) -> dict[str, int]:
    """Return the counters of a node whose keys begin with a prefix, by the rest of the key."""
    details = observer.reports[node].details if node in observer.reports else {}
    return {key.removeprefix(prefix): int(value) for key, value in details.items()
            if key.startswith(prefix)}
