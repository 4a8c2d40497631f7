"""The emulated world: air, multipath, surface and on-board propagation."""

import collections
import dataclasses

import numpy as np

from rhs_isac_ros.link import Beam, capacity
from rhs_isac_ros.model import Scenario, streams
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import draw_multipath
from rhs_isac_ros.model.surface import element_signals, feed_signals
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, Event, Send
from rhs_isac_ros.protocol.role import PlainRole

# Pilots and data that wait for what they need; more belong to no cycle that can be complete.
_MOST_PENDING = 256
# Cycles whose true position is known again when it comes late or doubled.
_MOST_BEGUN = 8


class _Cycle:
    """A user's cycle: the true position, and what the air does to its signals."""

    def __init__(self, scenario: Scenario, truth: m.GroundTruth, seed: int) -> None:
        self.truth = truth
        # Line of sight [N_SB, N_E] and multipath [N_SB, F, N_E] of each band. They are drawn now,
        # while the others prepare, and not when the first pilot waits for them.
        self.los, self.multipath = [], []
        for band in range(scenario.n_bands):
            rng = streams.generator(seed, streams.CHANNEL, truth.user, truth.cycle_id, band)
            self.los.append(los_gain(scenario, truth.position[None], band)[0])
            self.multipath.append(draw_multipath(scenario, band, 1, rng).reshape(
                scenario.n_subbands, scenario.n_frames, scenario.n_elements))


class Channel(PlainRole):
    """The role of the channel.

    A pilot or a packet is answered as soon as the user's true position and the configuration that
    the surface reports are known, in whatever order they come. The position holds for the whole
    cycle: the network is slower than the air that it emulates.

    Parameters
    ----------
    scenario
        The scenario.
    seed
        Seed of the multipath, which depends on it, the user and the cycle alone.
    """

    SENDS = (m.FeedSignals, m.Data)
    RECEIVES = (m.GroundTruth, m.RhsConfiguration, m.Pilot, m.Beam, m.Data)

    def __init__(self, scenario: Scenario, seed: int) -> None:
        super().__init__()
        self._scenario, self._seed = scenario, seed
        self._cycle: _Cycle | None = None
        # The first draw factors covariances: now, not while a user waits.
        draw_multipath(scenario, 0, 1, np.random.default_rng(0))
        self._begun: collections.deque[tuple] = collections.deque(maxlen=_MOST_BEGUN)
        # What the surface reports and which beam it holds, of any cycle that may be coming.
        self._reports: dict[tuple[int, m.Mode, int], np.ndarray] = {}
        self._beams: dict[tuple[int, int], m.Beam] = {}
        self._pending: collections.deque[m.Pilot | m.Data] = collections.deque()

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take a message.

        Parameters
        ----------
        event
            The message.
        now_s
            The time [s].

        Returns
        -------
        list of Action
            Feed signals and delivered data.
        """
        match event:
            case m.GroundTruth() if event.cycle_id:
                self._begin(event)
            case m.RhsConfiguration():
                self._reports[event.cycle_id, event.mode, event.band] = event.analog
            case m.Beam():
                self._beams[event.cycle_id, event.user] = event
            case m.Pilot() | m.Data(stage=m.Stage.OFFERED):
                self._pending.append(event)
            case _:
                return []
        self._forget_overflow()
        return self._answer_pending()

    def _begin(self, truth: m.GroundTruth) -> None:
        # The same cycle at another place is one of a base station that has started anew.
        key = truth.cycle_id, truth.user, *truth.position.tolist()
        if key in self._begun:
            self.counters['duplicate'] += 1
            return
        self._begun.append(key)
        self._cycle = _Cycle(self._scenario, truth, self._seed)
        for event in [e for e in self._pending if e.cycle_id != truth.cycle_id]:
            self._pending.remove(event)
            self.counters['stale'] += 1
        for known in (self._reports, self._beams):
            for key in [key for key in known if key[0] != truth.cycle_id]:
                del known[key]

    def _forget_overflow(self) -> None:
        """Drop the oldest of what belongs to no cycle that can still be complete."""
        while len(self._pending) > _MOST_PENDING:
            self._pending.popleft()
            self.counters['overflow'] += 1
        for known in (self._reports, self._beams):
            while len(known) > _MOST_PENDING:
                del known[next(iter(known))]
                self.counters['overflow'] += 1

    def _answer_pending(self) -> list[Action]:
        if self._cycle is None:
            return []
        actions: list[Action] = []
        truth = self._cycle.truth
        # Each once; what still lacks something goes back to the end.
        for _ in range(len(self._pending)):
            event = self._pending.popleft()
            if event.cycle_id == truth.cycle_id and event.user != truth.user:
                self.counters['wrong_user'] += 1
                continue
            answer = None
            if event.cycle_id == truth.cycle_id:
                answer = self._answer(event, self._cycle)
            if answer is None:
                self._pending.append(event)
            else:
                actions.append(Send(answer))
        return actions

    def _answer(self, event: m.Pilot | m.Data, cycle: _Cycle) -> m.Message | None:
        """Answer an event of the cycle, or return None if something is still missing."""
        if isinstance(event, m.Data):
            return self._deliver(event, cycle)
        applied = self._applied(m.Mode.POSITIONING, event.band, cycle)
        return None if applied is None else self._propagate(event, cycle, applied)

    def _applied(self, mode: m.Mode, band: int, cycle: _Cycle) -> np.ndarray | None:
        """What the surface reports for the cycle [F or 1, N_E], if it has."""
        return self._reports.get((cycle.truth.cycle_id, mode, band))

    def _propagate(self, pilot: m.Pilot, cycle: _Cycle, applied: np.ndarray) -> m.FeedSignals:
        band = pilot.band
        elements = element_signals(
            cycle.los[band], cycle.multipath[band][:, pilot.frame],
            complex(pilot.symbol_re, pilot.symbol_im))
        feeds = feed_signals(self._scenario, band, applied[pilot.frame], elements)
        return m.FeedSignals(
            cycle_id=pilot.cycle_id, user=pilot.user, band=band, frame=pilot.frame, signals=feeds)

    def _deliver(self, data: m.Data, cycle: _Cycle) -> m.Data | None:
        """Pass on what the true channel's capacity carries, and drop the rest."""
        truth = cycle.truth
        beam = self._beams.get((truth.cycle_id, truth.user))
        if beam is None:
            return None
        applied = self._applied(m.Mode.TRANSMISSION, beam.band, cycle)
        if applied is None:
            return None
        used = Beam(applied[0], beam.digital, beam.band)
        rate_bps = float(capacity(self._scenario, used, truth.position[None])[0])
        bits = min(data.bits, rate_bps * data.duration_s // 1)
        return dataclasses.replace(data, stage=m.Stage.DELIVERED, bits=bits)
