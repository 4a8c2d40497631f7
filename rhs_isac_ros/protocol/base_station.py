"""The base station, which sends beacons, then selects, positions and serves a user per cycle."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station_memory import (
    NOT_BEACONING,
    AckFilter,
    Cycle,
    OutageLog,
    State,
    UserInstances,
    UserScheduler,
    parse_users,
    timeouts,
)
from rhs_isac_ros.protocol.events import (
    Action,
    CodebookOffered,
    Event,
    LocateRequested,
    LogMessage,
    Outcome,
    PauseRequested,
    PeersChanged,
    Reply,
    Resumed,
    ResumeRequested,
    Send,
    SettingsOffered,
    StepRequested,
    StoodBy,
    Timeout,
)
from rhs_isac_ros.protocol.role import ANY, EventT, StateMachine, Transition, always
from rhs_isac_ros.protocol.settings import BaseStationSettings, PendingSettings


class Row(Transition[State, 'BaseStation', EventT]):
    """A row of the table."""


def give_up(
        source: State, event: type[EventT], outcome: Outcome,
        before: tuple[Callable[['BaseStation', EventT, float], Iterable[Action] | None], ...] = (),
) -> Row[EventT]:
    """Return a row that ends the cycle without service; `outcome` is counted and published."""
    def abandon(role: 'BaseStation', event: EventT, now_s: float) -> list[Action]:
        return role.abandon(event, now_s, outcome)

    return Row((source,), event, always, (*before, abandon), State.RESTING, outcome)


def reply(success: bool, text: str) -> Callable[['BaseStation', Event, float], list[Action]]:
    """Return an action that answers an operator; see `BaseStation.fill` for placeholders."""
    def reply(role: 'BaseStation', event: Event, now_s: float) -> list[Action]:
        return [Reply(success, role.fill(text))]

    return reply


reply_resumed = reply(True, 'resumed{waiting}')


class BaseStation(StateMachine[State]):
    """The role of the base station.

    Parameters
    ----------
    rng
        Source of randomness for the policy ``random``.
    receiver
        Callable that takes (codebook, feeds [N_B, F, N_SB, K], user, cycle_id, whether to add
        noise) and returns the received signals, complex128 [N_B, N_SB, F].
    first_cycle_id
        Id of the first cycle. After a restart, it must exceed all ids used before, so that
        messages still in transit are recognised as stale.
    """

    SENDS = (m.Beacon, m.Grant, m.RhsCommand, m.PilotRequest, m.ReceivedSignals, m.Data,
             m.ProtocolState)
    RECEIVES = (m.Ack, m.RhsConfiguration, m.FeedSignals, m.PositionEstimate, m.NoFix, m.Beam,
                m.Data)

    STATES = State
    EVENT_NAMES = {
        CodebookOffered: 'codebook', PeersChanged: 'peers', SettingsOffered: 'settings',
        PauseRequested: 'pause', ResumeRequested: 'resume', StepRequested: 'step',
        LocateRequested: 'locate', StoodBy: 'stood_by', Resumed: 'resumed', Timeout: 'timeout',
        m.Ack: 'ack', m.RhsConfiguration: 'configured', m.FeedSignals: 'signals',
        m.PositionEstimate: 'estimate', m.NoFix: 'no_fix', m.Beam: 'beam', m.Data: 'delivered'}
    BLOCKED_STATES = frozenset({State.WAITING})
    WORLD_STATES = frozenset({State.RESTING})

    def __init__(
            self, scenario: Scenario, settings: BaseStationSettings, rng: np.random.Generator,
            receiver: Callable[[Codebook, np.ndarray, int, int, bool], np.ndarray],
            first_cycle_id: int = 1) -> None:
        super().__init__(State.WAITING, {})
        self._scenario, self._receiver = scenario, receiver
        self._users, self._instances = UserScheduler(settings.policy, rng), UserInstances()
        self._settings = PendingSettings(settings)
        self._pausing = False  # whether a pause begins after the current cycle
        self._use(settings)
        # The codebook of the current cycle, and the one for the next.
        self._codebook: Codebook | None = None
        self._offered: Codebook | None = None
        # Roles that are missing; None before the first report.
        self._missing: tuple[str, ...] | None = None
        self._outages, self._cycle = OutageLog(), Cycle(first_cycle_id - 1)

    def _use(self, settings: BaseStationSettings) -> None:
        self._users.set_policy(settings.policy)
        self._ack_filter = AckFilter(
            parse_users(settings.allowed_users), settings.ack_rate_hz, settings.max_users)
        self._timeouts_s = timeouts(settings, self._pausing)

    def status(self) -> Mapping[str, str]:
        """Return the settings and the codebook in use, pending settings and conflicts."""
        return (self._settings.describe() | {'codebook_id': self._codebook_id}
                | self._instances.conflicts())

    @property
    def _codebook_id(self) -> str:
        return self._codebook.id if self._codebook else ''

    # Guards

    def not_ready(self, event: Event, now_s: float) -> bool:
        """Whether a role or the codebook is missing."""
        return self._missing != () or not self._offered

    def pausing(self, event: Event, now_s: float) -> bool:
        """Whether an operator has requested a pause."""
        return self._pausing

    def peers_present(self, event: CodebookOffered, now_s: float) -> bool:
        """Whether all roles are present."""
        return self._missing == ()

    def ready_with_peers(self, event: PeersChanged, now_s: float) -> bool:
        """Whether all roles are present now and a codebook was offered."""
        return not event.missing and self._offered is not None

    def some_acks(self, event: Timeout, now_s: float) -> bool:
        """Whether at least one user answered the beacon."""
        return bool(self._users.answered)

    def may_retry(self, event: Timeout, now_s: float) -> bool:
        """Whether the current step may be requested again."""
        return self.repeats < self._settings.in_use.retries

    def wrong_cycle(self, event: m.Message, now_s: float) -> bool:
        """Whether a message belongs to another cycle."""
        return event.cycle_id != self._cycle.id

    def wrong_user(self, event: Any, now_s: float) -> bool:
        """Whether a message concerns a user other than the granted one."""
        return bool(event.user != self._cycle.user)

    def wrong_instance(self, event: m.FeedSignals, now_s: float) -> bool:
        """Whether feed signals concern another instance of the user or of the channel."""
        cycle = self._cycle
        return not (m.same_instance(event.user_instance, cycle.user_instance)
                    and m.same_instance(event.sender, cycle.channel))

    def wrong_codebook(self, event: Any, now_s: float) -> bool:
        """Whether a message refers to another codebook."""
        return bool(event.codebook_id != self._codebook_id)

    def duplicate_signals(self, event: m.FeedSignals, now_s: float) -> bool:
        """Whether the signals of the band were received before."""
        return event.band in self._cycle.signals

    def not_delivered_uplink(self, event: m.Data, now_s: float) -> bool:
        """Whether data are anything other than uplink data delivered by the channel."""
        return event.stage is m.Stage.OFFERED or event.direction is m.Direction.DOWNLINK

    def not_allowed(self, event: m.Ack, now_s: float) -> bool:
        """Whether the user is not in the list of allowed users, or its number is too high."""
        return not self._ack_filter.allows(event.user)

    def too_often(self, event: m.Ack, now_s: float) -> bool:
        """Whether the user has reached its rate of acks."""
        return not self._ack_filter.within_rate(event.user, now_s)

    def number_taken(self, event: m.Ack, now_s: float) -> bool:
        """Whether another instance owns the number of the user."""
        return self._instances.is_taken(event.user, event.sender, now_s)

    def duplicate_ack(self, event: m.Ack, now_s: float) -> bool:
        """Whether the user acknowledged this cycle before."""
        return event.user in self._users.answered

    def last_ack(self, event: m.Ack, now_s: float) -> bool:
        """Whether the ack completes the set of users to wait for."""
        return self._users.is_complete_with(event.user)

    def last_signals(self, event: m.FeedSignals, now_s: float) -> bool:
        """Whether the signals of all other bands have been received."""
        return len(self._cycle.signals | {event.band: event}) == self._scenario.n_bands

    def last_configuration(self, event: m.RhsConfiguration, now_s: float) -> bool:
        """Whether the RHS has reported the configurations of all bands with this report."""
        return (event.mode is m.Mode.POSITIONING
                and len(self._cycle.configured | {event.band}) == self._scenario.n_bands)

    def for_positioning(self, event: m.RhsConfiguration, now_s: float) -> bool:
        """Whether the RHS has reported the configurations of any band."""
        return event.mode is m.Mode.POSITIONING

    def for_beam(self, event: m.RhsConfiguration, now_s: float) -> bool:
        """Whether the RHS has applied the configuration of a beam."""
        return event.mode is m.Mode.TRANSMISSION

    def for_known_beam(self, event: m.RhsConfiguration, now_s: float) -> bool:
        """Whether the RHS has applied a beam that the base station has received."""
        return event.mode is m.Mode.TRANSMISSION and self._cycle.beam is not None

    def beam_applied(self, event: m.Beam, now_s: float) -> bool:
        """Whether the RHS has reported the beam before the beam itself arrived."""
        return self._cycle.beam_applied

    # Actions, in the order of a cycle

    def store_codebook(self, event: CodebookOffered, now_s: float) -> None:
        """Store a codebook for the next cycle."""
        self._offered = event.codebook

    def store_peers(self, event: PeersChanged, now_s: float) -> None:
        """Store which roles are missing."""
        self._missing = event.missing

    def forget_peers(self, event: StoodBy, now_s: float) -> None:
        """Forget which roles are missing, so that no cycle begins until they are known again."""
        self._missing = None

    def skip_cycles(self, event: Resumed, now_s: float) -> None:
        """Skip the ids of cycles that another base station has used."""
        self._cycle = Cycle(max(event.first_cycle_id - 1, self._cycle.id))

    def store_settings(self, event: SettingsOffered, now_s: float) -> None:
        """Store settings until they may be applied."""
        self._settings.latest = event.settings

    def apply_settings(self, event: Event, now_s: float) -> list[Action]:
        """Apply the latest settings."""
        messages = self._settings.apply()
        if messages:
            self._use(self._settings.in_use)
            removed = self._users.remove_all_except(self._ack_filter.allows)
            messages += self._outages.log_removed_users(
                removed, self._settings.in_use.allowed_users)
        return [*messages]

    def log_not_ready(self, event: Event, now_s: float) -> list[Action]:
        """Log what is missing, once the presence of the other roles is known."""
        if self._missing is None:
            return []
        return [*self._outages.log_waiting(self._lacking())]

    def fill(self, text: str) -> str:
        """Fill the id of the cycle, and what the next one lacks, into a text."""
        lacking = ', '.join(self._lacking())
        return text.format(cycle=self._cycle.id, lacking=lacking,
                           waiting=f'; waiting for {lacking}' if lacking else '')

    def _lacking(self) -> tuple[str, ...]:
        roles = ('the other roles',) if self._missing is None else self._missing
        return roles if self._offered else (*roles, 'codebook')

    def prefer_user(self, event: LocateRequested, now_s: float) -> None:
        """Serve a user before others once."""
        self._users.request(event.user)

    def pause(self, event: PauseRequested, now_s: float) -> None:
        """Store that a pause was requested."""
        self._pausing = True
        self._timeouts_s = timeouts(self._settings.in_use, self._pausing)

    def resume(self, event: ResumeRequested, now_s: float) -> list[Action]:
        """Store that no pause is requested, and log that cycles resume."""
        self._pausing = False
        self._timeouts_s = timeouts(self._settings.in_use, self._pausing)
        return [LogMessage('resumed')]

    def log_paused(self, event: PauseRequested | Timeout, now_s: float) -> list[Action]:
        """Log that the pause begins."""
        return [LogMessage(f'paused after cycle {self._cycle.id}')]

    def log_unanswered(self, event: Timeout, now_s: float) -> list[Action]:
        """Log that the pause begins because no user answered the beacon."""
        return [LogMessage(f'paused: no user answered the beacon of cycle {self._cycle.id}')]

    def begin_cycle(self, event: Event, now_s: float) -> list[Action]:
        """Begin a cycle with its first beacon."""
        self._outages.clear_waiting()
        self._cycle = Cycle(self._cycle.id + 1)
        self._users.begin_cycle()
        return self._beacon(now_s)

    def beacon_again(self, event: Timeout, now_s: float) -> list[Action]:
        """Send another beacon of the cycle, which invites more users if not all were invited."""
        # If all users were invited, they may be absent for as long as the base station is alone.
        lost = [] if self._users.all_invited else self._lose_absent(now_s)
        self._cycle.attempt += 1
        return [*self._beacon(now_s), *lost]

    def _beacon(self, now_s: float) -> list[Action]:
        self._codebook = self._offered  # nothing before the grant depends on the codebook
        self._cycle.began_s[m.Phase.BEACONING] = now_s
        first, last = self._users.invite(self._cycle.attempt)
        return [Send(m.Beacon(cycle_id=self._cycle.id, attempt=self._cycle.attempt,
                              first_user=first, last_user=last))]

    def count_ack(self, event: m.Ack, now_s: float) -> None:
        """Count an ack against the user's rate."""
        self._ack_filter.count(event.user, now_s)

    def accept_ack(self, event: m.Ack, now_s: float) -> list[Action]:
        """Add a user to those that may be granted the cycle."""
        self._users.add_answer(event.user)
        return [*self._instances.accept(event.user, event.sender, now_s)]

    def reject_number(self, event: m.Ack, now_s: float) -> None:
        """Count an ack of an instance that does not own the number of the user."""
        self._instances.reject(event.user)

    def register_user(self, event: m.Ack, now_s: float) -> list[Action]:
        """Register a user, for which the next cycle waits as well."""
        self._users.register(event.user)
        return [*self._instances.accept(event.user, event.sender, now_s)]

    def grant(self, event: m.Ack | Timeout, now_s: float) -> list[Action]:
        """Grant the cycle to one of the users that answered."""
        lost = self._lose_absent(now_s)
        cycle = self._cycle
        cycle.user = self._users.select()
        cycle.user_instance = self._instances.owner(cycle.user)
        grant = m.Grant(cycle_id=cycle.id, user=cycle.user, user_instance=cycle.user_instance)
        return [Send(grant), *lost]

    def _lose_absent(self, now_s: float) -> list[Action]:
        """Count the invited users that did not answer, and remove those that no longer do."""
        lost = self._users.remove_absent()
        self.count(Outcome.USER_LOST, len(lost))
        self._instances.forget(lost, now_s)
        return [*self._outages.log_lost_users(lost)]

    def announce_positioning(self, event: Event, now_s: float) -> list[Action]:
        """Publish the phase."""
        return self._announce(m.Phase.POSITIONING, now_s)

    def command_bands(self, event: Event, now_s: float) -> list[Action]:
        """Request the configurations that the RHS has not reported."""
        return self._command(set(range(self._scenario.n_bands)) - self._cycle.configured)

    def command_silent_bands(self, event: Event, now_s: float) -> list[Action]:
        """Request the configurations of the bands whose signals lack."""
        return self._command(set(range(self._scenario.n_bands)) - self._cycle.signals.keys())

    def _command(self, bands: set[int]) -> list[Action]:
        return [Send(m.RhsCommand(cycle_id=self._cycle.id, band=band,
                                  codebook_id=self._codebook_id)) for band in sorted(bands)]

    def store_configured(self, event: m.RhsConfiguration, now_s: float) -> None:
        """Store that the RHS has reported the configurations of a band."""
        self._cycle.configured.add(event.band)

    def request_pilots(self, event: Event, now_s: float) -> list[Action]:
        """Request the pilots of all bands, from the first whose signals lack."""
        return [Send(self._cycle.pilot_request(self._scenario.n_bands, self._scenario.n_frames))]

    def store_signals(self, event: m.FeedSignals, now_s: float) -> None:
        """Store the feed signals of a band; those of all bands come from the same instances."""
        self._cycle.add_signals(event)

    def send_signals(self, event: m.FeedSignals, now_s: float) -> list[Action]:
        """Combine the signals of all bands and send the received signals to the positioner."""
        assert self._codebook
        cycle = self._cycle
        feeds = np.stack([cycle.signals[band] for band in range(self._scenario.n_bands)])
        signals = self._receiver(self._codebook, feeds, cycle.user, cycle.id,
                                 self._settings.in_use.receiver_noise)
        cycle.received = m.ReceivedSignals(
            cycle_id=cycle.id, stamp_ns=cycle.stamp_ns, user=cycle.user,
            user_instance=cycle.user_instance, codebook_id=self._codebook_id, signals=signals)
        return [Send(cycle.received), *self._announce(m.Phase.ESTIMATING, now_s)]

    def resend_signals(self, event: Timeout, now_s: float) -> list[Action]:
        """Send the received signals again."""
        assert self._cycle.received
        return [Send(self._cycle.received)]

    def store_beam(self, event: m.Beam, now_s: float) -> None:
        """Store the beam."""
        self._cycle.beam = event

    def store_beam_applied(self, event: m.RhsConfiguration, now_s: float) -> None:
        """Store that the RHS has applied the beam."""
        self._cycle.beam_applied = True

    def begin_transmission(self, event: Event, now_s: float) -> list[Action]:
        """Send the downlink data and publish the phase."""
        return [*self.send_downlink(event, now_s),
                *self._announce(m.Phase.TRANSMITTING, now_s)]

    def send_downlink(self, event: Event, now_s: float) -> list[Action]:
        """Send as much data as the beam is expected to carry."""
        assert self._cycle.beam
        duration_s = self._settings.in_use.data_duration_s
        return [Send(m.Data(
            cycle_id=self._cycle.id, user=self._cycle.user, direction=m.Direction.DOWNLINK,
            stage=m.Stage.OFFERED, duration_s=duration_s,
            bits=self._cycle.beam.expected_bps * duration_s // 1))]

    def remove_user(self, event: Timeout, now_s: float) -> None:
        """Stop waiting for the user until it answers again."""
        self._users.remove(self._cycle.user)
        self._instances.forget([self._cycle.user], now_s)

    def abandon(self, event: Any, now_s: float, outcome: Outcome) -> list[Action]:
        """End the cycle without service."""
        cycle = self._cycle
        return [Send(cycle.report(m.Phase.BEACONING, now_s, outcome.value)),
                *self._outages.log_lost_cycle(cycle.id, cycle.user, outcome.value),
                *self.apply_settings(event, now_s)]

    def finish(self, event: m.Data, now_s: float) -> list[Action]:
        """End the cycle: the user was served."""
        cycle = self._cycle
        return [Send(cycle.report(m.Phase.BEACONING, now_s, 'served')),
                *self._outages.log_served_cycle(
                    cycle.id, cycle.user, self._codebook_id, self._users.n_users),
                *self.apply_settings(event, now_s)]

    def _announce(self, phase: m.Phase, now_s: float) -> list[Action]:
        self._cycle.began_s[phase] = now_s
        return [Send(self._cycle.report(phase, now_s))]

    # Messages that are dropped in every state, before the rows of the table.
    DROPS = {
        m.Ack: {not_allowed: Outcome.NOT_ALLOWED, too_often: Outcome.TOO_OFTEN},
        m.RhsConfiguration: {wrong_cycle: Outcome.WRONG_CYCLE,
                             wrong_codebook: Outcome.WRONG_CODEBOOK},
        m.FeedSignals: {wrong_cycle: Outcome.WRONG_CYCLE, wrong_user: Outcome.WRONG_USER,
                        wrong_instance: Outcome.WRONG_INSTANCE,
                        duplicate_signals: Outcome.DUPLICATE},
        **dict.fromkeys((m.PositionEstimate, m.NoFix, m.Beam), {
            wrong_cycle: Outcome.WRONG_CYCLE, wrong_user: Outcome.WRONG_USER,
            wrong_codebook: Outcome.WRONG_CODEBOOK}),
        m.Data: {not_delivered_uplink: None, wrong_cycle: Outcome.WRONG_CYCLE,
                 wrong_user: Outcome.WRONG_USER}}

    # Every event, in the order in which its rows are tried.
    TABLE = (
        # Offers and presence. A new codebook and new settings take effect with the next cycle.
        Row((State.WAITING,), CodebookOffered, guard=peers_present,
            actions=(store_codebook, begin_cycle), target=State.BEACONING),
        Row((State.WAITING,), CodebookOffered, actions=(store_codebook, log_not_ready)),
        Row(ANY, CodebookOffered, actions=(store_codebook,)),

        Row((State.WAITING,), PeersChanged, guard=ready_with_peers,
            actions=(store_peers, begin_cycle), target=State.BEACONING),
        Row((State.WAITING,), PeersChanged, actions=(store_peers, log_not_ready)),
        Row(ANY, PeersChanged, actions=(store_peers,)),

        Row((State.WAITING, State.PAUSED), SettingsOffered,
            actions=(store_settings, apply_settings)),
        Row((State.RESTING,), SettingsOffered, actions=(store_settings, apply_settings),
            restart_timeout=True),
        Row(ANY, SettingsOffered, actions=(store_settings,)),

        # A newer base station serves, or has gone. A pause outlasts both.
        Row(ANY, StoodBy, guard=pausing, actions=(forget_peers,), target=State.PAUSED),
        Row(ANY, StoodBy, actions=(forget_peers,), target=State.WAITING),
        Row((State.WAITING, State.PAUSED), Resumed, actions=(skip_cycles,)),

        # Requests of an operator. A pause begins between two cycles; a step runs one cycle of it.
        Row((State.PAUSED,), PauseRequested, actions=(reply(True, 'already paused'),)),
        Row((State.WAITING, State.RESTING), PauseRequested,
            actions=(pause, log_paused, reply(True, 'paused')), target=State.PAUSED),
        Row(ANY, PauseRequested,
            actions=(pause, reply(True, 'the pause begins after cycle {cycle}'))),

        Row((State.PAUSED,), ResumeRequested, guard=not_ready,
            actions=(resume, log_not_ready, reply_resumed), target=State.WAITING),
        Row((State.PAUSED,), ResumeRequested, actions=(resume, begin_cycle, reply_resumed),
            target=State.BEACONING),
        Row(ANY, ResumeRequested, guard=pausing, actions=(resume, reply_resumed)),
        Row(ANY, ResumeRequested, actions=(reply(True, 'not paused'),)),

        Row((State.PAUSED,), StepRequested, guard=not_ready,
            actions=(reply(False, 'waiting for {lacking}'),)),
        Row((State.PAUSED,), StepRequested,
            actions=(begin_cycle, reply(True, 'cycle {cycle} begins')), target=State.BEACONING),
        Row(ANY, StepRequested, guard=pausing,
            actions=(reply(False, 'cycle {cycle} has not ended'),)),
        Row(ANY, StepRequested, actions=(reply(False, 'not paused; a step requires a pause'),)),
        Row(ANY, LocateRequested, actions=(prefer_user,)),

        # Timeouts.
        Row((State.RESTING,), Timeout, guard=pausing, actions=(log_paused,), target=State.PAUSED),
        Row((State.RESTING,), Timeout, guard=not_ready, actions=(log_not_ready,),
            target=State.WAITING),
        Row((State.RESTING,), Timeout, actions=(begin_cycle,), target=State.BEACONING),

        Row((State.BEACONING,), Timeout, guard=some_acks,
            actions=(grant, command_bands, announce_positioning), target=State.CONFIGURING),
        Row((State.BEACONING,), Timeout, guard=pausing, actions=(apply_settings, log_unanswered),
            target=State.PAUSED),
        Row((State.BEACONING,), Timeout, guard=not_ready, actions=(log_not_ready,),
            target=State.WAITING),
        Row((State.BEACONING,), Timeout, actions=(apply_settings, beacon_again),
            outcome=Outcome.UNANSWERED, restart_timeout=True),

        Row((State.CONFIGURING,), Timeout, guard=may_retry, actions=(command_bands,),
            outcome=Outcome.RETRY_RHS, restart_timeout=True),
        give_up(State.CONFIGURING, Timeout, Outcome.RHS_SILENT),

        # Repeat the command too, because the channel may have missed the report of the RHS.
        Row((State.SOUNDING,), Timeout, guard=may_retry,
            actions=(command_silent_bands, request_pilots), outcome=Outcome.RETRY_BAND,
            restart_timeout=True),
        give_up(State.SOUNDING, Timeout, Outcome.USER_GONE, before=(remove_user,)),

        Row((State.ESTIMATING,), Timeout, guard=may_retry, actions=(resend_signals,),
            outcome=Outcome.RETRY_POSITION, restart_timeout=True),
        give_up(State.ESTIMATING, Timeout, Outcome.POSITIONER_SILENT),

        # Each role repeats its reply to a repeated message, so the signals also repeat the beam.
        Row((State.STEERING,), Timeout, guard=may_retry, actions=(resend_signals,),
            outcome=Outcome.RETRY_BEAM, restart_timeout=True),
        give_up(State.STEERING, Timeout, Outcome.TRANSMISSION_SILENT),

        # The channel may have missed the beam or its configuration.
        Row((State.TRANSMITTING,), Timeout, guard=may_retry,
            actions=(resend_signals, send_downlink), outcome=Outcome.RETRY_DATA,
            restart_timeout=True),
        give_up(State.TRANSMITTING, Timeout, Outcome.DATA_LOST),

        # Acks. All that are not dropped count towards the rate of their user.
        Row(ANY, m.Ack, guard=wrong_cycle, actions=(count_ack,), outcome=Outcome.WRONG_CYCLE),
        # Of several nodes with the same number, the first is served.
        Row(ANY, m.Ack, guard=number_taken, actions=(count_ack, reject_number),
            outcome=Outcome.NUMBER_TAKEN),
        Row(ANY, m.Ack, guard=duplicate_ack, actions=(count_ack,), outcome=Outcome.DUPLICATE),
        # A late ack: this cycle no longer collects acks; the user is registered for the next one.
        Row(NOT_BEACONING, m.Ack, actions=(count_ack, register_user), outcome=Outcome.LATE_ACK),
        Row((State.BEACONING,), m.Ack, guard=last_ack,
            actions=(count_ack, accept_ack, grant, command_bands, announce_positioning),
            target=State.CONFIGURING),
        Row((State.BEACONING,), m.Ack, actions=(count_ack, accept_ack)),

        # Reports of the RHS: a band's configurations, or the configuration of the beam.
        Row((State.CONFIGURING,), m.RhsConfiguration, guard=last_configuration,
            actions=(store_configured, request_pilots), target=State.SOUNDING),
        Row((State.CONFIGURING, State.SOUNDING), m.RhsConfiguration, guard=for_positioning,
            actions=(store_configured,)),
        Row((State.ESTIMATING, State.STEERING, State.TRANSMITTING), m.RhsConfiguration,
            guard=for_positioning, outcome=Outcome.DUPLICATE),
        # The beam and its configuration come from two roles, in either order.
        Row((State.ESTIMATING,), m.RhsConfiguration, guard=for_beam, actions=(store_beam_applied,),
            target=State.STEERING),
        Row((State.STEERING,), m.RhsConfiguration, guard=for_known_beam,
            actions=(begin_transmission,), target=State.TRANSMITTING),
        Row((State.STEERING,), m.RhsConfiguration, guard=for_beam, actions=(store_beam_applied,)),
        # A repeated request may be answered twice.
        Row((State.TRANSMITTING,), m.RhsConfiguration, guard=for_beam, outcome=Outcome.DUPLICATE),

        # Feed signals.
        Row((State.SOUNDING,), m.FeedSignals, guard=last_signals,
            actions=(store_signals, send_signals), target=State.ESTIMATING),
        Row((State.SOUNDING,), m.FeedSignals, actions=(store_signals,), enter_again=True),

        # Position estimates.
        Row((State.ESTIMATING,), m.PositionEstimate, target=State.STEERING),
        Row((State.STEERING,), m.PositionEstimate),
        Row((State.TRANSMITTING,), m.PositionEstimate, outcome=Outcome.DUPLICATE),

        give_up(State.ESTIMATING, m.NoFix, Outcome.NO_FIX),

        # Beams.
        Row((State.ESTIMATING,), m.Beam, actions=(store_beam,), target=State.STEERING),
        Row((State.STEERING,), m.Beam, guard=beam_applied,
            actions=(store_beam, begin_transmission), target=State.TRANSMITTING),
        Row((State.STEERING,), m.Beam, actions=(store_beam,)),
        Row((State.TRANSMITTING,), m.Beam, outcome=Outcome.DUPLICATE),

        # Data. Delivered uplink data end the cycle.
        Row((State.TRANSMITTING,), m.Data, actions=(finish,), target=State.RESTING),
        Row((State.PAUSED, State.RESTING), m.Data, outcome=Outcome.DUPLICATE),
    )
