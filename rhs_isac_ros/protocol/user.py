"""The user, which answers beacons, sends pilots and exchanges data."""

import dataclasses
import enum
from collections.abc import Mapping

from rhs_isac_ros.model.mobility import Mobility
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, LogMessage, PeersChanged, Send, Timeout
from rhs_isac_ros.protocol.instance import started
from rhs_isac_ros.protocol.newest import NewestDict
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.state_machine import EventT, StateMachine, Transition

# Number of cycles kept; no message of an older cycle can still be in transit.
_MAX_REMEMBERED = 8
# Steps of a cycle during which the user may receive nothing: the signals of the last band, the
# position, the beam and the data.
_SILENT_STEPS = 4


class State(enum.Enum):
    """States of a user."""

    DISCONNECTED = 'disconnected'  # waits for the base station and the channel
    LISTENING = 'listening'        # waits for a beacon
    NO_BEACON = 'no_beacon'        # waits for a beacon for longer than the timeout
    ACKNOWLEDGED = 'acknowledged'  # waits for the grant
    GRANTED = 'granted'            # is being positioned and served


def timeouts(step_s: float, beacon_s: float) -> dict[State, float]:
    """Return the timeouts of a user.

    Parameters
    ----------
    step_s
        Time that the base station waits for each step [s].
    beacon_s
        Time without a beacon after which the user logs a warning [s].

    Returns
    -------
    dict
        Timeouts by state [s].
    """
    return {State.LISTENING: beacon_s, State.ACKNOWLEDGED: step_s,
            State.GRANTED: _SILENT_STEPS * step_s}


class UserSteps(StateMachine[State]):
    """The memory of a user, and the guards and actions of its table."""

    def __init__(
            self, user: int, mobility: Mobility, timeouts_s: Mapping[State, float],
            instance: int = 0) -> None:
        super().__init__(State.DISCONNECTED, timeouts_s)
        self.user, self._instance = user, instance
        # Describes the node with the same number that is served instead; empty if there is none.
        self._conflict = ''
        self._mobility = mobility
        self._cycle_id = 0
        # Cycle and band of the last pilot request answered.
        self._sounded = (0, 0)
        # By cycle: the highest attempt received, and the position, fixed for the whole cycle.
        self._attempts: NewestDict[int, int] = NewestDict(_MAX_REMEMBERED)
        self._truths: NewestDict[int, m.GroundTruth] = NewestDict(_MAX_REMEMBERED)

    def ground_truth(self, now_s: float, cycle_id: int = 0) -> m.GroundTruth:
        """Return the user's position and velocity.

        Parameters
        ----------
        now_s
            Time on the clock of `handle` [s].
        cycle_id
            The cycle to which the position applies; 0 for none.
        """
        position, velocity = self._mobility.state(now_s)
        return m.GroundTruth(
            cycle_id=cycle_id, user=self.user, position=position, velocity=velocity)

    def status(self) -> Mapping[str, str]:
        """Return ``conflict.user`` while another node with the same number is served."""
        return {'conflict.user': self._conflict} if self._conflict else {}

    # Guards

    def peers_missing(self, event: PeersChanged, now_s: float) -> bool:
        """Whether a role that the user needs is missing."""
        return bool(event.missing)

    def stale_beacon(self, event: m.Beacon, now_s: float) -> bool:
        """Whether a beacon is late or a duplicate."""
        granted = self.state is State.GRANTED and event.cycle_id == self._cycle_id
        return granted or event.attempt <= self._attempts.get(event.cycle_id, -1)

    def other_user(self, event: m.Grant | m.PilotRequest | m.Data, now_s: float) -> bool:
        """Whether a message is addressed to another user."""
        return event.user != self.user

    def other_user_granted(self, event: m.Grant, now_s: float) -> bool:
        """Whether the acknowledged cycle is granted to another user."""
        return event.user != self.user and event.cycle_id == self._cycle_id

    def other_instance_granted(self, event: m.Grant, now_s: float) -> bool:
        """Whether the acknowledged cycle is granted to another node with the same number."""
        return self.other_instance(event, now_s) and event.cycle_id == self._cycle_id

    def other_instance(self, event: m.Grant | m.PilotRequest, now_s: float) -> bool:
        """Whether a message is addressed to another node with the same number."""
        return not m.same_instance(event.user_instance, self._instance)

    def not_granted(self, event: m.Data, now_s: float) -> bool:
        """Whether this node was not granted the cycle of the data."""
        return event.cycle_id not in self._truths

    def wrong_cycle(self, event: m.Grant | m.PilotRequest | m.Data, now_s: float) -> bool:
        """Whether a message belongs to a cycle other than the one acknowledged last."""
        return event.cycle_id != self._cycle_id

    def late_grant(self, event: m.Grant, now_s: float) -> bool:
        """Whether the cycle was granted before and has ended."""
        return event.cycle_id in self._truths and self.state is not State.GRANTED

    def new_request(self, event: m.PilotRequest, now_s: float) -> bool:
        """Whether a request differs from the last one answered."""
        return self._sounded != (event.cycle_id, event.band)

    def not_delivered_downlink(self, event: m.Data, now_s: float) -> bool:
        """Whether data are anything other than downlink data delivered by the channel."""
        return event.stage is m.Stage.OFFERED or event.direction is m.Direction.UPLINK

    # Actions

    def log_connected(self, event: PeersChanged, now_s: float) -> list[Action]:
        """Log that no role is missing."""
        return [LogMessage('listening for beacons')]

    def log_missing_peers(self, event: PeersChanged, now_s: float) -> list[Action]:
        """Log the missing roles."""
        return [LogMessage(f'waiting for {", ".join(event.missing)}', warning=True)]

    def log_no_beacon(self, event: Timeout, now_s: float) -> list[Action]:
        """Log that beacons have ceased."""
        wait_s = self._timeouts_s[State.LISTENING]
        return [LogMessage(f'no beacon for {wait_s:g} s', warning=True)]

    def log_resumed(self, event: m.Beacon | m.Grant, now_s: float) -> list[Action]:
        """Log that the base station is active again."""
        return [LogMessage('beacons resumed')]

    def log_other_instance(self, event: m.Grant, now_s: float) -> list[Action]:
        """Log once that a newer node with the same number is served."""
        if event.user_instance < self._instance:
            # A cycle that was granted before the base station received an ack of this node.
            return []
        text = (f'user {self.user}: two nodes have this number; the newer one, '
                f'{started(event.user_instance)}, is served')
        known, self._conflict = self._conflict, text
        return [] if known else [LogMessage(text, warning=True)]

    def acknowledge(self, event: m.Beacon, now_s: float) -> list[Action]:
        """Answer a beacon."""
        self._cycle_id = event.cycle_id
        self._attempts.put(event.cycle_id, event.attempt)
        return [Send(m.Ack(cycle_id=event.cycle_id, user=self.user))]

    def publish_position(self, event: m.Grant | m.PilotRequest, now_s: float) -> list[Action]:
        """Publish the position that applies to the cycle."""
        self._conflict = ''
        truth = self._truths.get(event.cycle_id) or self.ground_truth(now_s, event.cycle_id)
        self._truths.put(event.cycle_id, truth)
        return [Send(truth)]

    def send_pilots(self, event: m.PilotRequest, now_s: float) -> list[Action]:
        """Send a pilot in each frame of a band."""
        self._sounded = event.cycle_id, event.band
        return [Send(m.Pilot(
            cycle_id=event.cycle_id, user=self.user, band=event.band, frame=frame, symbol_re=1.0,
            symbol_im=0.0))
                for frame in range(event.n_frames)]

    def send_uplink(self, event: m.Data, now_s: float) -> list[Action]:
        """Answer downlink data with the same amount of uplink data."""
        return [Send(m.Data(
            cycle_id=event.cycle_id, user=self.user, direction=m.Direction.UPLINK,
            stage=m.Stage.OFFERED, duration_s=event.duration_s, bits=event.bits))]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Row(Transition[State, UserSteps, EventT]):
    """A row of the user's table."""


Steps = UserSteps

TABLE = (
    Row(event=PeersChanged, guard=Steps.peers_missing, actions=(Steps.log_missing_peers,),
        target=State.DISCONNECTED),
    Row(source=(State.DISCONNECTED,), event=PeersChanged, actions=(Steps.log_connected,),
        target=State.LISTENING),
    Row(event=PeersChanged),

    Row(source=(State.LISTENING,), event=Timeout, actions=(Steps.log_no_beacon,),
        target=State.NO_BEACON, outcome=Outcome.NO_BEACON),
    Row(source=(State.ACKNOWLEDGED,), event=Timeout, target=State.LISTENING,
        outcome=Outcome.NOT_GRANTED),
    Row(source=(State.GRANTED,), event=Timeout, target=State.LISTENING,
        outcome=Outcome.BS_SILENT),

    Row(event=m.Beacon, guard=Steps.stale_beacon, outcome=Outcome.STALE_BEACON),
    Row(source=(State.DISCONNECTED,), event=m.Beacon),
    Row(source=(State.LISTENING,), event=m.Beacon, actions=(Steps.acknowledge,),
        target=State.ACKNOWLEDGED),
    Row(source=(State.NO_BEACON,), event=m.Beacon,
        actions=(Steps.log_resumed, Steps.acknowledge), target=State.ACKNOWLEDGED),
    Row(source=(State.ACKNOWLEDGED,), event=m.Beacon, actions=(Steps.acknowledge,),
        restart_timeout=True),
    Row(source=(State.GRANTED,), event=m.Beacon, actions=(Steps.acknowledge,),
        target=State.ACKNOWLEDGED, outcome=Outcome.ABANDONED),

    Row(source=(State.ACKNOWLEDGED,), event=m.Grant, guard=Steps.other_user_granted,
        target=State.LISTENING),
    Row(event=m.Grant, guard=Steps.other_user),
    Row(source=(State.ACKNOWLEDGED,), event=m.Grant, guard=Steps.other_instance_granted,
        actions=(Steps.log_other_instance,), target=State.LISTENING, outcome=Outcome.SUPERSEDED),
    Row(event=m.Grant, guard=Steps.other_instance, actions=(Steps.log_other_instance,),
        outcome=Outcome.SUPERSEDED),
    Row(event=m.Grant, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    Row(event=m.Grant, guard=Steps.late_grant, outcome=Outcome.LATE_GRANT),
    # The base station may wait for longer than the user did.
    Row(source=(State.LISTENING, State.ACKNOWLEDGED), event=m.Grant,
        actions=(Steps.publish_position,), target=State.GRANTED),
    Row(source=(State.NO_BEACON,), event=m.Grant,
        actions=(Steps.log_resumed, Steps.publish_position), target=State.GRANTED),
    Row(source=(State.GRANTED,), event=m.Grant),

    Row(event=m.PilotRequest, guard=Steps.other_user),
    Row(event=m.PilotRequest, guard=Steps.other_instance),
    Row(event=m.PilotRequest, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    # A request that overtakes the grant implies it.
    Row(source=(State.ACKNOWLEDGED,), event=m.PilotRequest, guard=Steps.new_request,
        actions=(Steps.publish_position, Steps.send_pilots), target=State.GRANTED),
    Row(source=(State.GRANTED,), event=m.PilotRequest, guard=Steps.new_request,
        actions=(Steps.send_pilots,), restart_timeout=True),
    # The channel may have missed the pilots or the position.
    Row(source=(State.GRANTED,), event=m.PilotRequest,
        actions=(Steps.publish_position, Steps.send_pilots), outcome=Outcome.ASKED_AGAIN,
        restart_timeout=True),

    Row(event=m.Data, guard=Steps.not_delivered_downlink),
    Row(event=m.Data, guard=Steps.other_user),
    Row(event=m.Data, guard=Steps.wrong_cycle, outcome=Outcome.WRONG_CYCLE),
    Row(event=m.Data, guard=Steps.not_granted),
    Row(source=(State.GRANTED,), event=m.Data, actions=(Steps.send_uplink,),
        target=State.LISTENING),
    Row(source=(State.LISTENING,), event=m.Data, actions=(Steps.send_uplink,),
        outcome=Outcome.ASKED_AGAIN),
)


class User(UserSteps):
    """The role of a user.

    Parameters
    ----------
    user
        Id of the user, from 1.
    mobility
        The user's position as a function of time.
    timeouts_s
        Timeouts by state [s].
    instance
        Instance of the node; only the instance that a grant names answers it.
    """

    SENDS = (m.Ack, m.GroundTruth, m.Pilot, m.Data)
    RECEIVES = (m.Beacon, m.Grant, m.PilotRequest, m.Data)

    STATES = State
    TABLE = TABLE
    EVENT_NAMES = {PeersChanged: 'peers', Timeout: 'timeout', m.Beacon: 'beacon', m.Grant: 'grant',
                   m.PilotRequest: 'pilot_request', m.Data: 'downlink'}
    BLOCKED_STATES = frozenset({State.DISCONNECTED, State.NO_BEACON})
