"""The base station, which invites users by beacons, and locates and serves one at a time."""

import dataclasses
import enum
import functools
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.library import EMPTY, Library
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import frames_s
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.admission import Admission
from rhs_isac_ros.protocol.cycle import Reception, SignalCollector
from rhs_isac_ros.protocol.events import Event, LogMessage, Outcome, Timeout
from rhs_isac_ros.protocol.following import Proposals
from rhs_isac_ros.protocol.handover import Carriers, Steering
from rhs_isac_ros.protocol.role import ANY, AnyRow, Drops, Row, on
from rhs_isac_ros.protocol.service_log import ServiceLog
from rhs_isac_ros.protocol.settings import BaseStationSettings, PendingSettings
from rhs_isac_ros.protocol.user_registry import UserRegistry
from rhs_isac_ros.support.texts import counted, listed


class BsState(enum.Enum):
    """States of the base station."""

    WAITING = 'waiting'            # waits for a codebook and the other roles
    PAUSED = 'paused'              # waits for an operator to resume, or to request a cycle
    RESTING = 'resting'            # waits between cycles
    BEACONING = 'beaconing'        # waits for acks
    CONFIGURING = 'configuring'    # waits for the RHS to report the configurations of all bands
    SOUNDING = 'sounding'          # waits for the feed signals of all bands
    ESTIMATING = 'estimating'      # waits for the position estimate
    STEERING = 'steering'          # waits for the beam and for the RHS to apply it
    TRANSMITTING = 'transmitting'  # waits for the uplink data


# Steps of a granted cycle. Each waits for a reply, and may repeat its request.
STEPS = (BsState.CONFIGURING, BsState.SOUNDING, BsState.ESTIMATING, BsState.STEERING,
         BsState.TRANSMITTING)
NOT_BEACONING = tuple(state for state in BsState if state is not BsState.BEACONING)


@dataclasses.dataclass
class Cycle(Reception):
    """The state of one cycle, as known to the base station; the user is 0 before the grant."""

    attempt: int = 0  # number of earlier beacons in this cycle
    # Bands whose configurations the RHS has reported.
    configured: set[int] = dataclasses.field(default_factory=set)
    # Bands whose pilots the user has sent.
    piloted: set[int] = dataclasses.field(default_factory=set)
    # Signals that were sent to the positioner once all bands were complete.
    received: m.ReceivedSignals | None = None
    steering: Steering = dataclasses.field(default_factory=Steering)
    carrier: str = ''  # surface that carries the data
    # Start of each phase [s]; NaN if it has not begun. The latest beacon begins the first phase.
    began_s: np.ndarray = dataclasses.field(
        default_factory=lambda: np.full(len(m.Phase), math.nan))


# Number of beacons after which a base station that knows no user sends fewer, because each of them
# wakes several threads of the middleware; and their period from then on [s].
_N_FAST, _ALONE_S = 50, 1.0


def _admission(settings: BaseStationSettings) -> Admission:
    return Admission(settings.allowed_users, settings.max_users, settings.ack_rate_hz)


def reply(success: bool, text: str) -> Callable[['BaseStation', Event], None]:
    """Return an action that answers an operator with `text`, filled in by `BaseStation.fill`."""
    # Tables and diagrams show its name.
    def reply(role: 'BaseStation', event: Event) -> None:
        role.act(events.Reply(success, role.fill(text)))

    return reply


reply_resumed = reply(True, 'resumed{waiting}')


class BaseStation(SignalCollector):
    """The role that runs the cycles: it invites, selects, locates and serves users.

    Parameters
    ----------
    seed
        Seed of the noise.
    first_cycle_id
        Id of the first cycle. After a restart, it must exceed all earlier ids, so that messages
        still in transit are recognised as stale.
    library
        Codebooks besides the offered one, which is for the whole region. The codebook of a cycle
        is chosen at the grant, and its id in the messages of the cycle selects it in every role.
    world_s
        Returns the time in which users move [s], with an arbitrary epoch; by default that of the
        role. Proposals of codebooks, which follow from tracks, hold for some of this time.
    """

    SENDS = (m.Beacon, m.Grant, m.RhsCommand, m.PilotRequest, m.ReceivedSignals, m.Data,
             m.ProtocolState)

    STATES = BsState
    BLOCKED_STATES = frozenset({BsState.WAITING})
    WORLD_STATES = frozenset({BsState.RESTING})

    _cycle: Cycle

    def __init__(
            self, scenario: Scenario, settings: BaseStationSettings, rng: np.random.Generator,
            seed: int, first_cycle_id: int = 1, library: Library = EMPTY,
            world_s: Callable[[], float] | None = None) -> None:
        super().__init__(BsState.WAITING, scenario, seed, Cycle(first_cycle_id - 1))
        self._users = UserRegistry(settings.policy, rng)
        self._frames_s = frames_s(scenario)
        self._settings = PendingSettings(settings)
        self._admission = _admission(settings)
        self._pause_requested = False  # whether a pause begins after the current cycle
        self._offered: Codebook | None = None  # codebook for the next beacon
        self._proposals = Proposals(library)
        self._world_s = world_s or (lambda: self.now_s)
        # Roles that are missing; None before the first report.
        self._missing: tuple[str, ...] | None = None
        self._carriers = Carriers()
        self._service = ServiceLog()

    def react(self, event: Event) -> None:
        """Process an event, and log what its transitions mean for the service."""
        before = self.state
        super().react(event)
        for message in self._observed(before):
            self.act(message)

    def _observed(self, before: enum.Enum) -> Iterable[LogMessage]:
        """Return what to log about the transition from a state to the present one."""
        cycle = self._cycle
        if self.state is BsState.WAITING and self._missing is not None:
            return self._service.waits(self._lacking())
        if self.state is BsState.BEACONING:
            self._service.begins()
        elif self.state is BsState.RESTING and before in STEPS:
            if self.outcome:
                return self._service.gives_up(
                    cycle.cycle_id, cycle.user, cycle.user_instance, self.outcome)
            users = counted(len(self._users), 'user')
            return self._service.serves(
                cycle.cycle_id, cycle.user, f'codebook {cycle.codebook_id}, {users}')
        elif self.state is BsState.PAUSED and before is not BsState.PAUSED:
            reason = '' if before is BsState.WAITING else f' after cycle {cycle.cycle_id}'
            if before is BsState.BEACONING:
                reason = f': no user answered the beacon of cycle {cycle.cycle_id}'
            return [LogMessage(f'paused{reason}')]
        return ()

    def timeout_s(self, state: enum.Enum) -> float | None:
        """Return the timeout of a state [s], or None; attempts at a step have equal parts.

        An attempt at the pilots of all bands also has the time that the frames take.
        """
        settings = self._settings.in_use
        if state is BsState.BEACONING:
            is_alone = not self._users and self._cycle.attempt >= _N_FAST
            return max(settings.ack_timeout_s, _ALONE_S * is_alone)
        if state is BsState.RESTING:
            return 0.0 if self._pause_requested else settings.rest_s
        if state not in STEPS:
            return None
        frames_s = self._frames_s if state is BsState.SOUNDING else 0.0
        return settings.step_timeout_s / (settings.retries + 1) + frames_s

    def status(self) -> Mapping[str, str]:
        """Return the settings and the codebook in use, pending settings and conflicts."""
        return (self._settings.describe() | {'codebook_id': self._cycle.codebook_id,
                                             'handovers': str(self._carriers.n_handovers)}
                | self._users.conflicts(self.now_s))

    def _surface(self, message: m.Message) -> str:
        return message.scenario_id or self._scenario.id

    # Guards

    def _ready(self, event: Event) -> bool:
        return not self._lacking()

    def _not_ready(self, event: Event) -> bool:
        return not self._ready(event)

    def _pausing(self, event: Event) -> bool:
        return self._pause_requested

    def _pausing_or_not_ready(self, event: Event) -> bool:
        return self._pausing(event) or self._not_ready(event)

    def _some_acks(self, event: Timeout) -> bool:
        return bool(self._users.answered)

    def _may_retry(self, event: Timeout) -> bool:
        return self.repeats < self._settings.in_use.retries

    def _wrong_codebook(self, event: Any) -> bool:
        return event.codebook_id not in ('', self._cycle.codebook_id)

    def _not_delivered_uplink(self, event: m.Data) -> bool:
        return event.stage is m.Stage.OFFERED or event.direction is m.Direction.DOWNLINK

    def _not_allowed(self, event: m.Ack) -> bool:
        return not self._admission.allows(event.user)

    def _too_often(self, event: m.Ack) -> bool:
        return self._admission.exceeds_rate(event.user, self.now_s)

    def _number_taken(self, event: m.Ack) -> bool:
        return self._users.is_taken(event.user, event.sender, self.now_s)

    def _duplicate_ack(self, event: m.Ack) -> bool:
        return event.user in self._users.answered

    def _last_ack(self, event: m.Ack) -> bool:
        return self._users.is_complete_with(event.user)

    def _signals_due(self, event: Timeout) -> bool:
        """Return whether the channel is missing, or has not answered all pilots of the user."""
        return ('channel' in (self._missing or ())
                or not self._cycle.piloted <= self._cycle.signals.keys())

    def _for_positioning(self, event: m.RhsConfiguration) -> bool:
        return event.mode is m.Mode.POSITIONING

    def _last_configuration(self, event: m.RhsConfiguration) -> bool:
        return (self._for_positioning(event)
                and self._cycle.configured | {event.band} == self._bands)

    def _sounds_elsewhere(self, event: m.RhsConfiguration) -> bool:
        return self._for_positioning(event) and self._surface(event) != self._scenario.id

    def _shown_late(self, event: m.RhsConfiguration) -> bool:
        return self._wrong_cycle(event) and not self._for_positioning(event)

    def _last_answer(self, event: m.Beam | m.RhsConfiguration) -> bool:
        return self._cycle.steering.is_complete_with(self._surface(event), event)

    def _some_ready(self, event: Timeout) -> bool:
        return bool(self._cycle.steering.ready)

    def _late_surface(self, event: m.Beam | m.RhsConfiguration) -> bool:
        ready = self._cycle.steering.ready
        return bool(ready) and self._surface(event) not in ready

    # Actions of the rows: first operation, then a cycle in order

    def _store_codebook(self, event: events.CodebookOffered) -> None:
        self._offered = event.codebook

    def _store_peers(self, event: events.PeersChanged) -> None:
        self._missing = event.missing

    def _forget_peers(self, event: events.StoodBy) -> None:
        """Forget which roles are missing, so that no cycle begins until this is known again."""
        self._missing = None

    def _skip_cycles(self, event: events.Resumed) -> None:
        """Skip the cycle ids that another base station may have used."""
        self._cycle.cycle_id = max(event.first_cycle_id - 1, self._cycle.cycle_id)

    def _store_settings(self, event: events.SettingsOffered) -> None:
        self._settings.latest = event.settings

    def _apply_settings(self, event: Event | None = None) -> None:
        if changes := self._settings.apply():
            self.log(changes)
            settings = self._settings.in_use
            self._users.policy = settings.policy
            self._admission = _admission(settings)
            for user in self._users.remove_all_except(self._admission.allows):
                self.log(f'user {user} removed: not in allowed_users {settings.allowed_users!r}')

    def fill(self, text: str) -> str:
        """Fill in the cycle id (``{cycle}``) and missing parts (``{lacking}``, ``{waiting}``)."""
        lacking = ', '.join(self._lacking())
        return text.format(cycle=self._cycle.cycle_id, lacking=lacking,
                           waiting=f'; waiting for {lacking}' if lacking else '')

    def _lacking(self) -> tuple[str, ...]:
        roles = ('the other roles',) if self._missing is None else self._missing
        return roles if self._offered else (*roles, 'codebook')

    def _prefer_user(self, event: events.LocateRequested) -> None:
        self._users.request(event.user)

    def _pause(self, event: events.PauseRequested) -> None:
        self._pause_requested = True

    def _resume(self, event: events.ResumeRequested) -> None:
        self._pause_requested = False
        self.log('resumed')

    def _begin_cycle(self, event: Event) -> None:
        self._cycle = Cycle(self._cycle.cycle_id + 1, steering=self._cycle.steering.next())
        self._beacon()

    def _beacon_again(self, event: Timeout) -> None:
        """Send another beacon in the cycle, which invites more users if there are any."""
        # If nobody answers a beacon to all users, the network may be at fault: remove no user.
        if not self._users.all_invited:
            self._lose_absent()
        self._cycle.attempt += 1
        self._beacon()

    def _beacon(self) -> None:
        self._cycle.codebook = self._offered  # the codebook may change until the grant
        self._cycle.began_s[m.Phase.BEACONING] = self.now_s
        first, last = self._users.invite(self._cycle.attempt)
        self._send(m.Beacon, attempt=self._cycle.attempt, first_user=first, last_user=last)

    def _send(self, kind: type[m.Message], **fields: Any) -> None:
        """Send a message with the user and the codebook of the cycle."""
        self.send(m.derive(kind, self._cycle, **fields))

    def _count_ack(self, event: m.Ack) -> None:
        self._admission.count(event.user, self.now_s)

    def _reject_number(self, event: m.Ack) -> None:
        self._users.reject(event.user)

    def _accept_ack(self, event: m.Ack) -> None:
        self.log(self._users.add_answer(event.user, event.sender, self.now_s), warning=True,
                 key=m.conflict_key(event.sender))

    def _register_user(self, event: m.Ack) -> None:
        """Register a user that answered too late for this cycle."""
        self.log(self._users.register(event.user, event.sender, self.now_s), warning=True,
                 key=m.conflict_key(event.sender))

    def _grant(self, event: m.Ack | Timeout) -> None:
        self._lose_absent()
        self._cycle.user = self._users.select()
        self._cycle.user_instance = self._users.owner(self._cycle.user)
        self._cycle.codebook = self._proposals.take(
            self._cycle.user, self._cycle.user_instance, self._world_s()) or self._cycle.codebook
        self._send(m.Grant)
        self._command_bands(event)
        self._announce(m.Phase.POSITIONING)

    def _lose_absent(self) -> None:
        """Count missed invitations, and remove the users that no longer answer."""
        lost = self._users.remove_absent()
        self.count(Outcome.USER_LOST, len(lost))
        # The key contains the instance, so a restarted user is logged again; several users are
        # logged once.
        if len(lost) == 1:
            ((user, instance),) = lost.items()
            self.log(f'user {user} no longer answers', True, f'lost {user} {instance}')
        elif lost:
            self.log(f'users {listed(lost)} no longer answer', True, 'lost')

    def _command_bands(self, event: Event) -> None:
        self._command(sorted(self._bands - self._cycle.configured))

    def _command_silent_bands(self, event: Event) -> None:
        self._command(self._silent_bands())

    def _command(self, bands: Iterable[int]) -> None:
        for band in bands:
            self._send(m.RhsCommand, band=band)

    def _store_configured(self, event: m.RhsConfiguration) -> None:
        self._cycle.configured.add(event.band)

    def _request_pilots(self, event: Event) -> None:
        self._send(m.PilotRequest, band=self._silent_bands()[0], last_band=max(self._bands),
                   n_frames=self._scenario.n_frames)

    def _store_piloted(self, event: m.Pilot) -> None:
        self._cycle.piloted.add(event.band)

    def _send_signals(self, event: m.FeedSignals) -> None:
        received = self._combined(self._settings.in_use.receiver_noise)
        self._cycle.received = received
        self.send(received)
        self._announce(m.Phase.ESTIMATING)

    def _resend_signals(self, event: Timeout) -> None:
        assert self._cycle.received
        self.send(self._cycle.received)

    def _store_estimate(self, event: m.PositionEstimate) -> None:
        self._proposals.add(event, self._world_s())

    def _store_answer(self, event: m.Beam | m.RhsConfiguration) -> None:
        self._cycle.steering.add(self._surface(event), event)

    def _await_surface(self, event: m.Beam | m.RhsConfiguration) -> None:
        """Wait for the beam of a surface that was too late in an earlier cycle."""
        self._cycle.steering.awaited.add(self._surface(event))

    def _begin_transmission(self, event: Event) -> None:
        self._send_downlink(event)
        self._announce(m.Phase.TRANSMITTING)

    def _send_downlink(self, event: Event) -> None:
        """Choose a surface, and offer as much data as its beam is expected to carry."""
        cycle, settings, beams = self._cycle, self._settings.in_use, self._cycle.steering.ready
        cycle.carrier = self._carriers.choose(
            cycle.user, beams, settings.handover_ratio, self.now_s)
        duration_s = settings.data_duration_s
        self._send(m.Data, scenario_id=cycle.carrier, direction=m.Direction.DOWNLINK,
                   stage=m.Stage.OFFERED, duration_s=duration_s,
                   bits=beams[cycle.carrier].expected_bps * duration_s // 1)

    def _note_loss(self, event: Timeout) -> None:
        self._carriers.lose(self._cycle.carrier, self.now_s)

    def _remove_user(self, event: Timeout) -> None:
        """Stop waiting for the user until the user answers again."""
        self._users.remove(self._cycle.user)

    def _abandon(self, event: Timeout | m.NoFix) -> None:
        """End the cycle without service."""
        assert self.outcome
        self._proposals.drop(self._cycle.user)
        self._end_cycle(self.outcome.value)

    def _finish(self, event: m.Data) -> None:
        """End the cycle with service."""
        self._carriers.deliver(self._cycle.user, self._surface(event))
        self._end_cycle('served')

    def _end_cycle(self, outcome: str) -> None:
        """Report the end of a cycle, and apply the settings for the next one.

        A cycle without a fix counts as completed by its user.
        """
        self._users.end_cycle(
            self._cycle.user, self._cycle.began_s[m.Phase.BEACONING], self.now_s,
            completed=outcome in ('served', Outcome.NO_FIX.value))
        self._report(m.Phase.BEACONING, outcome)
        self._apply_settings()

    def _announce(self, phase: m.Phase) -> None:
        self._cycle.began_s[phase] = self.now_s
        self._report(phase)

    def _report(self, phase: m.Phase, outcome: str = '') -> None:
        began_s = self._cycle.began_s
        beacon_s = began_s[m.Phase.BEACONING]
        self._send(m.ProtocolState, phase=phase, outcome=outcome, began_s=began_s - beacon_s,
                   elapsed_s=float(self.now_s - beacon_s))

    # Conditions under which a message of a cycle is dropped.
    _OF_USER = SignalCollector._OF_USER
    _OF_CODEBOOK: Drops = {_wrong_codebook: Outcome.WRONG_CODEBOOK}
    _DELIVERED: Drops = {_not_delivered_uplink: None}
    _SOUNDED_HERE: Drops = {_sounds_elsewhere: None}
    # The row that repeats the request of a step, and the row that ends its cycle.
    _retry_row = functools.partial(AnyRow, guard=_may_retry, restart_timeout=True)
    _last_row = functools.partial(AnyRow, target=BsState.RESTING)
    # A beam and its configuration come from two roles of each surface, in either order.
    _ANSWER = (
        AnyRow((BsState.ESTIMATING,), (_store_answer,), BsState.STEERING),
        AnyRow((BsState.STEERING,), (_store_answer, _begin_transmission), BsState.TRANSMITTING,
               guard=_last_answer),
        AnyRow((BsState.STEERING,), (_store_answer,)))

    # In each table, the first matching row for an event applies. The operator and the other roles
    # decide when cycles begin.
    _OPERATION = (
        *on(events.Immediately, 'immediately')(
            Row((BsState.WAITING,), target=BsState.PAUSED, guard=_pausing),
            Row((BsState.WAITING,), (_begin_cycle,), BsState.BEACONING, guard=_ready)),
        # A new codebook takes effect with the next beacon.
        *on(events.CodebookOffered, 'codebook')(Row(ANY, (_store_codebook,))),
        *on(events.PeersChanged, 'peers')(Row(ANY, (_store_peers,))),
        *on(events.SettingsOffered, 'settings')(
            Row((BsState.WAITING, BsState.PAUSED), (_store_settings, _apply_settings)),
            Row((BsState.RESTING,), (_store_settings, _apply_settings), restart_timeout=True),
            Row(ANY, (_store_settings,))),
        # A pause persists while another base station serves.
        *on(events.StoodBy, 'stood_by')(
            Row(ANY, (_forget_peers, _apply_settings), BsState.WAITING)),
        *on(events.Resumed, 'resumed')(
            Row((BsState.WAITING, BsState.PAUSED), (_skip_cycles,))),
        *on(events.PauseRequested, 'pause')(
            # A pause begins between cycles or after an unanswered beacon.
            Row((BsState.PAUSED,), (reply(True, 'already paused'),)),
            Row((BsState.WAITING, BsState.RESTING), (_pause, reply(True, 'paused')),
                BsState.PAUSED),
            Row(ANY, (_pause, reply(True, 'the pause begins after cycle {cycle}')))),
        *on(events.ResumeRequested, 'resume')(
            Row((BsState.PAUSED,), (_resume, reply_resumed), BsState.WAITING),
            Row(ANY, (_resume, reply_resumed), guard=_pausing),
            Row(ANY, (reply(True, 'not paused'),))),
        *on(events.StepRequested, 'step')(
            # The pause remains requested, so the base station pauses again after the cycle.
            Row((BsState.PAUSED,), (reply(False, 'waiting for {lacking}'),), guard=_not_ready),
            Row((BsState.PAUSED,), (_begin_cycle, reply(True, 'cycle {cycle} begins')),
                BsState.BEACONING),
            Row(ANY, (reply(False, 'cycle {cycle} has not ended'),), guard=_pausing),
            Row(ANY, (reply(False, 'not paused; a step requires a pause'),))),
        *on(events.LocateRequested, 'locate')(
            Row(ANY, (_prefer_user,))),
    )

    # Which acks count, and which of them ends the wait for acks.
    _ADMISSION = (
        *on(m.Ack, 'ack', {_not_allowed: Outcome.NOT_ALLOWED, _too_often: Outcome.TOO_OFTEN})(
            # All acks that pass these two checks count towards the rate limit.
            Row(ANY, (_count_ack,), guard=SignalCollector._wrong_cycle,
                outcome=Outcome.WRONG_CYCLE),
            # If several nodes have the same number, the first one is served.
            Row(ANY, (_count_ack, _reject_number), guard=_number_taken,
                outcome=Outcome.NUMBER_TAKEN),
            Row(ANY, (_count_ack,), guard=_duplicate_ack, outcome=Outcome.DUPLICATE),
            # This cycle no longer collects acks; the user is registered for later ones.
            Row(NOT_BEACONING, (_count_ack, _register_user), outcome=Outcome.LATE_ACK),
            Row((BsState.BEACONING,), (_count_ack, _accept_ack, _grant), BsState.CONFIGURING,
                guard=_last_ack),
            Row((BsState.BEACONING,), (_count_ack, _accept_ack))),
    )

    # The steps of a cycle, in order, and their timeouts.
    _CYCLE = (
        *on(Timeout, 'timeout')(
            Row((BsState.RESTING,), target=BsState.WAITING, guard=_pausing_or_not_ready),
            Row((BsState.RESTING,), (_begin_cycle,), BsState.BEACONING),
            Row((BsState.BEACONING,), (_grant,), BsState.CONFIGURING, guard=_some_acks),
            Row((BsState.BEACONING,), (_apply_settings,), BsState.WAITING,
                guard=_pausing_or_not_ready),
            Row((BsState.BEACONING,), (_apply_settings, _beacon_again), outcome=Outcome.UNANSWERED,
                restart_timeout=True),
            _retry_row((BsState.CONFIGURING,), (_command_bands,), outcome=Outcome.RETRY_RHS),
            _last_row((BsState.CONFIGURING,), (_abandon,), outcome=Outcome.RHS_SILENT),
            # Repeat the command too, because the channel may have missed the report of the RHS.
            _retry_row((BsState.SOUNDING,), (_command_silent_bands, _request_pilots),
                       outcome=Outcome.RETRY_BAND),
            _last_row((BsState.SOUNDING,), (_abandon,), guard=_signals_due,
                      outcome=Outcome.CHANNEL_SILENT),
            _last_row((BsState.SOUNDING,), (_remove_user, _abandon), outcome=Outcome.USER_GONE),
            _retry_row((BsState.ESTIMATING,), (_resend_signals,), outcome=Outcome.RETRY_POSITION),
            _last_row((BsState.ESTIMATING,), (_abandon,), outcome=Outcome.POSITIONER_SILENT),
            # The cycle goes on without surfaces that did not answer; the next one does not await
            # them either.
            Row((BsState.STEERING,), (_begin_transmission,), BsState.TRANSMITTING,
                guard=_some_ready),
            # Roles answer a repeated message again, so repeated signals lead to the beam again.
            _retry_row((BsState.STEERING,), (_resend_signals,), outcome=Outcome.RETRY_BEAM),
            _last_row((BsState.STEERING,), (_abandon,), outcome=Outcome.TRANSMISSION_SILENT),
            # The channel may have missed the beam or its configuration, or another surface can
            # carry the data.
            _retry_row((BsState.TRANSMITTING,), (_note_loss, _resend_signals, _send_downlink),
                       outcome=Outcome.RETRY_DATA),
            _last_row((BsState.TRANSMITTING,), (_note_loss, _abandon), outcome=Outcome.DATA_LOST)),
        *on(m.RhsConfiguration, 'configured')(
            Row(ANY, (_await_surface,), guard=_shown_late, outcome=Outcome.WRONG_CYCLE)),
        *on(m.RhsConfiguration, 'configured',
            _SOUNDED_HERE | SignalCollector._OF_CYCLE | _OF_CODEBOOK)(
            # A report concerns the configurations for positioning in a band, or that of the beam.
            Row((BsState.CONFIGURING,), (_store_configured, _request_pilots), BsState.SOUNDING,
                guard=_last_configuration),
            Row((BsState.CONFIGURING, BsState.SOUNDING), (_store_configured,),
                guard=_for_positioning),
            Row((BsState.ESTIMATING, BsState.STEERING, BsState.TRANSMITTING),
                guard=_for_positioning, outcome=Outcome.DUPLICATE),
            *_ANSWER,
            Row((BsState.TRANSMITTING, BsState.RESTING), (_store_answer,), guard=_late_surface),
            # A repeated request may be answered twice.
            Row((BsState.TRANSMITTING,), outcome=Outcome.DUPLICATE)),
        # Pilots only distinguish a silent user from a silent channel.
        *on(m.Pilot, 'pilot', _OF_USER)(Row(ANY, (_store_piloted,))),
        *on(m.FeedSignals, 'signals', SignalCollector._OF_SIGNALS)(
            Row((BsState.SOUNDING,), (SignalCollector._store_signals, _send_signals),
                BsState.ESTIMATING, guard=SignalCollector._last_signals),
            # Each band restarts the timeout and the retries.
            Row((BsState.SOUNDING,), (SignalCollector._store_signals,), BsState.SOUNDING)),
        *on(m.PositionEstimate, 'estimate', _OF_USER | _OF_CODEBOOK)(
            Row((BsState.ESTIMATING,), (_store_estimate,), BsState.STEERING),
            Row((BsState.STEERING,), (_store_estimate,)),
            Row((BsState.TRANSMITTING,), outcome=Outcome.DUPLICATE)),
        *on(m.NoFix, 'no_fix', _OF_USER | _OF_CODEBOOK)(
            _last_row((BsState.ESTIMATING,), (_abandon,), outcome=Outcome.NO_FIX)),
        *on(m.Beam, 'beam')(
            Row(ANY, (_await_surface,), guard=SignalCollector._wrong_cycle,
                outcome=Outcome.WRONG_CYCLE)),
        *on(m.Beam, 'beam', SignalCollector._SAME_USER | _OF_CODEBOOK)(
            *_ANSWER,
            Row((BsState.TRANSMITTING,), (_store_answer,), guard=_late_surface),
            Row((BsState.TRANSMITTING,), outcome=Outcome.DUPLICATE)),
        *on(m.Data, 'delivered', _DELIVERED | _OF_USER)(
            Row((BsState.TRANSMITTING,), (_finish,), BsState.RESTING),
            Row((BsState.PAUSED, BsState.RESTING), outcome=Outcome.DUPLICATE)),
    )

    TABLE = (*_OPERATION, *_CYCLE, *_ADMISSION)
