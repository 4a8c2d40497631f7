"""The base station, which sends beacons, then selects, positions and serves a user per cycle."""

import dataclasses
from collections.abc import Callable, Iterable

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station_steps import NOT_BEACONING
from rhs_isac_ros.protocol.base_station_steps import BaseStationSteps as Steps
from rhs_isac_ros.protocol.base_station_steps import State as State
from rhs_isac_ros.protocol.events import (
    Action,
    CodebookOffered,
    PauseRequested,
    PeersChanged,
    Resumed,
    ResumeRequested,
    SettingsOffered,
    StepRequested,
    StoodBy,
    Timeout,
)
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.state_machine import EventT, Transition


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Row(Transition[State, Steps, EventT]):
    """A row of the base station's table."""


def give_up(
        source: State, event: type[EventT], outcome: Outcome,
        before: tuple[Callable[[Steps, EventT, float], Iterable[Action] | None], ...] = (),
) -> Row[EventT]:
    """Return a row that ends the cycle without service; `outcome` is counted and published."""
    def abandon(role: Steps, event: EventT, now_s: float) -> list[Action]:
        return role.abandon(outcome, now_s)

    return Row(source=(source,), event=event, actions=(*before, abandon), target=State.RESTING,
               outcome=outcome)


# Every event, in the order in which its rows are tried.
TABLE = (
    # Offers and presence. A new codebook and new settings take effect with the next cycle.
    Row(source=(State.WAITING,), event=CodebookOffered, guard=Steps.peers_present,
        actions=(Steps.store_codebook, Steps.begin_cycle), target=State.BEACONING),
    Row(source=(State.WAITING,), event=CodebookOffered,
        actions=(Steps.store_codebook, Steps.log_not_ready)),
    Row(event=CodebookOffered, actions=(Steps.store_codebook,)),

    Row(source=(State.WAITING,), event=PeersChanged, guard=Steps.ready_with_peers,
        actions=(Steps.store_peers, Steps.begin_cycle), target=State.BEACONING),
    Row(source=(State.WAITING,), event=PeersChanged,
        actions=(Steps.store_peers, Steps.log_not_ready)),
    Row(event=PeersChanged, actions=(Steps.store_peers,)),

    Row(source=(State.WAITING, State.PAUSED), event=SettingsOffered,
        actions=(Steps.store_settings, Steps.apply_settings)),
    Row(source=(State.RESTING,), event=SettingsOffered,
        actions=(Steps.store_settings, Steps.apply_settings), restart_timeout=True),
    Row(event=SettingsOffered, actions=(Steps.store_settings,)),

    # A newer base station serves, or has gone. A pause outlasts both.
    Row(event=StoodBy, guard=Steps.pausing, actions=(Steps.forget_peers,), target=State.PAUSED),
    Row(event=StoodBy, actions=(Steps.forget_peers,), target=State.WAITING),
    Row(source=(State.WAITING, State.PAUSED), event=Resumed, actions=(Steps.skip_cycles,)),

    # Requests of an operator. A pause begins between two cycles; a step runs one cycle of a pause.
    Row(source=(State.PAUSED,), event=PauseRequested, actions=(Steps.reply_already_paused,)),
    Row(source=(State.WAITING, State.RESTING), event=PauseRequested,
        actions=(Steps.pause, Steps.log_paused, Steps.reply_paused), target=State.PAUSED),
    Row(event=PauseRequested, actions=(Steps.pause, Steps.reply_pausing)),

    Row(source=(State.PAUSED,), event=ResumeRequested, guard=Steps.not_ready,
        actions=(Steps.resume, Steps.log_not_ready, Steps.reply_resumed), target=State.WAITING),
    Row(source=(State.PAUSED,), event=ResumeRequested,
        actions=(Steps.resume, Steps.begin_cycle, Steps.reply_resumed), target=State.BEACONING),
    Row(event=ResumeRequested, guard=Steps.pausing, actions=(Steps.resume, Steps.reply_resumed)),
    Row(event=ResumeRequested, actions=(Steps.reply_not_paused,)),

    Row(source=(State.PAUSED,), event=StepRequested, guard=Steps.not_ready,
        actions=(Steps.reply_not_ready,)),
    Row(source=(State.PAUSED,), event=StepRequested,
        actions=(Steps.begin_cycle, Steps.reply_stepping), target=State.BEACONING),
    Row(event=StepRequested, guard=Steps.pausing, actions=(Steps.reply_busy,)),
    Row(event=StepRequested, actions=(Steps.reply_not_paused,)),

    # Timeouts.
    Row(source=(State.RESTING,), event=Timeout, guard=Steps.pausing,
        actions=(Steps.log_paused,), target=State.PAUSED),
    Row(source=(State.RESTING,), event=Timeout, guard=Steps.not_ready,
        actions=(Steps.log_not_ready,), target=State.WAITING),
    Row(source=(State.RESTING,), event=Timeout, actions=(Steps.begin_cycle,),
        target=State.BEACONING),

    Row(source=(State.BEACONING,), event=Timeout, guard=Steps.some_acks,
        actions=(Steps.grant, Steps.command_bands, Steps.announce_positioning),
        target=State.CONFIGURING),
    Row(source=(State.BEACONING,), event=Timeout, guard=Steps.pausing,
        actions=(Steps.apply_settings, Steps.log_unanswered), target=State.PAUSED),
    Row(source=(State.BEACONING,), event=Timeout, guard=Steps.not_ready,
        actions=(Steps.log_not_ready,), target=State.WAITING),
    Row(source=(State.BEACONING,), event=Timeout,
        actions=(Steps.apply_settings, Steps.beacon_again), outcome=Outcome.UNANSWERED,
        restart_timeout=True),

    Row(source=(State.CONFIGURING,), event=Timeout, guard=Steps.may_retry,
        actions=(Steps.command_bands,), outcome=Outcome.RETRY_RHS, restart_timeout=True),
    give_up(State.CONFIGURING, Timeout, Outcome.RHS_SILENT),

    # Repeat the command as well, because the channel may have missed the report of the RHS.
    Row(source=(State.SOUNDING,), event=Timeout, guard=Steps.may_retry,
        actions=(Steps.command_silent_bands, Steps.request_pilots), outcome=Outcome.RETRY_BAND,
        restart_timeout=True),
    give_up(State.SOUNDING, Timeout, Outcome.USER_GONE, before=(Steps.remove_user,)),

    Row(source=(State.ESTIMATING,), event=Timeout, guard=Steps.may_retry,
        actions=(Steps.resend_signals,), outcome=Outcome.RETRY_POSITION, restart_timeout=True),
    give_up(State.ESTIMATING, Timeout, Outcome.POSITIONER_SILENT),

    # Resend the received signals: each role repeats its reply to a repeated message, which also
    # repeats the beam.
    Row(source=(State.STEERING,), event=Timeout, guard=Steps.may_retry,
        actions=(Steps.resend_signals,), outcome=Outcome.RETRY_BEAM, restart_timeout=True),
    give_up(State.STEERING, Timeout, Outcome.TRANSMISSION_SILENT),

    # The channel may have missed the beam or its configuration.
    Row(source=(State.TRANSMITTING,), event=Timeout, guard=Steps.may_retry,
        actions=(Steps.resend_signals, Steps.send_downlink), outcome=Outcome.RETRY_DATA,
        restart_timeout=True),
    give_up(State.TRANSMITTING, Timeout, Outcome.DATA_LOST),

    # Acks. All count towards the rate of their user, except those from users that are not allowed
    # or have reached their rate.
    Row(event=m.Ack, guard=Steps.not_allowed, outcome=Outcome.NOT_ALLOWED),
    Row(event=m.Ack, guard=Steps.too_often, outcome=Outcome.TOO_OFTEN),
    Row(event=m.Ack, guard=Steps.wrong_cycle, actions=(Steps.count_ack,),
        outcome=Outcome.WRONG_CYCLE),
    # Of several nodes with the same number, the first is served.
    Row(event=m.Ack, guard=Steps.number_taken, actions=(Steps.count_ack, Steps.reject_number),
        outcome=Outcome.NUMBER_TAKEN),
    Row(event=m.Ack, guard=Steps.duplicate_ack, actions=(Steps.count_ack,),
        outcome=Outcome.DUPLICATE),
    # A late ack: this cycle no longer collects acks; the user is registered for the next one.
    Row(source=NOT_BEACONING, event=m.Ack, actions=(Steps.count_ack, Steps.register_user),
        outcome=Outcome.LATE_ACK),
    Row(source=(State.BEACONING,), event=m.Ack, guard=Steps.last_ack,
        actions=(Steps.count_ack, Steps.accept_ack, Steps.grant, Steps.command_bands,
                 Steps.announce_positioning),
        target=State.CONFIGURING),
    Row(source=(State.BEACONING,), event=m.Ack, actions=(Steps.count_ack, Steps.accept_ack)),

    # Reports of the RHS: a band's configurations, or the configuration of the beam.
    Row(event=m.RhsConfiguration, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    Row(event=m.RhsConfiguration, guard=Steps.wrong_codebook, outcome=Outcome.WRONG_CODEBOOK),
    Row(source=(State.CONFIGURING,), event=m.RhsConfiguration, guard=Steps.last_configuration,
        actions=(Steps.store_configured, Steps.request_pilots), target=State.SOUNDING),
    Row(source=(State.CONFIGURING, State.SOUNDING), event=m.RhsConfiguration,
        guard=Steps.for_positioning, actions=(Steps.store_configured,)),
    Row(source=(State.ESTIMATING, State.STEERING, State.TRANSMITTING), event=m.RhsConfiguration,
        guard=Steps.for_positioning, outcome=Outcome.DUPLICATE),
    # The beam and its configuration come from two roles, in either order.
    Row(source=(State.ESTIMATING,), event=m.RhsConfiguration, guard=Steps.for_beam,
        actions=(Steps.store_beam_applied,), target=State.STEERING),
    Row(source=(State.STEERING,), event=m.RhsConfiguration, guard=Steps.for_known_beam,
        actions=(Steps.begin_transmission,), target=State.TRANSMITTING),
    Row(source=(State.STEERING,), event=m.RhsConfiguration, guard=Steps.for_beam,
        actions=(Steps.store_beam_applied,)),
    # A repeated request may be answered twice.
    Row(source=(State.TRANSMITTING,), event=m.RhsConfiguration, guard=Steps.for_beam,
        outcome=Outcome.DUPLICATE),

    # Feed signals.
    Row(event=m.FeedSignals, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    Row(event=m.FeedSignals, guard=Steps.wrong_user, outcome=Outcome.WRONG_USER),
    Row(event=m.FeedSignals, guard=Steps.wrong_instance, outcome=Outcome.WRONG_INSTANCE),
    Row(event=m.FeedSignals, guard=Steps.duplicate_signals, outcome=Outcome.DUPLICATE),
    Row(source=(State.SOUNDING,), event=m.FeedSignals, guard=Steps.last_signals,
        actions=(Steps.store_signals, Steps.send_signals), target=State.ESTIMATING),
    Row(source=(State.SOUNDING,), event=m.FeedSignals, actions=(Steps.store_signals,),
        enter_again=True),

    # Position estimates.
    Row(event=m.PositionEstimate, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    Row(event=m.PositionEstimate, guard=Steps.wrong_user, outcome=Outcome.WRONG_USER),
    Row(event=m.PositionEstimate, guard=Steps.wrong_codebook, outcome=Outcome.WRONG_CODEBOOK),
    Row(source=(State.ESTIMATING,), event=m.PositionEstimate, target=State.STEERING),
    Row(source=(State.STEERING,), event=m.PositionEstimate),
    Row(source=(State.TRANSMITTING,), event=m.PositionEstimate, outcome=Outcome.DUPLICATE),

    Row(event=m.NoFix, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    Row(event=m.NoFix, guard=Steps.wrong_user, outcome=Outcome.WRONG_USER),
    Row(event=m.NoFix, guard=Steps.wrong_codebook, outcome=Outcome.WRONG_CODEBOOK),
    give_up(State.ESTIMATING, m.NoFix, Outcome.NO_FIX),

    # Beams.
    Row(event=m.Beam, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    Row(event=m.Beam, guard=Steps.wrong_user, outcome=Outcome.WRONG_USER),
    Row(event=m.Beam, guard=Steps.wrong_codebook, outcome=Outcome.WRONG_CODEBOOK),
    Row(source=(State.ESTIMATING,), event=m.Beam, actions=(Steps.store_beam,),
        target=State.STEERING),
    Row(source=(State.STEERING,), event=m.Beam, guard=Steps.beam_applied,
        actions=(Steps.store_beam, Steps.begin_transmission), target=State.TRANSMITTING),
    Row(source=(State.STEERING,), event=m.Beam, actions=(Steps.store_beam,)),
    Row(source=(State.TRANSMITTING,), event=m.Beam, outcome=Outcome.DUPLICATE),

    # Data. Delivered uplink data end the cycle.
    Row(event=m.Data, guard=Steps.not_delivered_uplink),
    Row(event=m.Data, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    Row(event=m.Data, guard=Steps.wrong_user, outcome=Outcome.WRONG_USER),
    Row(source=(State.TRANSMITTING,), event=m.Data, actions=(Steps.finish,),
        target=State.RESTING),
    Row(source=(State.PAUSED, State.RESTING), event=m.Data, outcome=Outcome.DUPLICATE),
)


class BaseStation(Steps):
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
    TABLE = TABLE
    EVENT_NAMES = {
        CodebookOffered: 'codebook', PeersChanged: 'peers', SettingsOffered: 'settings',
        PauseRequested: 'pause', ResumeRequested: 'resume', StepRequested: 'step',
        StoodBy: 'stood_by', Resumed: 'resumed', Timeout: 'timeout', m.Ack: 'ack',
        m.RhsConfiguration: 'configured', m.FeedSignals: 'signals',
        m.PositionEstimate: 'estimate', m.NoFix: 'no_fix', m.Beam: 'beam', m.Data: 'delivered'}
    BLOCKED_STATES = frozenset({State.WAITING})
