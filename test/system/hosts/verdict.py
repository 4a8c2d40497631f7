"""Results of link outages, as figures and as a table."""

import collections
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from rhs_isac_ros.monitoring.cycle_log import CycleTimes
from system.recovery import RECOVERY_LIMIT_S, finite

_WARNING, _WAITING = '[WARN]', 'waiting for '
# Time within which messages that were sent before an outage arrive [s].
_IN_FLIGHT_S = 0.2


@dataclasses.dataclass(frozen=True)
class Outage:
    """Result of an outage of one link.

    Attributes
    ----------
    host
        Name of the host.
    outage_s
        Duration [s].
    recovery_s
        Time from the restoration of the link to the end of the first cycle that began after that
        [s]; infinite if there was none.
    before, during, after
        Complete cycles observed before the outage, during it, and after it. A network needs all
        of its hosts: a complete cycle during the outage has bypassed the link.
    logged
        Nodes that logged a warning during the outage.
    diagnosed
        Nodes whose diagnostics reported during the outage that they wait for another node.
    unreported
        Nodes whose log or diagnostics lack the required report of a missing node.
    repeated
        Nodes that logged more than once that they wait for the same node.
    """

    host: str
    outage_s: float
    recovery_s: float
    before: int
    during: int
    after: int
    logged: tuple[str, ...]
    diagnosed: tuple[str, ...]
    unreported: tuple[str, ...]
    repeated: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether the network recovered in time, and every node reported the outage once."""
        return (self.recovery_s <= RECOVERY_LIMIT_S and not self.during
                and not self.unreported and not self.repeated)


def recovery_s(cycles: Sequence[CycleTimes], restored_s: float) -> float:
    """Return the time that a network took to serve again.

    Parameters
    ----------
    cycles
        Complete cycles.
    restored_s
        Time at which the link was restored [s].

    Returns
    -------
    float
        Time to the end of the first cycle that began after `restored_s` [s]; infinite if none did.
    """
    return min((cycle.ended_s - restored_s for cycle in cycles if cycle.began_s >= restored_s),
               default=math.inf)


def evaluate(
        host: str, marks_s: Sequence[float], cycles: Sequence[CycleTimes],
        logs: Mapping[str, str], warnings: Mapping[str, Sequence[str]],
        waiting: Sequence[str]) -> Outage:
    """Evaluate an outage.

    Parameters
    ----------
    host
        Name of the host.
    marks_s
        Start of the observation, start and end of the outage, end of the observation [s].
    cycles
        Complete cycles.
    logs
        Log of each node during the outage.
    warnings
        Warnings in the diagnostics of each node during the outage.
    waiting
        Nodes that must report that they wait for another node.
    """
    began_s, down_s, restored_s, ended_s = marks_s
    spans_s = [(cycle.began_s, cycle.ended_s) for cycle in cycles]
    counts = (sum(began_s <= end < down_s for _, end in spans_s),
              sum(down_s + _IN_FLIGHT_S <= start and end < restored_s for start, end in spans_s),
              sum(restored_s <= end <= ended_s for _, end in spans_s))
    awaited = {node: [line.partition(_WAITING)[2] for line in log.splitlines()
                      if _WAITING in line] for node, log in logs.items()}
    diagnosed = tuple(sorted(node for node, texts in warnings.items()
                             if any(text.startswith(_WAITING) for text in texts)))
    return Outage(
        host, restored_s - down_s, recovery_s(cycles, restored_s), *counts,
        logged=tuple(sorted(node for node, log in logs.items() if _WARNING in log)),
        diagnosed=diagnosed,
        unreported=tuple(
            node for node in waiting if not awaited.get(node) or node not in diagnosed),
        repeated=tuple(sorted(node for node, names in awaited.items()
                              if max(collections.Counter(names).values(), default=0) > 1)))


def figures(outages: Sequence[Outage]) -> dict[str, Any]:
    """Return the figures of at least one outage for JSON, with None for infinite times."""
    worst_s = max(outage.recovery_s for outage in outages)
    return {'outages': [{**dataclasses.asdict(outage), 'recovery_s': finite(outage.recovery_s)}
                        for outage in outages],
            'worst_recovery_s': finite(worst_s)}


def table(outages: Sequence[Outage]) -> str:
    """Return a table with one line for each outage."""
    head = f'{"host":14}outage  recovered  cycles before  during  after  reported by'
    return '\n'.join([head, f'{"":14}   [s]        [s]', *(
        f'{outage.host:14}{outage.outage_s:6.1f}{outage.recovery_s:11.2f}{outage.before:15d}'
        f'{outage.during:8d}{outage.after:7d}  {_reporters(outage)}' for outage in outages)])


def _reporters(outage: Outage) -> str:
    parts = [', '.join(outage.logged) or 'none']
    if outage.unreported:
        parts.append(f'NOT {", ".join(outage.unreported)}')
    if outage.repeated:
        parts.append(f'MORE THAN ONCE {", ".join(outage.repeated)}')
    return '; '.join(parts)
