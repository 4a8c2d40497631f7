"""The base station: invites, selects, positions and serves one user a cycle."""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.ack_filter import AckFilter, parse_users
from rhs_isac_ros.protocol.base_station_table import STEPS, TABLE, Input, State, timeouts
from rhs_isac_ros.protocol.events import (
    Action,
    CodebookOffered,
    Event,
    PeersChanged,
    Send,
    SettingsOffered,
    Tick,
)
from rhs_isac_ros.protocol.frame_buffer import FrameBuffer
from rhs_isac_ros.protocol.outage_log import OutageLog
from rhs_isac_ros.protocol.pending_settings import PendingSettings
from rhs_isac_ros.protocol.phase_times import PhaseTimes
from rhs_isac_ros.protocol.settings import BaseStationSettings
from rhs_isac_ros.protocol.state_machine import StateMachine
from rhs_isac_ros.protocol.user_scheduler import UserScheduler


class BaseStation(StateMachine):
    """The role of the base station.

    Parameters
    ----------
    rng
        Source of randomness, to select users with.
    receiver
        Function of (codebook, feeds [N_B, F, N_SB, K], user, cycle_id, whether with noise) that
        returns the received signals, complex128 [N_B, N_SB, F].
    first_cycle_id
        Number of the first cycle. One that starts anew must repeat no number of its former life:
        what is still on its way would be taken for its own.
    """

    SENDS = (m.Beacon, m.Grant, m.RhsCommand, m.PilotRequest, m.ReceivedSignals, m.Data,
             m.ProtocolState)
    RECEIVES = (m.Ack, m.RhsConfiguration, m.FeedSignals, m.PositionEstimate, m.NoFix, m.Beam,
                m.Data)

    TABLE = TABLE
    LACKING = frozenset({State.WAITING})

    def __init__(
            self, scenario: Scenario, settings: BaseStationSettings, rng: np.random.Generator,
            receiver: Callable[[Codebook, np.ndarray, int, int, bool], np.ndarray],
            first_cycle_id: int = 1) -> None:
        super().__init__(State.WAITING, {})
        self._scenario, self._receiver = scenario, receiver
        self._roster = UserScheduler(settings.policy, rng)
        self._settings = PendingSettings(settings)
        self._use(settings)
        self._refusal = ''
        self._codebook: Codebook | None = None
        self._offered: Codebook | None = None
        self._missing: tuple[str, ...] | None = None
        self._complaints, self._times = OutageLog(), PhaseTimes()
        self._cycle_id = first_cycle_id - 1
        self._attempt = 0
        self._user, self._band = 0, 0
        self._frames = FrameBuffer(scenario.sizes)
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

    def status(self) -> Mapping[str, str]:
        """Return the settings and the codebook in use, and the settings that wait.

        Returns
        -------
        Mapping
            Values by name.
        """
        return self._settings.describe() | {'codebook_id': self._codebook_id}

    def _classify(self, event: Event) -> Input:
        match event:
            case Tick():
                return self._classify_tick()
            case CodebookOffered():
                waiting = self.state is State.WAITING
                ready = Input.READY if self._missing == () else Input.NOT_READY
                return ready if waiting else Input.CODEBOOK
            case SettingsOffered():
                return Input.SETTINGS
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
        lacks = self._missing or not self._offered
        if lacks and self.state in (State.RESTING, State.BEACONING):
            return Input.NOT_READY
        again = self.state in STEPS and self.repeats < self._settings.in_use.retries
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
        if feeds in self._frames:
            return Input.DUPLICATE
        if self._frames.missing(self._band) > 1:
            return Input.FRAME
        return Input.LAST_FRAME_OF_BAND if self._frames.missing() > 1 else Input.LAST_FRAME

    @property
    def _codebook_id(self) -> str:
        return self._codebook.id if self._codebook else ''

    def _keep(self, event: CodebookOffered | PeersChanged, now_s: float) -> None:
        if isinstance(event, PeersChanged):
            self._missing = event.missing
        else:
            self._offered = event.codebook

    def _keep_settings(self, event: SettingsOffered, now_s: float) -> None:
        self._settings.newest = event.settings

    def _settle(self, event: Event, now_s: float) -> list[Action]:
        # Between two cycles, or before anybody was granted one.
        notes = self._settings.settle()
        if notes:
            self._use(self._settings.in_use)
        return notes

    def _use(self, settings: BaseStationSettings) -> None:
        self._roster.follow(settings.policy)
        self._gate = AckFilter(parse_users(settings.allowed_users), settings.ack_rate_hz)
        self._timeouts_s = timeouts(settings)

    def _complain(self, event: Event, now_s: float) -> list[Action]:
        if self._missing is None:
            return []
        return self._complaints.waiting(
            [*self._missing, *([] if self._offered else ['codebook'])])

    def _begin_cycle(self, event: Event, now_s: float) -> list[Action]:
        self._codebook = self._offered
        self._complaints.begun()
        self._cycle_id += 1
        self._attempt = self._user = self._band = 0
        self._frames, self._beam, self._applied = FrameBuffer(self._scenario.sizes), None, False
        self._roster.open()
        return self._beacon(now_s)

    def _beacon_again(self, event: Event, now_s: float) -> list[Action]:
        # Nothing of the cycle depends on the codebook before the grant.
        self._attempt += 1
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
        self.counters.update('user_lost' for _ in lost)
        self._user = self._roster.select()
        self._band = -1
        return [Send(m.Grant(self._cycle_id, self._user)), *self._complaints.lost(lost)]

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
        self._frames.keep(event)

    def _deliver(self, event: Event, now_s: float) -> list[Action]:
        signals = self._receiver(self._codebook, self._frames.stack(), self._user,
                                 self._cycle_id, self._settings.in_use.receiver_noise)
        self._received = m.ReceivedSignals(self._cycle_id, self._user, self._codebook_id, signals)
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
        span_s = self._settings.in_use.data_duration_s
        return [Send(m.Data(self._cycle_id, self._user, m.Direction.DOWNLINK, m.Stage.OFFERED,
                            span_s, self._beam.expected_bps * span_s // 1))]

    def _forget_user(self, event: Event, now_s: float) -> None:
        self._roster.forget(self._user)

    def _abandon(self, event: Event, now_s: float) -> list[Action]:
        reason = TABLE[self.state, self._classify(event)].counts
        return [Send(self._times.end(reason, self._cycle_id, self._user, now_s)),
                *self._complaints.given_up(self._cycle_id, self._user, reason),
                *self._settle(event, now_s)]

    def _finish(self, event: Event, now_s: float) -> list[Action]:
        return [Send(self._times.end('served', self._cycle_id, self._user, now_s)),
                *self._complaints.served(self._cycle_id, self._user),
                *self._settle(event, now_s)]

    def _announce(self, phase: m.Phase, now_s: float) -> list[Action]:
        return [Send(self._times.begin(phase, self._cycle_id, self._user, now_s))]
