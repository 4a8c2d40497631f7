"""The memory of a base station, and the guards and actions of its table."""

import dataclasses
import enum
import math
from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import (
    Action,
    CodebookOffered,
    Event,
    LogMessage,
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
from rhs_isac_ros.protocol.outage_log import OutageLog
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.role import PendingSettings
from rhs_isac_ros.protocol.settings import BaseStationSettings
from rhs_isac_ros.protocol.state_machine import StateMachine
from rhs_isac_ros.protocol.user_scheduler import (
    AckFilter,
    UserInstances,
    UserScheduler,
    parse_users,
)


class PhaseTimes:
    """Measures the phases of one cycle at a time, from its latest beacon.

    All times are on the same monotonic clock [s].
    """

    def __init__(self) -> None:
        self._began_s = np.full(len(m.Phase), math.nan)

    def start(self, now_s: float) -> None:
        """Start a cycle, or restart it with another beacon."""
        self._began_s[:] = math.nan
        self._began_s[m.Phase.BEACONING] = now_s

    def begin_phase(
            self, phase: m.Phase, cycle_id: int, user: int, now_s: float) -> m.ProtocolState:
        """Record the beginning of a phase and return the message that announces it."""
        self._began_s[phase] = now_s
        return self._state(phase, cycle_id, user, now_s, '')

    def end_cycle(
            self, outcome: str, cycle_id: int, user: int, now_s: float) -> m.ProtocolState:
        """Return the message that ends the cycle.

        Parameters
        ----------
        outcome
            ``served``, or the value of the `Outcome` that ended the cycle.
        """
        return self._state(m.Phase.BEACONING, cycle_id, user, now_s, outcome)

    def _state(
            self, phase: m.Phase, cycle_id: int, user: int, now_s: float, outcome: str
    ) -> m.ProtocolState:
        beacon_s = self._began_s[m.Phase.BEACONING]
        return m.ProtocolState(
            cycle_id=cycle_id, user=user, phase=phase, outcome=outcome,
            began_s=self._began_s - beacon_s, elapsed_s=float(now_s - beacon_s))


class State(enum.Enum):
    """States of the base station."""

    WAITING = 'waiting'            # waits for a codebook and the other roles
    PAUSED = 'paused'              # waits for an operator to resume or step the cycles
    RESTING = 'resting'            # waits between cycles
    BEACONING = 'beaconing'        # waits for acks
    CONFIGURING = 'configuring'    # waits for the RHS to report the configurations of all bands
    SOUNDING = 'sounding'          # waits for the feed signals of all bands
    ESTIMATING = 'estimating'      # waits for the position estimate
    STEERING = 'steering'          # waits for the beam and for the RHS to apply it
    TRANSMITTING = 'transmitting'  # waits for the uplink data


# Steps of a granted cycle: each waits for a reply and may request it again.
STEPS = (State.CONFIGURING, State.SOUNDING, State.ESTIMATING, State.STEERING, State.TRANSMITTING)
NOT_BEACONING = tuple(state for state in State if state is not State.BEACONING)


def timeouts(settings: BaseStationSettings, pausing: bool) -> dict[State, float]:
    """Return the timeouts by state [s]; that of a step is divided equally among its attempts.

    There is no rest before a pause.
    """
    attempt_s = settings.step_timeout_s / (settings.retries + 1)
    return {State.RESTING: 0.0 if pausing else settings.rest_s,
            State.BEACONING: settings.ack_timeout_s, **dict.fromkeys(STEPS, attempt_s)}


@dataclasses.dataclass
class Cycle:
    """The memory of one cycle.

    Attributes
    ----------
    attempt
        Number of beacons sent before the current one.
    user
        User that was granted the cycle; 0 before the grant.
    user_instance
        The granted instance of the user; if unknown, that of the first signals; otherwise 0.
    channel
        Instance of the channel that sent the first signals; 0 before them or if unknown.
    configured
        Bands whose configurations the RHS has reported.
    signals
        Feed signals by band, complex128 [F, N_SB, K].
    received
        Signals that were sent to the positioner, once all bands are complete.
    beam_applied
        Whether the RHS has reported the configuration of the beam.
    """

    id: int
    attempt: int = 0
    user: int = 0
    user_instance: int = 0
    channel: int = 0
    configured: set[int] = dataclasses.field(default_factory=set)
    signals: dict[int, np.ndarray] = dataclasses.field(default_factory=dict)
    received: m.ReceivedSignals | None = None
    beam: m.Beam | None = None
    beam_applied: bool = False


class BaseStationSteps(StateMachine[State]):
    """The memory of a base station, and the guards and actions of its table."""

    def __init__(
            self, scenario: Scenario, settings: BaseStationSettings, rng: np.random.Generator,
            receiver: Callable[[Codebook, np.ndarray, int, int, bool], np.ndarray],
            first_cycle_id: int = 1) -> None:
        super().__init__(State.WAITING, {})
        self._scenario, self._receiver = scenario, receiver
        self._users = UserScheduler(settings.policy, rng)
        self._instances = UserInstances()
        self._settings = PendingSettings(settings)
        # Whether an operator has requested a pause, which begins after the current cycle.
        self._pausing = False
        self._use(settings)
        # The codebook of the current cycle, and the one for the next.
        self._codebook: Codebook | None = None
        self._offered: Codebook | None = None
        # Roles that are missing; None before the first report.
        self._missing: tuple[str, ...] | None = None
        self._outages, self._times = OutageLog(), PhaseTimes()
        self._cycle = Cycle(first_cycle_id - 1)

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

    # Guards: readiness and timeouts

    def not_ready(
            self, event: Timeout | ResumeRequested | StepRequested, now_s: float) -> bool:
        """Whether a role or the codebook is missing."""
        return self._missing != () or not self._offered

    def pausing(
            self, event: Timeout | ResumeRequested | StepRequested | StoodBy, now_s: float,
    ) -> bool:
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

    # Guards: messages to reject

    def wrong_cycle(self, event: m.Message, now_s: float) -> bool:
        """Whether a message belongs to another cycle."""
        return event.cycle_id != self._cycle.id

    def wrong_user(
            self, event: m.FeedSignals | m.PositionEstimate | m.NoFix | m.Beam | m.Data,
            now_s: float) -> bool:
        """Whether a message concerns a user other than the granted one."""
        return event.user != self._cycle.user

    def wrong_instance(self, event: m.FeedSignals, now_s: float) -> bool:
        """Whether feed signals concern another instance of the user or of the channel."""
        cycle = self._cycle
        return not (m.same_instance(event.user_instance, cycle.user_instance)
                    and m.same_instance(event.sender, cycle.channel))

    def wrong_codebook(
            self, event: m.RhsConfiguration | m.PositionEstimate | m.NoFix | m.Beam,
            now_s: float) -> bool:
        """Whether a message refers to another codebook."""
        return event.codebook_id != self._codebook_id

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

    # Guards: progress within a cycle

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

    # Between cycles

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
        first = max(event.first_cycle_id, self._cycle.id + 1)
        self._cycle = Cycle(first - 1)

    def store_settings(self, event: SettingsOffered, now_s: float) -> None:
        """Store settings until they may be applied."""
        self._settings.latest = event.settings

    def apply_settings(self, event: Event, now_s: float) -> list[Action]:
        """Apply the latest settings."""
        return self._apply_settings()

    def _apply_settings(self) -> list[Action]:
        messages = self._settings.apply()
        if messages:
            settings = self._settings.in_use
            self._use(settings)
            removed = self._users.remove_all_except(self._ack_filter.allows)
            messages += self._outages.log_removed_users(removed, settings.allowed_users)
        return [*messages]

    def log_not_ready(self, event: Event, now_s: float) -> list[Action]:
        """Log what is missing, once the presence of the other roles is known."""
        if self._missing is None:
            return []
        return [*self._outages.log_waiting(self._lacking())]

    def _lacking(self) -> tuple[str, ...]:
        roles = ('the other roles',) if self._missing is None else self._missing
        return roles if self._offered else (*roles, 'codebook')

    # Pause

    def pause(self, event: PauseRequested, now_s: float) -> None:
        """Store that a pause was requested."""
        self._set_pausing(True)

    def resume(self, event: ResumeRequested, now_s: float) -> list[Action]:
        """Store that no pause is requested, and log that cycles resume."""
        self._set_pausing(False)
        return [LogMessage('resumed')]

    def _set_pausing(self, pausing: bool) -> None:
        self._pausing = pausing
        self._timeouts_s = timeouts(self._settings.in_use, pausing)

    def log_paused(self, event: PauseRequested | Timeout, now_s: float) -> list[Action]:
        """Log that the pause begins."""
        return [LogMessage(f'paused after cycle {self._cycle.id}')]

    def log_unanswered(self, event: Timeout, now_s: float) -> list[Action]:
        """Log that the pause begins because no user answered the beacon."""
        return [LogMessage(f'paused: no user answered the beacon of cycle {self._cycle.id}')]

    def reply_paused(self, event: PauseRequested, now_s: float) -> list[Action]:
        """Reply that the pause has begun."""
        return [Reply(True, 'paused')]

    def reply_already_paused(self, event: PauseRequested, now_s: float) -> list[Action]:
        """Reply that nothing changes."""
        return [Reply(True, 'already paused')]

    def reply_pausing(self, event: PauseRequested, now_s: float) -> list[Action]:
        """Reply that the pause begins later."""
        return [Reply(True, f'the pause begins after cycle {self._cycle.id}')]

    def reply_resumed(self, event: ResumeRequested, now_s: float) -> list[Action]:
        """Reply that cycles resume, and what they wait for."""
        lacking = ', '.join(self._lacking())
        return [Reply(True, f'resumed; waiting for {lacking}' if lacking else 'resumed')]

    def reply_not_paused(
            self, event: ResumeRequested | StepRequested, now_s: float) -> list[Action]:
        """Reply that there is no pause; without one, a step is refused."""
        if isinstance(event, StepRequested):
            return [Reply(False, 'not paused; a step requires a pause')]
        return [Reply(True, 'not paused')]

    def reply_stepping(self, event: StepRequested, now_s: float) -> list[Action]:
        """Reply that one cycle begins."""
        return [Reply(True, f'cycle {self._cycle.id} begins')]

    def reply_busy(self, event: StepRequested, now_s: float) -> list[Action]:
        """Reply that a step is refused during a cycle."""
        return [Reply(False, f'cycle {self._cycle.id} has not ended')]

    def reply_not_ready(self, event: StepRequested, now_s: float) -> list[Action]:
        """Reply that a step is refused because something is missing."""
        return [Reply(False, f'waiting for {", ".join(self._lacking())}')]

    # Beaconing

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
        self._times.start(now_s)
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

    # Positioning

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
        cycle, last = self._cycle, self._scenario.n_bands - 1
        first = min(set(range(last + 1)) - cycle.signals.keys())
        return [Send(m.PilotRequest(
            cycle_id=cycle.id, user=cycle.user, user_instance=cycle.user_instance,
            band=first, last_band=last, n_frames=self._scenario.n_frames))]

    def store_signals(self, event: m.FeedSignals, now_s: float) -> None:
        """Store the feed signals of a band; those of all bands come from the same instances."""
        self._cycle.user_instance = self._cycle.user_instance or event.user_instance
        self._cycle.channel = self._cycle.channel or event.sender
        self._cycle.signals[event.band] = event.signals

    def send_signals(self, event: m.FeedSignals, now_s: float) -> list[Action]:
        """Combine the signals of all bands and send the received signals to the positioner."""
        assert self._codebook
        cycle = self._cycle
        feeds = np.stack([cycle.signals[band] for band in range(self._scenario.n_bands)])
        signals = self._receiver(self._codebook, feeds, cycle.user, cycle.id,
                                 self._settings.in_use.receiver_noise)
        cycle.received = m.ReceivedSignals(
            cycle_id=cycle.id, user=cycle.user, user_instance=cycle.user_instance,
            codebook_id=self._codebook_id, signals=signals)
        return [Send(cycle.received), *self._announce(m.Phase.ESTIMATING, now_s)]

    def resend_signals(self, event: Timeout, now_s: float) -> list[Action]:
        """Send the received signals again."""
        assert self._cycle.received
        return [Send(self._cycle.received)]

    # Transmission and end of the cycle

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

    def abandon(self, outcome: Outcome, now_s: float) -> list[Action]:
        """End the cycle without service."""
        cycle, reason = self._cycle, outcome.value
        return [Send(self._times.end_cycle(reason, cycle.id, cycle.user, now_s)),
                *self._outages.log_lost_cycle(cycle.id, cycle.user, reason),
                *self._apply_settings()]

    def finish(self, event: m.Data, now_s: float) -> list[Action]:
        """End the cycle: the user was served."""
        cycle = self._cycle
        return [Send(self._times.end_cycle('served', cycle.id, cycle.user, now_s)),
                *self._outages.log_served_cycle(
                    cycle.id, cycle.user, self._codebook_id, self._users.n_users),
                *self._apply_settings()]

    def _announce(self, phase: m.Phase, now_s: float) -> list[Action]:
        return [Send(self._times.begin_phase(phase, self._cycle.id, self._cycle.user, now_s))]
