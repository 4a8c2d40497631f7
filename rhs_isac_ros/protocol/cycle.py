"""The signals of one cycle: their collection, by a base station or a receiver, and combination."""

import dataclasses
import enum
from typing import Any

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import reference_s
from rhs_isac_ros.model.measurement import receive_feeds
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Outcome
from rhs_isac_ros.protocol.role import Drops, StateMachine
from rhs_isac_ros.support import streams


@dataclasses.dataclass
class Reception:
    """The signals of one cycle, as they arrive from a channel."""

    cycle_id: int
    codebook: Codebook | None = None  # latest codebook at the begin of the cycle
    user: int = 0  # user of the cycle; 0 if there is none yet
    # Instance of the user, from its acks or else from the first feed signals; 0 if unknown.
    user_instance: int = 0
    # Instance of the channel that sent the first signals; 0 if unknown.
    channel: int = 0
    # Feed signals by band, complex128 [F, N_SB, K].
    signals: dict[int, np.ndarray] = dataclasses.field(default_factory=dict)
    stamp_ns: int = 0  # reference time [ns]; 0 if unknown

    @property
    def codebook_id(self) -> str:
        """Id of the codebook; empty if there is none."""
        return self.codebook.id if self.codebook else ''


class SignalCollector(StateMachine):
    """A role that collects the feed signals of one cycle at a time; `cycle` is the first one.

    The noise of the receiver depends on the seed, the user and the cycle.
    """

    def __init__(self, initial: enum.Enum, scenario: Scenario, seed: int, cycle: Reception
                 ) -> None:
        super().__init__(initial)
        self._scenario, self._seed, self._cycle = scenario, seed, cycle
        self._bands = frozenset(range(scenario.n_bands))
        # Time from the first frame to the reference time of the cycle [ns].
        self._reference_ns = round(1e9 * reference_s(scenario))

    def _silent_bands(self) -> list[int]:
        """Return the bands whose signals are missing, in ascending order."""
        return sorted(self._bands - self._cycle.signals.keys())

    def _wrong_cycle(self, event: m.Message) -> bool:
        return event.cycle_id != self._cycle.cycle_id

    def _wrong_user(self, event: Any) -> bool:
        return bool(event.user != self._cycle.user)

    def _wrong_instance(self, event: m.FeedSignals) -> bool:
        return not (m.same_instance(event.user_instance, self._cycle.user_instance)
                    and m.same_instance(event.sender, self._cycle.channel))

    def _duplicate_signals(self, event: m.FeedSignals) -> bool:
        return event.band in self._cycle.signals

    def _last_signals(self, event: m.FeedSignals) -> bool:
        return self._silent_bands() == [event.band]

    def _store_signals(self, event: m.FeedSignals) -> None:
        """Store the signals of a band, and the instances of user and channel if still unknown."""
        cycle = self._cycle
        cycle.user_instance = cycle.user_instance or event.user_instance
        cycle.channel = cycle.channel or event.sender
        cycle.stamp_ns = cycle.stamp_ns or event.stamp_ns and event.stamp_ns + self._reference_ns
        cycle.signals[event.band] = event.signals

    def _combined(self, noise: bool) -> m.ReceivedSignals:
        """Combine the signals of all bands, which must be complete; `noise` adds noise."""
        cycle = self._cycle
        assert cycle.codebook
        feeds = np.stack([signals for _, signals in sorted(cycle.signals.items())])
        rng = streams.generator(
            self._seed, streams.RECEIVER, cycle.user, cycle.cycle_id) if noise else None
        return m.derive(m.ReceivedSignals, cycle, stamp_ns=cycle.stamp_ns, signals=receive_feeds(
            self._scenario, cycle.codebook, feeds, rng))

    # Conditions under which a message of a cycle is dropped.
    _OF_CYCLE: Drops = {_wrong_cycle: Outcome.WRONG_CYCLE}
    _SAME_USER: Drops = {_wrong_user: Outcome.WRONG_USER}
    _OF_USER: Drops = _OF_CYCLE | _SAME_USER
    _OF_SIGNALS: Drops = _OF_USER | {
        _wrong_instance: Outcome.WRONG_INSTANCE, _duplicate_signals: Outcome.DUPLICATE}
