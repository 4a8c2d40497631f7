"""What pulling the links has shown, as figures and as a table."""

import collections
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from rhs_isac_ros.monitoring.cycle_log import CycleRecord

# A network that is whole again serves within this time [s].
PROMISE_S = 3.0
_WARNS, _WAITS = '[WARN]', 'waiting for '
# What was under way when a link was pulled is through by then [s].
_CUT_S = 0.2


@dataclasses.dataclass(frozen=True)
class Pull:
    """What became of the network while the link of a host was pulled, and after.

    Attributes
    ----------
    host
        Which host.
    pulled_s
        For how long [s].
    recovered_s
        From the link's return to the end of the first cycle that began after it [s]; infinite if
        there was none.
    before, during, after
        Complete cycles in some seconds before the pull, of those that began and ended during it,
        and after it until the end of the watch. A network lacks something without any of its
        hosts: a cycle during the pull has found another way than the link.
    said
        Nodes that warned in their log during the pull.
    diagnosed
        Nodes whose diagnostics told during the pull for whom they wait.
    untold
        Nodes that should have said so, and did not.
    repeated
        Nodes that said the same more than once.
    """

    host: str
    pulled_s: float
    recovered_s: float
    before: int
    during: int
    after: int
    said: tuple[str, ...]
    diagnosed: tuple[str, ...]
    untold: tuple[str, ...]
    repeated: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether it went as promised."""
        return (self.recovered_s <= PROMISE_S and not self.during and not self.untold
                and not self.repeated)


def recovery_s(cycles: Sequence[CycleRecord], returned_s: float) -> float:
    """Return how long a network took to serve again.

    Parameters
    ----------
    cycles
        Complete cycles.
    returned_s
        When the link came back [s].

    Returns
    -------
    float
        Time to the end of the first cycle that began after that [s]; infinite if there is none.
    """
    return min((cycle.ended_s - returned_s for cycle in cycles if cycle.began_s >= returned_s),
               default=math.inf)


def judge(
        host: str, marks_s: Sequence[float], cycles: Sequence[CycleRecord],
        said: Mapping[str, str], warnings: Mapping[str, Sequence[str]],
        waiters: Sequence[str]) -> Pull:
    """Judge a pull.

    Parameters
    ----------
    host
        Which host.
    marks_s
        When the watch began, the link was pulled, it came back, and the watch ended [s].
    cycles
        Complete cycles.
    said
        What each node has written into its log during the pull.
    warnings
        What the diagnostics of each node have warned of during the pull.
    waiters
        Nodes that must say that they wait.

    Returns
    -------
    Pull
        The verdict.
    """
    began_s, pulled_s, back_s, ended_s = marks_s
    spans_s = [(cycle.began_s, cycle.ended_s) for cycle in cycles]
    counts = (sum(began_s <= end < pulled_s for _, end in spans_s),
              sum(pulled_s + _CUT_S <= start and end < back_s for start, end in spans_s),
              sum(back_s <= end <= ended_s for _, end in spans_s))
    lines = {node: [line.partition(_WAITS)[2] for line in text.splitlines() if _WAITS in line]
             for node, text in said.items()}
    wait = tuple(sorted(node for node, texts in lines.items() if texts))
    diagnosed = tuple(sorted(node for node, texts in warnings.items()
                             if any(text.startswith(_WAITS) for text in texts)))
    spoke = tuple(sorted(node for node, text in said.items() if _WARNS in text))
    return Pull(
        host, back_s - pulled_s, recovery_s(cycles, back_s), *counts, spoke, diagnosed,
        untold=tuple(node for node in waiters if node not in wait or node not in diagnosed),
        repeated=tuple(sorted(node for node, texts in lines.items()
                              if max(collections.Counter(texts).values(), default=0) > 1)))


def figures(pulls: Sequence[Pull]) -> dict[str, Any]:
    """Return the pulls as JSON takes them.

    Parameters
    ----------
    pulls
        The pulls, at least one.

    Returns
    -------
    dict
        ``pulls`` and ``worst_recovery_s``; None in place of infinite times.
    """
    worst_s = max(pull.recovered_s for pull in pulls)
    return {'pulls': [{**dataclasses.asdict(pull), 'recovered_s': _finite(pull.recovered_s)}
                      for pull in pulls],
            'worst_recovery_s': _finite(worst_s)}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def table(pulls: Sequence[Pull]) -> str:
    """Write one line for each pull.

    Parameters
    ----------
    pulls
        The pulls.

    Returns
    -------
    str
        The table, with its head.
    """
    head = f'{"host":14}pulled  recovered  cycles before  during  after  who said so'
    return '\n'.join([head, f'{"":14}   [s]        [s]', *(
        f'{pull.host:14}{pull.pulled_s:6.1f}{pull.recovered_s:11.2f}{pull.before:15d}'
        f'{pull.during:8d}{pull.after:7d}  {_who(pull)}' for pull in pulls)])


def _who(pull: Pull) -> str:
    words = [', '.join(pull.said) or 'nobody']
    if pull.untold:
        words.append(f'NOT {", ".join(pull.untold)}')
    if pull.repeated:
        words.append(f'MORE THAN ONCE {", ".join(pull.repeated)}')
    return '; '.join(words)
