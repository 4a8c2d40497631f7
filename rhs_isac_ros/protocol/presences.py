"""Presence of other nodes, and selection of the node that serves in a role, from announcements."""

import dataclasses
import json
import math

from rhs_isac_ros.protocol.messages import started
from rhs_isac_ros.protocol.role import NewestDict

# Period of the announcements of a node, and the silence after which the node counts as gone [s].
# Shorter times would load large networks, and nodes on a busy machine would count as gone although
# they are present.
PERIOD_S, SILENCE_S = 0.4, 1.6
# Maximum number of other nodes, which bounds the memory.
_MAX_OTHERS = 64
# Maximum length of the list of differences, and of the names of nodes, in a description.
_MAX_LENGTH = 500
# Instances that started further in the future are ignored, because their clock is wrong [ns].
_MAX_AHEAD_NS = 3600 * 10**9


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


class Presences:
    """The nodes that are present, from their announcements; this node announces `own`.

    A node announces itself periodically, and counts as gone when it falls silent. Among the nodes
    with the same role and scenario, the node that started last serves. Nodes with another scenario
    are reported and otherwise ignored. A role that this node requires is missing if its node has
    another library of codebooks, which is reported, too. `now_s` is the time of the latest call of
    `add`, or later [s], on a clock that stops while this node cannot receive announcements.
    """

    def __init__(self, own: Presence) -> None:
        self.own, self.now_s = own, -math.inf
        # Latest announcement of each other node, and its time of arrival [s], by instance.
        self._known: NewestDict[int, tuple[Presence, float]] = NewestDict(_MAX_OTHERS)

    def add(self, other: Presence, now_ns: int, now_s: float) -> None:
        """Process an announcement received at `now_ns` [ns since 1970]."""
        self.now_s = now_s
        if other.sender not in (0, self.own.sender) and other.sender <= now_ns + _MAX_AHEAD_NS:
            self._known.put(other.sender, (other, now_s))

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
            others = f' (and {len(strangers) - 1} others)' if len(strangers) > 1 else ''
            found['conflict.scenario'] = (
                f'{first.node}{others} uses another scenario, {first.scenario_id}, with '
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
        return found

    def _present(self) -> list[Presence]:
        return [other for other, last_s in self._known.values()
                if self.now_s - last_s < SILENCE_S]

    def _of_role(self, role: str) -> list[Presence]:
        return [other for other in self._present()
                if role and other.role == role and not self._is_stranger(other)]

    def _has_other_library(self, other: Presence) -> bool:
        return (not self._is_stranger(other) and bool(self.own.library_id and other.library_id)
                and other.library_id != self.own.library_id)

    def _is_stranger(self, other: Presence) -> bool:
        return other.scenario_id not in ('', self.own.scenario_id)


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
