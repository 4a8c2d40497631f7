"""States of the base station, their timeouts, and the memory of a cycle."""

import dataclasses
import enum

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.settings import BaseStationSettings


class State(enum.Enum):
    """States of the base station."""

    WAITING = 'waiting'            # waits for a codebook and the other roles
    PAUSED = 'paused'              # waits for an operator to resume or step the cycles
    RESTING = 'resting'            # waits between cycles
    BEACONING = 'beaconing'        # waits for acks
    CONFIGURING = 'configuring'    # waits for the RHS to report a band's configurations
    SOUNDING = 'sounding'          # waits for the feed signals of a band
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
    band
        Band that is being sounded.
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
    band: int = 0
    configured: set[int] = dataclasses.field(default_factory=set)
    signals: dict[int, np.ndarray] = dataclasses.field(default_factory=dict)
    received: m.ReceivedSignals | None = None
    beam: m.Beam | None = None
    beam_applied: bool = False
