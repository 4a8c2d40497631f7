"""The user: answers beacons, sends pilots, exchanges data."""

import enum
from collections.abc import Mapping
from typing import Any

from rhs_isac_ros.model.mobility import Mobility
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, Event, LogMessage, PeersChanged, Send, Tick
from rhs_isac_ros.protocol.state_machine import ANY, SAME, StateMachine, Transition


class State(enum.Enum):
    """States of a user."""

    DISCONNECTED = 'disconnected'                # base station or channel is not there
    LISTENING = 'listening'        # for a beacon
    NO_BEACON = 'no_beacon'          # the same, for too long
    ACKNOWLEDGED = 'acknowledged'  # waiting for the grant
    GRANTED = 'granted'            # being positioned and served


class Input(enum.Enum):
    """Names of what can happen to a user."""

    CONNECTED = 'connected'
    CUT_OFF = 'cut_off'
    BEACON = 'beacon'
    STALE_BEACON = 'stale_beacon'
    GRANT = 'grant'
    LATE_GRANT = 'late_grant'
    OTHER_GRANT = 'other_grant'
    OTHER_USER = 'other_user'
    PILOT_REQUEST = 'pilot_request'
    SAME_REQUEST = 'same_request'
    DOWNLINK = 'downlink'
    OTHER_DATA = 'other_data'
    WRONG_CYCLE = 'wrong_cycle'
    TIMEOUT = 'timeout'


S, I = State, Input  # noqa: E741

TABLE: Mapping[tuple[State | None, Input], Transition] = {
    (S.DISCONNECTED, I.CONNECTED): Transition(S.LISTENING, ('say_found',)),
    (S.DISCONNECTED, I.CUT_OFF): Transition(SAME, ('say_missing',)),
    (S.DISCONNECTED, I.BEACON): Transition(SAME),
    (ANY, I.CONNECTED): Transition(SAME),
    (ANY, I.CUT_OFF): Transition(S.DISCONNECTED, ('say_missing',)),
    # The base station may take longer than this user waited.
    (S.LISTENING, I.GRANT): Transition(S.GRANTED, ('stand',)),
    (S.LISTENING, I.BEACON): Transition(S.ACKNOWLEDGED, ('acknowledge',)),
    (S.LISTENING, I.TIMEOUT): Transition(S.NO_BEACON, ('say_uncalled',), counts='no_beacon'),
    (S.NO_BEACON, I.GRANT): Transition(S.GRANTED, ('say_called', 'stand')),
    (S.NO_BEACON, I.BEACON): Transition(S.ACKNOWLEDGED, ('say_called', 'acknowledge')),
    (S.ACKNOWLEDGED, I.BEACON): Transition(SAME, ('acknowledge',), rearm=True),
    (S.ACKNOWLEDGED, I.GRANT): Transition(S.GRANTED, ('stand',)),
    # A request that overtakes the grant says the same.
    (S.ACKNOWLEDGED, I.PILOT_REQUEST): Transition(S.GRANTED, ('stand', 'send_pilots')),
    (S.ACKNOWLEDGED, I.OTHER_GRANT): Transition(S.LISTENING),
    (S.ACKNOWLEDGED, I.TIMEOUT): Transition(S.LISTENING, counts='not_granted'),
    (S.GRANTED, I.GRANT): Transition(SAME),
    (S.GRANTED, I.PILOT_REQUEST): Transition(SAME, ('send_pilots',), rearm=True),
    # Something was lost: perhaps the pilots, perhaps where they come from.
    (S.GRANTED, I.SAME_REQUEST): Transition(
        SAME, ('stand', 'send_pilots'), counts='asked_again', rearm=True),
    (S.GRANTED, I.DOWNLINK): Transition(S.LISTENING, ('send_uplink',)),
    (S.LISTENING, I.DOWNLINK): Transition(SAME, ('send_uplink',), counts='asked_again'),
    (S.GRANTED, I.BEACON): Transition(S.ACKNOWLEDGED, ('acknowledge',), counts='abandoned'),
    (S.GRANTED, I.TIMEOUT): Transition(S.LISTENING, counts='bs_silent'),
    (ANY, I.STALE_BEACON): Transition(SAME, counts='stale_beacon'),
    (ANY, I.LATE_GRANT): Transition(SAME, counts='late_grant'),
    (ANY, I.OTHER_GRANT): Transition(SAME),
    (ANY, I.OTHER_USER): Transition(SAME),
    (ANY, I.OTHER_DATA): Transition(SAME),
    (ANY, I.WRONG_CYCLE): Transition(SAME, counts='wrong_cycle'),
}


# Cycles that are known again; of older ones no message can still be on its way.
_MOST_KNOWN = 8
# Steps of a cycle that the base station may wait for while its user hears nothing: the last
# band's signals, the position, the beam, and the data.
_SILENT_STEPS = 4


def timeouts(step_s: float, beacon_s: float) -> dict[State, float]:
    """Return the time-outs of a user.

    Parameters
    ----------
    step_s
        How long the base station waits for each step [s].
    beacon_s
        How long is too long without a beacon [s].

    Returns
    -------
    dict
        Time-outs by state [s].
    """
    return {State.LISTENING: beacon_s, State.ACKNOWLEDGED: step_s,
            State.GRANTED: _SILENT_STEPS * step_s}


class User(StateMachine):
    """The role of a user.

    Parameters
    ----------
    user
        Number of the user, from 1.
    mobility
        Where the user is at a time.
    timeouts_s
        Time-outs by state.
    """

    SENDS = (m.Ack, m.GroundTruth, m.Pilot, m.Data)
    RECEIVES = (m.Beacon, m.Grant, m.PilotRequest, m.Data)

    TABLE = TABLE
    LACKING = frozenset({State.DISCONNECTED, State.NO_BEACON})

    def __init__(
            self, user: int, mobility: Mobility, timeouts_s: Mapping[State, float]) -> None:
        super().__init__(State.DISCONNECTED, timeouts_s)
        self.user = user
        self._mobility = mobility
        self._cycle_id = 0
        # Cycle and band of the pilots that were sent last.
        self._sounded = (0, 0)
        # By cycle: the highest attempt heard, and where it stood, which holds for all of it.
        self._heard: dict[int, int] = {}
        self._truths: dict[int, m.GroundTruth] = {}

    def ground_truth(self, now_s: float, cycle_id: int = 0) -> m.GroundTruth:
        """Return where the user is.

        Parameters
        ----------
        now_s
            The time, on the clock of `handle` [s].
        cycle_id
            The cycle for which the position holds; 0 for none.

        Returns
        -------
        GroundTruth
            Position and velocity.
        """
        return m.GroundTruth(cycle_id, self.user, *self._mobility.state(now_s))

    def _classify(self, event: Event) -> Input:
        match event:
            case Tick():
                return Input.TIMEOUT
            case PeersChanged(missing):
                return Input.CUT_OFF if missing else Input.CONNECTED
            case m.Beacon():
                return Input.STALE_BEACON if self._is_stale(event) else Input.BEACON
            case m.Data(stage=m.Stage.OFFERED) | m.Data(direction=m.Direction.UPLINK):
                return Input.OTHER_DATA
        if event.user != self.user:
            ours = isinstance(event, m.Grant) and event.cycle_id == self._cycle_id
            return Input.OTHER_GRANT if ours else Input.OTHER_USER
        if event.cycle_id != self._cycle_id:
            return Input.WRONG_CYCLE
        if isinstance(event, m.Grant) and self._is_done:
            return Input.LATE_GRANT
        if isinstance(event, m.PilotRequest) and self._sounded == (event.cycle_id, event.band):
            return Input.SAME_REQUEST
        names = {m.Grant: Input.GRANT, m.PilotRequest: Input.PILOT_REQUEST,
                 m.Data: Input.DOWNLINK}
        return names[type(event)]

    def _is_stale(self, beacon: m.Beacon) -> bool:
        """Tell whether a beacon says nothing new: a late one, or the double of another."""
        granted = self.state is State.GRANTED and beacon.cycle_id == self._cycle_id
        return granted or beacon.attempt <= self._heard.get(beacon.cycle_id, -1)

    @property
    def _is_done(self) -> bool:
        """Whether its cycle was granted before, and is over."""
        return self._cycle_id in self._truths and self.state is not State.GRANTED

    def _say_found(self, event: PeersChanged, now_s: float) -> list[Action]:
        return [LogMessage('listening for beacons')]

    def _say_missing(self, event: PeersChanged, now_s: float) -> list[Action]:
        return [LogMessage(f'waiting for {", ".join(event.missing)}', warning=True)]

    def _say_uncalled(self, event: Tick, now_s: float) -> list[Action]:
        wait_s = self._timeouts_s[State.LISTENING]
        return [LogMessage(f'no beacon for {wait_s:g} s', warning=True)]

    def _say_called(self, event: m.Beacon | m.Grant, now_s: float) -> list[Action]:
        return [LogMessage('called again')]

    def _acknowledge(self, event: m.Beacon, now_s: float) -> list[Action]:
        self._cycle_id = event.cycle_id
        _keep(self._heard, event.cycle_id, event.attempt)
        return [Send(m.Ack(event.cycle_id, self.user))]

    def _stand(self, event: m.Grant | m.PilotRequest, now_s: float) -> list[Action]:
        truth = self._truths.get(event.cycle_id) or self.ground_truth(now_s, event.cycle_id)
        _keep(self._truths, event.cycle_id, truth)
        return [Send(truth)]

    def _send_pilots(self, event: m.PilotRequest, now_s: float) -> list[Action]:
        self._sounded = event.cycle_id, event.band
        return [Send(m.Pilot(event.cycle_id, self.user, event.band, frame, 1.0, 0.0))
                for frame in range(event.n_frames)]

    def _send_uplink(self, event: m.Data, now_s: float) -> list[Action]:
        return [Send(m.Data(event.cycle_id, self.user, m.Direction.UPLINK, m.Stage.OFFERED,
                            event.duration_s, event.bits))]


def _keep(items: dict, cycle_id: int, item: Any) -> None:
    """Remember something of a cycle, and forget the oldest."""
    items.pop(cycle_id, None)
    items[cycle_id] = item
    if len(items) > _MOST_KNOWN:
        del items[next(iter(items))]
