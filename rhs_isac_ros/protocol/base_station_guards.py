"""The memory of the base station, and the guards of its table."""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.ack_filter import AckFilter, parse_users
from rhs_isac_ros.protocol.base_station_states import Cycle, State, timeouts
from rhs_isac_ros.protocol.events import (
    CodebookOffered,
    PeersChanged,
    ResumeRequested,
    StepRequested,
    StoodBy,
    Timeout,
)
from rhs_isac_ros.protocol.outage_log import OutageLog
from rhs_isac_ros.protocol.pending_settings import PendingSettings
from rhs_isac_ros.protocol.phase_times import PhaseTimes
from rhs_isac_ros.protocol.settings import BaseStationSettings
from rhs_isac_ros.protocol.state_machine import StateMachine
from rhs_isac_ros.protocol.user_instances import UserInstances
from rhs_isac_ros.protocol.user_scheduler import UserScheduler


class BaseStationGuards(StateMachine[State]):
    """The memory of a base station, and the conditions of its table."""

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
        self._ack_filter = AckFilter(parse_users(settings.allowed_users), settings.ack_rate_hz)
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

    def wrong_band(self, event: m.FeedSignals, now_s: float) -> bool:
        """Whether feed signals belong to another band."""
        return event.band != self._cycle.band

    def duplicate_signals(self, event: m.FeedSignals, now_s: float) -> bool:
        """Whether the signals of the band were received before."""
        return event.band in self._cycle.signals

    def not_delivered_uplink(self, event: m.Data, now_s: float) -> bool:
        """Whether data are anything other than uplink data delivered by the channel."""
        return event.stage is m.Stage.OFFERED or event.direction is m.Direction.DOWNLINK

    def not_allowed(self, event: m.Ack, now_s: float) -> bool:
        """Whether the user is not in the list of allowed users."""
        return not self._ack_filter.allows(event.user)

    def too_often(self, event: m.Ack, now_s: float) -> bool:
        """Whether the user has reached its rate of acks."""
        return not self._ack_filter.within_rate(event.user, now_s)

    def superseded(self, event: m.Ack, now_s: float) -> bool:
        """Whether a newer instance owns the number of the user."""
        return self._instances.is_superseded(event.user, event.sender)

    def supersedes(self, event: m.Ack, now_s: float) -> bool:
        """Whether an older instance of the user acknowledged this cycle before."""
        return (self.duplicate_ack(event, now_s)
                and event.sender > self._instances.owner(event.user))

    def duplicate_ack(self, event: m.Ack, now_s: float) -> bool:
        """Whether the user acknowledged this cycle before."""
        return event.user in self._users.answered

    def crowded(self, event: m.Ack, now_s: float) -> bool:
        """Whether the user is new and the maximum number of users is reached."""
        return self._users.is_full_for(event.user)

    # Guards: progress within a cycle

    def last_ack(self, event: m.Ack, now_s: float) -> bool:
        """Whether the ack completes the set of users to wait for."""
        return self._users.is_complete_with(event.user)

    def last_band(self, event: m.FeedSignals, now_s: float) -> bool:
        """Whether the band is the last one."""
        return self._cycle.band == self._scenario.n_bands - 1

    def before_configured_band(self, event: m.FeedSignals, now_s: float) -> bool:
        """Whether the RHS has reported the configurations of the next band."""
        return self._cycle.band + 1 in self._cycle.configured

    def for_band(self, event: m.RhsConfiguration, now_s: float) -> bool:
        """Whether the RHS has reported the configurations of the band."""
        return event.mode is m.Mode.POSITIONING and event.band == self._cycle.band

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
