"""Selection of the node that serves, if several nodes have the same role."""

import collections
import dataclasses
from collections.abc import Mapping
from typing import Any

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.messages import started
from rhs_isac_ros.protocol.role import NewestDict

# Maximum number of nodes in conflict with this one, which bounds the memory.
_MAX_OTHERS = 64
# Maximum number of other scenarios that are logged.
_MAX_LOGGED = 16
# Maximum length of the list of differences in the log.
_MAX_LENGTH = 500
# Instances that start later than this after the present are ignored: their clock is wrong [ns].
_MAX_AHEAD_NS = 3600 * 10**9


@dataclasses.dataclass(frozen=True)
class Presence:
    """The announcement of a node."""

    sender: int  # instance of the node: its start [ns since 1970]
    scenario_id: str
    role: str
    node: str  # fully qualified name
    scenario: Mapping[str, Any]  # as `Scenario.fields` returns it

    def __str__(self) -> str:
        """Return the name and the start of the node, for log messages."""
        return f'{self.node}, {started(self.sender)}'


class Presences:
    """Decides from the announcements of other nodes whether this node serves or stands by.

    Among the nodes with the same role and scenario, the one that started last serves, as with the
    fencing tokens of leases: a restarted node serves at once, and an older node resumes when the
    newer one has gone. Nodes with another scenario are reported and otherwise ignored.
    """

    def __init__(self, own: Presence) -> None:
        self.own = own
        # Nodes in conflict with this one, by instance.
        self._others: NewestDict[int, Presence] = NewestDict(_MAX_OTHERS)
        # The newest other node of the role, and the last older one that was logged: it is not
        # logged again when it returns after a suspension.
        self._rival: Presence | None = None
        self._logged_older = 0
        # Description of the differences from each other scenario, by scenario id.
        self._scenarios: NewestDict[str, str] = NewestDict(_MAX_OTHERS)
        self._n_logged = 0

    def add(self, other: Presence, now_ns: int) -> list[LogMessage]:
        """Process an announcement that arrives at `now_ns` [ns since 1970]."""
        own = self.own
        is_stranger = bool(other.scenario_id) and other.scenario_id != own.scenario_id
        if other.sender in (0, own.sender) or other.sender > now_ns + _MAX_AHEAD_NS or not (
                is_stranger or other.role == own.role):
            return []
        is_new = other.sender not in self._others
        self._others.put(other.sender, other)
        if is_stranger:
            return self._report_scenario(other)
        return self._update() if is_new else []

    def gone(self, announcing: Mapping[str, int]) -> set[str]:
        """Return the names of nodes in conflict that have gone.

        If one of several nodes with the same name has gone, it is unknown which one. The caller
        forgets them all, and the remaining nodes announce themselves again. `announcing` counts
        the nodes that announce themselves by fully qualified name, or '' for an unknown name.
        """
        known = collections.Counter(other.node for other in self._others.values())
        return {name for name, count in known.items()
                if announcing.get(name, 0) + announcing.get('', 0)
                < count + (name == self.own.node)}

    def keep(self, announcing: Mapping[str, int]) -> list[LogMessage]:
        """Forget the nodes that have `gone`, and choose the node that serves."""
        gone = self.gone(announcing)
        for sender in [sender for sender, other in self._others.items() if other.node in gone]:
            del self._others[sender]
        ended = sorted(self._scenarios.keys()
                       - {other.scenario_id for other in self._others.values()})
        for scenario_id in ended:
            del self._scenarios[scenario_id]
        return [*(LogMessage(f'no node with scenario {scenario_id} is left')
                  for scenario_id in ended), *self._update()]

    @property
    def stands_by(self) -> bool:
        """Whether a newer node has the same role."""
        return self.rival > self.own.sender

    @property
    def others(self) -> frozenset[int]:
        """Instances of the nodes in conflict with this one."""
        return frozenset(self._others)

    @property
    def rival(self) -> int:
        """The newest other instance of the same role; 0 if there is none."""
        return self._rival.sender if self._rival else 0

    def conflicts(self) -> dict[str, str]:
        """Return a description of each conflict, by its key in the diagnostics."""
        found = {f'conflict.{scenario_id}': text
                 for scenario_id, text in self._scenarios.items()}
        return found | ({'conflict.role': self._describe()} if self._rival else {})

    def _describe(self) -> str:
        return f'{"stands by for" if self.stands_by else "serves instead of"} {self._rival}'

    def _update(self) -> list[LogMessage]:
        """Find the newest other node of the role; log a change of the node that serves."""
        own, before = self.own, self._rival if self.stands_by else None
        rivals = [other for other in self._others.values()
                  if other.role == own.role and other.scenario_id in ('', own.scenario_id)]
        self._rival = max(rivals, key=lambda other: other.sender, default=None)
        rival = self._rival
        if rival and rival != before and rival.sender != self._logged_older:
            if not self.stands_by:
                self._logged_older = rival.sender
            return [LogMessage(f'two nodes act as {own.role}: this one {self._describe()}',
                               warning=True)]
        if before and not self.stands_by:
            return [LogMessage(f'{before.node} has gone; this node acts as {own.role} again')]
        return []

    def _report_scenario(self, other: Presence) -> list[LogMessage]:
        if other.scenario_id in self._scenarios:
            return []
        own, theirs = self.own.scenario, other.scenario
        differences = [f'{name} {theirs.get(name)} instead of {own.get(name)}'
                       for name in {**own, **theirs} if theirs.get(name) != own.get(name)]
        text = (f'{other.node} uses another scenario, {other.scenario_id}, with '
                f'{"; ".join(differences)[:_MAX_LENGTH] or "unknown differences"}; '
                'its messages are dropped')
        self._scenarios.put(other.scenario_id, text)
        self._n_logged += 1
        return [LogMessage(text, warning=True)] if self._n_logged <= _MAX_LOGGED else []
