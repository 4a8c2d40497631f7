"""Outages of the links of a network on several hosts, and what must be observed of them."""

import collections
import dataclasses
import math
import time
from collections.abc import Mapping, Sequence

from rhs_isac_ros.monitoring.cycle_log import CycleTimes
from rhs_isac_ros.protocol.presences import SILENCE_S
from rhs_isac_ros.ros.processes import Processes
from system import invariants
from system.hosts import namespaces
from system.observer import NetworkObserver
from system.recovery import RECOVERY_LIMIT_S, finite

# Nodes that wait for a node of the disconnected host.
WAITING: dict[str, tuple[str, ...]] = {
    'base_station': ('user',), 'surface': ('bs',), 'channel': ('bs', 'user'),
    'positioner': ('bs',), 'users': ()}
# Time until a node reports that it is waiting [s]: 3 s after bs misses announcements, or after
# Fast DDS removes an unreachable node from the graph, on which users rely.
_REPORTED_AFTER_S = {'bs': SILENCE_S + 3.0, 'user': 23.0}
# Time within which messages that were sent before an outage arrive [s].
_IN_FLIGHT_S = 0.2
# Maximum duration of the observation before the first cycle, before and after an outage [s].
_START_S, _BEFORE_S, _AFTER_S = 60.0, 5.0, 20.0


class NetworkBroken(RuntimeError):
    """A node has ended, or no cycle is served."""


@dataclasses.dataclass(frozen=True)
class Outage:
    """Result of an outage of one link.

    Attributes
    ----------
    recovery_s
        Time from the restoration of the link to the end of the first cycle that began after that
        [s]; infinite if there was none.
    before, during, after
        Complete cycles observed before, during and after the outage. A network needs all of its
        hosts: a complete cycle during the outage has bypassed the link.
    logged, unreported, repeated
        Nodes that logged a warning, whose log or diagnostics lack the required report of a missing
        node, or that logged more than once that they wait for the same node.
    """

    host: str
    outage_s: float
    recovery_s: float
    before: int
    during: int
    after: int
    logged: tuple[str, ...]
    unreported: tuple[str, ...]
    repeated: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether the network recovered in time, and every node reported the outage once."""
        return (self.recovery_s <= RECOVERY_LIMIT_S and not self.during
                and not self.unreported and not self.repeated)

    def figures(self) -> dict[str, object]:
        """Return the fields for JSON, with None for an infinite time."""
        return {**dataclasses.asdict(self), 'recovery_s': finite(self.recovery_s)}


def evaluate(
        host: str, marks_s: Sequence[float], cycles: Sequence[CycleTimes],
        logs: Mapping[str, str], warnings: Mapping[str, Sequence[str]]) -> Outage:
    """Evaluate an outage of a host from the complete cycles.

    Parameters
    ----------
    marks_s
        Start of the observation, start and end of the outage, end of the observation [s].
    logs, warnings
        Log of each node, and warnings in its diagnostics, during the outage.
    """
    began_s, down_s, restored_s, ended_s = marks_s
    spans_s = [(cycle.began_s, cycle.ended_s) for cycle in cycles]
    awaited = {node: collections.Counter(
        line.partition('waiting for ')[2] for line in log.splitlines() if 'waiting for ' in line)
        for node, log in logs.items()}
    required = [kind for kind in WAITING[host] if restored_s - down_s >= _REPORTED_AFTER_S[kind]]
    return Outage(
        host, restored_s - down_s,
        recovery_s=min((end - restored_s for begin, end in spans_s if begin >= restored_s),
                       default=math.inf),
        before=sum(began_s <= end < down_s for _, end in spans_s),
        during=sum(down_s + _IN_FLIGHT_S <= begin and end < restored_s for begin, end in spans_s),
        after=sum(restored_s <= end <= ended_s for _, end in spans_s),
        logged=tuple(node for node, log in logs.items() if '[WARN]' in log),
        unreported=tuple(
            node for node in logs if node.partition('_')[0] in required and not (awaited[node]
            and any(text.startswith('waiting for ') for text in warnings.get(node, ())))),
        repeated=tuple(node for node, counts in awaited.items()
                       if max(counts.values(), default=0) > 1))


@dataclasses.dataclass
class Trial:
    """A network on several hosts, observed while links are taken down."""

    processes: Processes
    observer: NetworkObserver

    def wait_until_served(self) -> None:
        """Wait until cycles are served; raise NetworkBroken if none is within a minute."""
        self._spin(_START_S, 3)
        if not self.observer.log.complete:
            raise NetworkBroken(f'no cycle within {_START_S:.0f} s; log of the base station:\n'
                                f'{self.processes.log("bs")}')

    def interrupt(self, host: str, seconds: float) -> Outage:
        """Take a link down for a time [s], restore it, and wait until cycles are served again."""
        marks_s = [time.monotonic()]
        self._spin(min(seconds, _BEFORE_S))
        log_lengths = {node: len(self.processes.log(node)) for node in self.processes.names}
        self.observer.warnings.clear()
        namespaces.connect(host, up=False)
        marks_s.append(time.monotonic())
        self._spin(seconds)
        logs = {node: self.processes.log(node)[n:] for node, n in log_lengths.items()}
        warnings = {node: tuple(texts) for node, texts in self.observer.warnings.items()}
        marks_s.append(time.monotonic())
        self.observer.invariants.expect_rediscovery(invariants.RECEIVES)
        namespaces.connect(host, up=True)
        self._spin(_AFTER_S, 3)
        marks_s.append(time.monotonic())
        return evaluate(host, marks_s, self.observer.log.complete, logs, warnings)

    def _spin(self, seconds: float, cycles: int = 0) -> None:
        """Observe for a time, or until a number of cycles (0: none) have begun and been served."""
        begin_s = time.monotonic()

        def done() -> bool:
            for node, code in self.processes.ended().items():
                raise NetworkBroken(
                    f'{node} ended with exit code {code}:\n{self.processes.log(node)}')
            newest = self.observer.log.complete[-cycles:] if cycles else ()
            return bool(cycles) and len(newest) == cycles and newest[0].began_s >= begin_s
        self.observer.spin_until(done, seconds)
