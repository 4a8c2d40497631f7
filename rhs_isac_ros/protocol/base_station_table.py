"""States, inputs and transitions of the base station."""

import enum
from collections.abc import Mapping

from rhs_isac_ros.protocol.settings import BaseStationSettings
from rhs_isac_ros.protocol.state_machine import ANY, SAME, Transition


class State(enum.Enum):
    """States of the base station."""

    WAITING = 'waiting'            # for a codebook and for the other roles
    RESTING = 'resting'            # between cycles
    BEACONING = 'beaconing'        # for acks
    CONFIGURING = 'configuring'    # for the surface to take a band's configurations
    SOUNDING = 'sounding'          # for the feed signals of a band
    ESTIMATING = 'estimating'      # for the position
    STEERING = 'steering'          # for the beam, and the surface to take it
    TRANSMITTING = 'transmitting'  # for the uplink data


class Input(enum.Enum):
    """Names of what can happen to the base station."""

    READY = 'ready'
    NOT_READY = 'not_ready'
    CODEBOOK = 'codebook'
    SETTINGS = 'settings'
    PEERS = 'peers'
    RETRY = 'retry'
    TIMEOUT = 'timeout'
    WINDOW_OVER = 'window_over'
    ACK = 'ack'
    LAST_ACK = 'last_ack'
    LATE_ACK = 'late_ack'
    CONFIGURED = 'configured'
    FRAME = 'frame'
    LAST_FRAME_OF_BAND = 'last_frame_of_band'
    LAST_FRAME = 'last_frame'
    ESTIMATE = 'estimate'
    NO_FIX = 'no_fix'
    BEAM = 'beam'
    BEAM_APPLIED = 'beam_applied'
    BEAM_READY = 'beam_ready'
    DELIVERED = 'delivered'
    OTHER_DATA = 'other_data'
    DUPLICATE = 'duplicate'
    WRONG_CYCLE = 'wrong_cycle'
    WRONG_USER = 'wrong_user'
    WRONG_BAND = 'wrong_band'
    WRONG_CODEBOOK = 'wrong_codebook'
    NOT_ALLOWED = 'not_allowed'
    TOO_OFTEN = 'too_often'
    CROWDED = 'crowded'


# States that are part of a granted cycle: each waits for an answer, and may ask for it again.
STEPS = (State.CONFIGURING, State.SOUNDING, State.ESTIMATING, State.STEERING, State.TRANSMITTING)


def timeouts(settings: BaseStationSettings) -> dict[State, float]:
    """Return the time-outs of the base station.

    Parameters
    ----------
    settings
        How it works.

    Returns
    -------
    dict
        Time-outs by state [s].
    """
    patience_s = settings.step_timeout_s / (settings.retries + 1)
    return {State.RESTING: settings.rest_s, State.BEACONING: settings.ack_timeout_s,
            **dict.fromkeys(STEPS, patience_s)}


S, I = State, Input  # noqa: E741

TABLE: Mapping[tuple[State | None, Input], Transition] = {
    # Between cycles.
    (S.WAITING, I.READY): Transition(S.BEACONING, ('keep', 'begin_cycle')),
    (S.WAITING, I.NOT_READY): Transition(SAME, ('keep', 'complain')),
    (S.RESTING, I.TIMEOUT): Transition(S.BEACONING, ('begin_cycle',)),
    (S.RESTING, I.NOT_READY): Transition(S.WAITING, ('complain',)),
    (ANY, I.CODEBOOK): Transition(SAME, ('keep',)),
    # Settings hold from the end of the present cycle on.
    (S.WAITING, I.SETTINGS): Transition(SAME, ('keep_settings', 'settle')),
    (S.RESTING, I.SETTINGS): Transition(SAME, ('keep_settings', 'settle'), rearm=True),
    (ANY, I.SETTINGS): Transition(SAME, ('keep_settings',)),
    (ANY, I.PEERS): Transition(SAME, ('keep',)),
    # Beaconing.
    (S.BEACONING, I.ACK): Transition(SAME, ('note_ack',)),
    (S.BEACONING, I.LAST_ACK): Transition(
        S.CONFIGURING, ('note_ack', 'grant', 'command_band', 'announce_positioning')),
    (S.BEACONING, I.WINDOW_OVER): Transition(
        S.CONFIGURING, ('grant', 'command_band', 'announce_positioning')),
    (S.BEACONING, I.NOT_READY): Transition(S.WAITING, ('complain',)),
    (S.BEACONING, I.TIMEOUT): Transition(
        SAME, ('settle', 'beacon_again'), counts='unanswered', rearm=True),
    (ANY, I.LATE_ACK): Transition(SAME, ('welcome',), counts='late_ack'),
    # Positioning.
    (S.CONFIGURING, I.CONFIGURED): Transition(S.SOUNDING, ('request_pilots',)),
    (S.CONFIGURING, I.RETRY): Transition(SAME, ('command_again',), counts='retry_rhs', rearm=True),
    (S.CONFIGURING, I.TIMEOUT): Transition(S.RESTING, ('abandon',), counts='rhs_silent'),
    (S.SOUNDING, I.CONFIGURED): Transition(SAME),
    (S.SOUNDING, I.FRAME): Transition(SAME, ('keep_frame',)),
    (S.SOUNDING, I.LAST_FRAME_OF_BAND): Transition(S.CONFIGURING, ('keep_frame', 'command_band')),
    (S.SOUNDING, I.LAST_FRAME): Transition(S.ESTIMATING, ('keep_frame', 'deliver')),
    # The surface too: the channel may not have heard what it reported.
    (S.SOUNDING, I.RETRY): Transition(
        SAME, ('command_again', 'request_pilots'), counts='retry_band', rearm=True),
    (S.SOUNDING, I.TIMEOUT): Transition(S.RESTING, ('forget_user', 'abandon'), counts='user_gone'),
    (S.ESTIMATING, I.ESTIMATE): Transition(S.STEERING),
    (S.ESTIMATING, I.NO_FIX): Transition(S.RESTING, ('abandon',), counts='no_fix'),
    (S.ESTIMATING, I.RETRY): Transition(
        SAME, ('deliver_again',), counts='retry_position', rearm=True),
    (S.ESTIMATING, I.TIMEOUT): Transition(S.RESTING, ('abandon',), counts='positioner_silent'),
    # Transmission. Beam and configuration come from two nodes, in either order.
    (S.ESTIMATING, I.BEAM): Transition(S.STEERING, ('keep_beam',)),
    (S.STEERING, I.ESTIMATE): Transition(SAME),
    (S.STEERING, I.BEAM): Transition(SAME, ('keep_beam',)),
    (S.ESTIMATING, I.BEAM_APPLIED): Transition(S.STEERING, ('keep_applied',)),
    (S.STEERING, I.BEAM_APPLIED): Transition(SAME, ('keep_applied',)),
    (S.STEERING, I.BEAM_READY): Transition(S.TRANSMITTING, ('keep_beam', 'offer_data')),
    # From the start: who heard its part already answers the same again.
    (S.STEERING, I.RETRY): Transition(SAME, ('deliver_again',), counts='retry_beam', rearm=True),
    (S.STEERING, I.TIMEOUT): Transition(S.RESTING, ('abandon',), counts='transmission_silent'),
    (S.RESTING, I.DELIVERED): Transition(SAME, counts='duplicate'),
    (S.TRANSMITTING, I.DELIVERED): Transition(S.RESTING, ('finish',)),
    # The channel may not have heard the beam, or that the surface took it.
    (S.TRANSMITTING, I.RETRY): Transition(
        SAME, ('deliver_again', 'offer_again'), counts='retry_data', rearm=True),
    # What was asked for twice may be answered twice.
    (S.TRANSMITTING, I.ESTIMATE): Transition(SAME, counts='duplicate'),
    (S.TRANSMITTING, I.BEAM): Transition(SAME, counts='duplicate'),
    (S.TRANSMITTING, I.BEAM_READY): Transition(SAME, counts='duplicate'),
    (S.TRANSMITTING, I.TIMEOUT): Transition(S.RESTING, ('abandon',), counts='data_lost'),
    (ANY, I.OTHER_DATA): Transition(SAME),
    # What belongs to no step is dropped.
    (ANY, I.DUPLICATE): Transition(SAME, counts='duplicate'),
    (ANY, I.WRONG_CYCLE): Transition(SAME, counts='wrong_cycle'),
    (ANY, I.WRONG_USER): Transition(SAME, counts='wrong_user'),
    (ANY, I.WRONG_BAND): Transition(SAME, counts='wrong_band'),
    (ANY, I.WRONG_CODEBOOK): Transition(SAME, counts='wrong_codebook'),
    # Acks that the gate or the roster refuses.
    (ANY, I.NOT_ALLOWED): Transition(SAME, counts='not_allowed'),
    (ANY, I.TOO_OFTEN): Transition(SAME, counts='too_often'),
    (ANY, I.CROWDED): Transition(SAME, counts='crowded'),
}
