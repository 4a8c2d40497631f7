"""Selection of the node that serves, if several nodes have the same role."""

import dataclasses
import json
import math

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.messages import started
from rhs_isac_ros.protocol.role import NewestDict

# Period of the announcements of a node, and the silence after which the node counts as gone [s].
# Shorter times would load large networks, and nodes on a busy machine would count as gone although
# they are present.
PERIOD_S, SILENCE_S = 0.4, 1.6
# Maximum number of other nodes, which bounds the memory.
_MAX_OTHERS = 64
# Maximum number of other scenarios that are logged.
_MAX_LOGGED = 16
# Maximum length of the list of differences in the log.
_MAX_LENGTH = 500
# Instances that started further in the future are ignored, because their clock is wrong [ns].
_MAX_AHEAD_NS = 3600 * 10**9


@dataclasses.dataclass(frozen=True)
class Presence:
    """The announcement of a node."""

    sender: int  # instance of the node: its start [ns since 1970]
    scenario_id: str
    role: str  # empty until the node has created its publishers and subscriptions
    node: str  # fully qualified name
    scenario: str  # the result of `Scenario.fields`, in JSON

    def __str__(self) -> str:
        """Return the name and the start of the node, for log messages."""
        return f'{self.node}, {started(self.sender)}'


class Presences:
    """Decides from the announcements of other nodes whether this node serves or stands by.

    A node announces itself periodically, and counts as gone when it falls silent. Among the nodes
    with the same role and scenario, the node that started last serves. A restarted node therefore
    serves at once, and an older node resumes when the newer one has gone. Nodes with another
    scenario are reported and otherwise ignored.

    The times `now_s` [s] are on a clock that stops while this node cannot receive announcements.
    """

    def __init__(self, own: Presence) -> None:
        self.own = own
        # Latest announcement of each other node, and its time of arrival [s], by instance.
        self._known: NewestDict[int, tuple[Presence, float]] = NewestDict(_MAX_OTHERS)
        self._now_s = -math.inf
        # The newest other node of the role; and the instance of the older node that was logged
        # last, so that it is not logged again when it returns after a suspension.
        self._rival: Presence | None = None
        self._logged_older = 0
        # Description of the differences from each other scenario, by scenario id.
        self._scenarios: NewestDict[str, str] = NewestDict(_MAX_OTHERS)
        self._n_logged = 0

    def add(self, other: Presence, now_ns: int, now_s: float) -> list[LogMessage]:
        """Process an announcement received at `now_ns` [ns since 1970]; return log messages."""
        if other.sender in (0, self.own.sender) or other.sender > now_ns + _MAX_AHEAD_NS:
            return []
        self._known.put(other.sender, (other, now_s))
        return [*(self._report_scenario(other) if self._is_stranger(other) else []),
                *self.update(now_s)]

    def update(self, now_s: float) -> list[LogMessage]:
        """Forget conflicts with absent nodes, choose the serving node, and return log messages."""
        self._now_s = now_s
        present = self._present()
        ended = sorted(self._scenarios.keys() - {other.scenario_id for other in present})
        for scenario_id in ended:
            del self._scenarios[scenario_id]
        return [*(LogMessage(f'no node with scenario {scenario_id} is left')
                  for scenario_id in ended), *self._choose(present)]

    def silent(self) -> set[str]:
        """Return the names of nodes that have announced a role, but no longer do so.

        They include a node that has been restarted after a crash and has not taken its role yet.
        The ROS graph may still contain the publishers and subscriptions of its predecessor.
        """
        return {other.node for other, _ in self._known.values() if other.role} - {
            other.node for other in self._present() if other.role}

    def _present(self) -> list[Presence]:
        return [other for other, last_s in self._known.values()
                if self._now_s - last_s < SILENCE_S]

    def _is_stranger(self, other: Presence) -> bool:
        return other.scenario_id not in ('', self.own.scenario_id)

    @property
    def stands_by(self) -> bool:
        """Whether a newer node has the same role."""
        return self.rival > self.own.sender

    @property
    def has_conflicts(self) -> bool:
        """Whether there are other nodes with the same role, or nodes with another scenario."""
        return bool(self._rival or self._scenarios)

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

    def _choose(self, present: list[Presence]) -> list[LogMessage]:
        """Find the newest other node of the role; log a new one, or that this node resumes."""
        own, before = self.own, self._rival if self.stands_by else None
        rivals = [other for other in present
                  if other.role and other.role == own.role and not self._is_stranger(other)]
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
        text = (f'{other.node} uses another scenario, {other.scenario_id}, with '
                f'{_differences(self.own.scenario, other.scenario) or "unknown differences"}; '
                'its messages are dropped')
        self._scenarios.put(other.scenario_id, text)
        self._n_logged += 1
        return [LogMessage(text, warning=True)] if self._n_logged <= _MAX_LOGGED else []


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
