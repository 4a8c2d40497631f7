"""The base station: invites, selects, positions and serves one user a cycle."""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.bs_table import STEPS, TABLE, Input, State
from rhs_isac_ros.protocol.complaints import Complaints
from rhs_isac_ros.protocol.events import (
    Action,
    CodebookOffered,
    Event,
    Note,
    PeersChanged,
    Send,
    Tick,
)
from rhs_isac_ros.protocol.gate import Gate
from rhs_isac_ros.protocol.machine import Machine
from rhs_isac_ros.protocol.phase_times import PhaseTimes
from rhs_isac_ros.protocol.roster import Roster


class BaseStation(Machine):
    """The role of the base station.

    Parameters
    ----------
    scenario
        The scenario.
    roster
        Whom it knows and selects.
    receiver
        Function of (codebook, feeds [N_B, F, N_SB, K], user, cycle_id) that returns the received
        signals, complex128 [N_B, N_SB, F].
    timeouts_s
        Time-outs by state; at least RESTING, the pause between cycles.
    data_duration_s
        How long each direction transmits data [s].
    first_cycle_id
        Number of the first cycle. One that starts anew must repeat no number of its former life:
        what is still on its way would be taken for its own.
    gate
        Whose acks it takes; by default all.
    retries
        How often a step of a cycle is asked for again, before the cycle is given up.
    """

    TABLE = TABLE
    LACKING = frozenset({State.WAITING})

    def __init__(
            self, scenario: Scenario, roster: Roster,
            receiver: Callable[[Codebook, np.ndarray, int, int], np.ndarray],
            timeouts_s: Mapping[State, float], data_duration_s: float,
            first_cycle_id: int = 1, gate: Gate | None = None, retries: int = 0) -> None:
        super().__init__(State.WAITING, timeouts_s)
        self._scenario, self._roster, self._receiver = scenario, roster, receiver
        self._data_duration_s = data_duration_s
        self._gate, self._retries = gate or Gate(), retries
        self._refusal = ''
        self._codebook: Codebook | None = None
        self._offered: Codebook | None = None
        self._missing: tuple[str, ...] | None = None
        self._complaint = ''
        self._complaints, self._times = Complaints(), PhaseTimes()
        self._cycle_id = first_cycle_id - 1
        self._attempt = 0
        self._user = 0
        self._band = 0
        self._frames: dict[tuple[int, int], np.ndarray] = {}
        self._received: m.ReceivedSignals | None = None
        self._beam: m.Beam | None = None
        self._applied = False

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take an event; an ack goes through the gate first.

        Parameters
        ----------
        event
            A message, or something local.
        now_s
            The time, on any clock that only goes forward [s].

        Returns
        -------
        list of Action
            What to do, in this order.
        """
        if isinstance(event, m.Ack):
            self._refusal = self._gate.refusal(event.user, now_s)
        return super().handle(event, now_s)

    def _classify(self, event: Event) -> Input:
        match event:
            case Tick():
                return self._classify_tick()
            case CodebookOffered():
                waiting = self.state is State.WAITING
                ready = Input.READY if self._missing == () else Input.NOT_READY
                return ready if waiting else Input.CODEBOOK
            case PeersChanged(missing):
                waiting = self.state is State.WAITING
                ready = Input.NOT_READY if missing or not self._offered else Input.READY
                return ready if waiting else Input.PEERS
            case m.Ack():
                return self._classify_ack(event)
            case m.Data():
                return self._classify_data(event)
        if event.cycle_id != self._cycle_id:
            return Input.WRONG_CYCLE
        if getattr(event, 'user', self._user) != self._user:
            return Input.WRONG_USER
        if getattr(event, 'codebook_id', self._codebook_id) != self._codebook_id:
            return Input.WRONG_CODEBOOK
        match event:
            case m.RhsConfiguration(mode=m.Mode.POSITIONING):
                return Input.CONFIGURED if event.band == self._band else Input.WRONG_BAND
            case m.RhsConfiguration():
                return Input.BEAM_READY if self._beam else Input.BEAM_APPLIED
            case m.FeedSignals():
                return self._classify_frame(event)
            case m.PositionEstimate():
                return Input.ESTIMATE
            case m.NoFix():
                return Input.NO_FIX
            case m.Beam():
                return Input.BEAM_READY if self._applied else Input.BEAM
        raise TypeError(f'{type(event).__name__} is no event of a base station')

    def _classify_tick(self) -> Input:
        if self.state is State.BEACONING and self._roster.answered:
            return Input.WINDOW_OVER
        idle = self.state in (State.RESTING, State.BEACONING)
        if idle and (self._missing or not self._offered):
            return Input.NOT_READY
        again = self.state in STEPS and self.repeats < self._retries
        return Input.RETRY if again else Input.TIMEOUT

    def _classify_ack(self, ack: m.Ack) -> Input:
        if self._refusal:
            return Input(self._refusal)
        if ack.cycle_id != self._cycle_id:
            return Input.WRONG_CYCLE
        if ack.user in self._roster.answered:
            return Input.DUPLICATE
        if self._roster.is_full_for(ack.user):
            return Input.CROWDED
        if self.state is not State.BEACONING:
            return Input.LATE_ACK
        return Input.LAST_ACK if self._roster.complete_with(ack.user) else Input.ACK

    def _classify_data(self, data: m.Data) -> Input:
        if data.stage is m.Stage.OFFERED or data.direction is m.Direction.DOWNLINK:
            return Input.OTHER_DATA
        if data.cycle_id != self._cycle_id:
            return Input.WRONG_CYCLE
        return Input.DELIVERED if data.user == self._user else Input.WRONG_USER

    def _classify_frame(self, feeds: m.FeedSignals) -> Input:
        if feeds.band != self._band:
            return Input.WRONG_BAND
        if (feeds.band, feeds.frame) in self._frames:
            return Input.DUPLICATE
        sizes = self._scenario.sizes
        missing = (self._band + 1) * sizes['F'] - len(self._frames) - 1
        if missing:
            return Input.FRAME
        return Input.LAST_FRAME if self._band + 1 == sizes['N_B'] else Input.LAST_FRAME_OF_BAND

    @property
    def _codebook_id(self) -> str:
        return self._codebook.id if self._codebook else ''

    def _keep(self, event: CodebookOffered | PeersChanged, now_s: float) -> None:
        if isinstance(event, PeersChanged):
            self._missing = event.missing
        else:
            self._offered = event.codebook

    def _complain(self, event: Event, now_s: float) -> list[Action]:
        if self._missing is None:
            return []
        needs = [*self._missing, *([] if self._offered else ['codebook'])]
        complaint = f'waiting for {", ".join(needs)}'
        if complaint == self._complaint:
            return []
        self._complaint = complaint
        return [Note(complaint, warning=True)]

    def _begin_cycle(self, event: Event, now_s: float) -> list[Action]:
        self._codebook = self._offered
        self._complaint = ''
        self._cycle_id += 1
        self._attempt = 0
        self._user, self._band = 0, 0
        self._frames, self._beam, self._applied = {}, None, False
        self._roster.open()
        return self._beacon(now_s)

    def _beacon_again(self, event: Event, now_s: float) -> list[Action]:
        self._attempt += 1
        # Nothing of the cycle depends on the codebook before the grant.
        self._codebook = self._offered
        return self._beacon(now_s)

    def _beacon(self, now_s: float) -> list[Action]:
        self._times.beacon(now_s)
        return [Send(m.Beacon(self._cycle_id, self._attempt))]

    def _note_ack(self, event: m.Ack, now_s: float) -> None:
        self._roster.answer(event.user)

    def _welcome(self, event: m.Ack, now_s: float) -> None:
        self._roster.welcome(event.user)

    def _grant(self, event: Event, now_s: float) -> list[Action]:
        lost = self._roster.give_up()
        self.counters.update({'user_lost': len(lost)} if lost else {})
        self._user = self._roster.select()
        self._band = -1
        return [Send(m.Grant(self._cycle_id, self._user)),
                *(Note(f'user {user} answers no more', warning=True) for user in lost)]

    def _announce_positioning(self, event: Event, now_s: float) -> list[Action]:
        return self._announce(m.Phase.POSITIONING, now_s)

    def _command_band(self, event: Event, now_s: float) -> list[Action]:
        self._band += 1
        return self._command_again(event, now_s)

    def _command_again(self, event: Event, now_s: float) -> list[Action]:
        return [Send(m.RhsCommand(self._cycle_id, self._band, self._codebook_id))]

    def _request_pilots(self, event: Event, now_s: float) -> list[Action]:
        return [Send(m.PilotRequest(
            self._cycle_id, self._user, self._band, self._scenario.n_frames))]

    def _keep_frame(self, event: m.FeedSignals, now_s: float) -> None:
        self._frames[event.band, event.frame] = event.signals

    def _deliver(self, event: Event, now_s: float) -> list[Action]:
        sizes = self._scenario.sizes
        feeds = np.stack([[self._frames[band, frame] for frame in range(sizes['F'])]
                          for band in range(sizes['N_B'])])
        signals = self._receiver(self._codebook, feeds, self._user, self._cycle_id)
        self._received = m.ReceivedSignals(
            self._cycle_id, self._user, self._codebook_id, signals)
        return [Send(self._received), *self._announce(m.Phase.ESTIMATING, now_s)]

    def _deliver_again(self, event: Event, now_s: float) -> list[Action]:
        return [Send(self._received)]

    def _keep_beam(self, event: m.Beam | m.RhsConfiguration, now_s: float) -> None:
        if isinstance(event, m.Beam):
            self._beam = event

    def _keep_applied(self, event: Event, now_s: float) -> None:
        self._applied = True

    def _offer_data(self, event: Event, now_s: float) -> list[Action]:
        return [*self._offer_again(event, now_s), *self._announce(m.Phase.TRANSMITTING, now_s)]

    def _offer_again(self, event: Event, now_s: float) -> list[Action]:
        bits = self._beam.expected_bps * self._data_duration_s // 1
        return [Send(m.Data(self._cycle_id, self._user, m.Direction.DOWNLINK, m.Stage.OFFERED,
                            self._data_duration_s, bits))]

    def _forget_user(self, event: Event, now_s: float) -> None:
        self._roster.forget(self._user)

    def _abandon(self, event: Event, now_s: float) -> list[Action]:
        reason = TABLE[self.state, self._classify(event)].counts
        return [Send(self._times.end(reason, self._cycle_id, self._user, now_s)),
                *self._complaints.given_up(self._cycle_id, self._user, reason)]

    def _finish(self, event: Event, now_s: float) -> list[Action]:
        return [Send(self._times.end('served', self._cycle_id, self._user, now_s)),
                *self._complaints.served(self._cycle_id, self._user)]

    def _announce(self, phase: m.Phase, now_s: float) -> list[Action]:
        return [Send(self._times.begin(phase, self._cycle_id, self._user, now_s))]
