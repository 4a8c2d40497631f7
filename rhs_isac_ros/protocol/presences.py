"""Presence of other nodes, and selection of the node that serves in a role, from announcements."""

import dataclasses
import json
import math

from rhs_isac_ros.protocol.messages import started
from rhs_isac_ros.protocol.role import NewestDict
from rhs_isac_ros.support.texts import counted

# Period of the announcements of a node, and the silence after which the node counts as gone [s].
# Shorter times would load large networks, and nodes on a busy machine would count as gone although
# they are present.
PERIOD_S, SILENCE_S = 0.4, 1.6
# Longest period of a node without work [s], and the factor by which periods grow until then.
# A period may grow by less than the ratio of silence and period, so that no node counts as gone.
SLOW_PERIOD_S, _GROWTH = 6.4, 1.5
# Gap between two announcements up to which the period counts as `PERIOD_S`, in periods.
_LATE = 1.3
# Maximum number of other nodes, which bounds the memory.
_MAX_OTHERS = 64
# Maximum length of the list of differences, and of the names of nodes, in a description.
_MAX_LENGTH = 500
# Instances that started further in the future of their own clock are ignored [ns].
_MAX_AHEAD_NS = 3600 * 10**9
# Difference of two clocks that is reported [s]. A latched announcement may be one period old.
_MAX_DIFFERENCE_S = 15.0


@dataclasses.dataclass(frozen=True)
class Presence:
    """The announcement of a node."""

    sender: int  # instance of the node: its start [ns since 1970]
    scenario_id: str
    role: str  # empty until the node has created its endpoints, and when it ends
    node: str  # fully qualified name
    scenario: str  # the result of `Scenario.fields`, in JSON
    use_sim_time: bool = False  # whether the node uses simulated time
    library_id: str = ''  # library of codebooks; empty if the role uses none
    stamp_ns: int = 0  # time of the announcement [ns since 1970, or simulated]; 0: unknown


@dataclasses.dataclass(frozen=True)
class _Heard:
    """The latest announcement of a node."""

    presence: Presence
    last_s: float  # its arrival [s]
    gap_s: float   # time since the previous one [s]
    ahead_s: tuple[float, ...]  # its clock minus that of this node, in the latest two [s]

    @property
    def end_s(self) -> float:
        """Time at which the node counts as gone [s]."""
        periods = max(self.gap_s / PERIOD_S, 1.0) if self.gap_s > _LATE * PERIOD_S else 1.0
        return self.last_s + SILENCE_S * min(periods, SLOW_PERIOD_S / PERIOD_S)


class Presences:
    """The nodes that are present, from their announcements; this node announces `own`.

    A node announces itself periodically, and counts as gone when it has been silent for four times
    the period of its announcements, which grows while the node has no work. Among the nodes with
    the same role and scenario, the node that started last serves. Nodes with another scenario are
    reported and otherwise ignored. A role that this node requires is missing if its node has
    another library of codebooks, which is reported, too. `now_s` is the time of the latest call of
    `add`, or later [s], on a clock that stops while this node cannot receive announcements.
    """

    def __init__(self, own: Presence) -> None:
        self.own, self.now_s = own, -math.inf
        # By instance.
        self._known: NewestDict[int, _Heard] = NewestDict(_MAX_OTHERS)

    def add(self, other: Presence, now_ns: int, now_s: float) -> None:
        """Process an announcement received at `now_ns` [ns since 1970]."""
        self.now_s = now_s
        is_wall = other.stamp_ns and not other.use_sim_time
        reference_ns = other.stamp_ns if is_wall else now_ns
        if other.sender in (0, self.own.sender) or other.sender > reference_ns + _MAX_AHEAD_NS:
            return
        ahead_s: tuple[float, ...] = (1e-9 * (other.stamp_ns - now_ns),) if is_wall else ()
        before = self._known.get(other.sender)
        if before and now_s < before.end_s:
            gap_s = now_s - before.last_s
            # Announcements that arrive at once have waited, for instance while this node stalled.
            is_late = gap_s < PERIOD_S / 2
            ahead_s = before.ahead_s if is_late else (*before.ahead_s[-1:], *ahead_s)
        else:
            # A node without work may remain silent for long, but no rival with an unknown period.
            gap_s = PERIOD_S if other.role == self.own.role else SLOW_PERIOD_S
        self._known.put(other.sender, _Heard(other, now_s, gap_s, ahead_s))

    def next_period_s(self, last_s: float) -> float:
        """Return the period after `last_s` [s] of a node without work.

        It grows, but remains close to the shortest period of the other nodes, one of which has
        work.
        """
        gaps_s = (one.gap_s for one in self._known.values() if self.now_s < one.end_s)
        return min(max(_GROWTH * min(last_s, *gaps_s, SLOW_PERIOD_S), PERIOD_S), SLOW_PERIOD_S)

    def knows(self, instance: int) -> bool:
        """Return whether an instance has been announced."""
        return instance in self._known

    def newest(self, role: str) -> int:
        """Return the instance that started last among the other nodes of a role; 0 if none.

        It is also 0 if this node has another role, and that node has another library.
        """
        latest = max(self._of_role(role), key=lambda other: other.sender, default=None)
        is_usable = latest and (role == self.own.role or not self._has_other_library(latest))
        return latest.sender if latest and is_usable else 0

    @property
    def stands_by(self) -> bool:
        """Whether a newer node has the same role."""
        return self.newest(self.own.role) > self.own.sender

    def conflicts(self) -> dict[str, str]:
        """Return a description of each conflict, by its key in the diagnostics."""
        own, present, found = self.own, self._present(), {}
        if rivals := self._of_role(own.role):
            rival = max(rivals, key=lambda other: other.sender)
            relation = 'stands by for' if self.stands_by else 'serves instead of'
            found['conflict.role'] = (f'two nodes act as {own.role}: this one {relation} '
                                      f'{rival.node}, {started(rival.sender)}')
        if strangers := [other for other in present if self._is_stranger(other)]:
            first = min(strangers, key=lambda other: (other.node, other.scenario_id))
            found['conflict.scenario'] = (
                f'{first.node}{_others(len(strangers) - 1)} uses another scenario, '
                f'{first.scenario_id}, with '
                f'{_differences(own.scenario, first.scenario) or "unknown differences"}; '
                'its messages are dropped')
        if divergent := [other for other in present if self._has_other_library(other)]:
            first = min(divergent, key=lambda other: (other.node, other.library_id))
            found['conflict.library'] = (
                f'{first.node}: library of codebooks {first.library_id}, expected '
                f'{own.library_id} of this node; set the same library_file')
        if names := {other.node for other in present if other.use_sim_time != own.use_sim_time}:
            found['conflict.clock'] = (
                f'{", ".join(sorted(names))[:_MAX_LENGTH]}: use_sim_time '
                f'{str(not own.use_sim_time).lower()}, expected the value of this node')
        if off := [(one.presence.node, one.ahead_s[-1]) for one in self._known.values()
                   if self.now_s < one.end_s and len(one.ahead_s) > 1
                   and not own.use_sim_time and min(map(abs, one.ahead_s)) > _MAX_DIFFERENCE_S]:
            node, ahead_s = min(off)
            found['conflict.host_clock'] = (
                f'clock of the host of {node}{_others(len(off) - 1)}: {abs(ahead_s):.0f} s '
                f'{"ahead of" if ahead_s > 0 else "behind"} that of this node, expected the same '
                'time on all hosts')
        return found

    def _present(self) -> list[Presence]:
        return [one.presence for one in self._known.values() if self.now_s < one.end_s]

    def _of_role(self, role: str) -> list[Presence]:
        return [other for other in self._present()
                if role and other.role == role and not self._is_stranger(other)]

    def _has_other_library(self, other: Presence) -> bool:
        return (not self._is_stranger(other) and bool(self.own.library_id and other.library_id)
                and other.library_id != self.own.library_id)

    def _is_stranger(self, other: Presence) -> bool:
        return other.scenario_id not in ('', self.own.scenario_id)


def _others(n: int) -> str:
    return f' (and {counted(n, "other")})' if n else ''


def _differences(own_text: str, other_text: str) -> str:
    """Describe the fields in which two scenarios in JSON differ; '' if none can be found."""
    # Anything may be published on the topic. Unlike YAML, JSON has no references, so a short
    # text cannot describe an enormous value. `json.dumps` escapes surrogates, which a log refuses.
    try:
        own, other = json.loads(own_text), json.loads(other_text)
        return '; '.join(
            f'{name} {json.dumps(other.get(name))} instead of {json.dumps(value)}'
            for name, value in own.items() if other.get(name) != value)[:_MAX_LENGTH]
    except (ValueError, AttributeError, RecursionError):
        return ''
