"""The users of a node, which answer beacons, send pilots and exchange data."""

import bisect
import dataclasses
import enum
from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.model.mobility import Crowd, Mobility
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, LogMessage, PeersChanged, Send, Timeout
from rhs_isac_ros.protocol.messages import started
from rhs_isac_ros.protocol.newest import NewestDict
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.state_machine import EventT, StateMachine, Transition

# Number of cycles kept; no message of an older cycle can still be in transit.
_MAX_REMEMBERED = 8
# Steps of a cycle during which the user may receive nothing: the signals of the last band, the
# position, the beam and the data.
_SILENT_STEPS = 4


class State(enum.Enum):
    """States of the users of a node, of which a cycle serves one at most."""

    DISCONNECTED = 'disconnected'  # waits for the base station and the channel
    LISTENING = 'listening'        # waits for a beacon that invites a user
    NO_BEACON = 'no_beacon'        # waits for a beacon for longer than the timeout
    ACKNOWLEDGED = 'acknowledged'  # waits for the grant
    GRANTED = 'granted'            # a user is being positioned and served


def timeouts(step_s: float, beacon_s: float) -> dict[State, float]:
    """Return the timeouts of the role.

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
    """The memory of the role, and the guards and actions of its table."""

    def __init__(
            self, mobilities: Mapping[int, Mobility], timeouts_s: Mapping[State, float],
            instance: int = 0) -> None:
        super().__init__(State.DISCONNECTED, timeouts_s)
        self.users, self._instance = tuple(sorted(mobilities)), instance
        # By user: describes the node with the same number that is served instead.
        self._conflicts: dict[int, str] = {}
        self._mobilities = mobilities
        self._crowd = Crowd([mobilities[user] for user in self.users])
        self._cycle_id = 0
        # Cycle and bands of the last pilot request answered.
        self._sounded = (0, 0, 0)
        # By cycle: the highest attempt received. By cycle and user: the position, fixed for the
        # whole cycle.
        self._attempts: NewestDict[int, int] = NewestDict(_MAX_REMEMBERED)
        self._truths: NewestDict[tuple[int, int], m.GroundTruth] = NewestDict(_MAX_REMEMBERED)

    def ground_truth(self, user: int, now_s: float, cycle_id: int = 0) -> m.GroundTruth:
        """Return the position and velocity of a user.

        Parameters
        ----------
        now_s
            Time on the clock of `handle` [s].
        cycle_id
            The cycle to which the position applies; 0 for none.
        """
        position, velocity = self._mobilities[user].state(now_s)
        return m.GroundTruth(
            cycle_id=cycle_id, user=user, position=position, velocity=velocity)

    def ground_truths(self, now_s: float) -> m.GroundTruths:
        """Return the positions and velocities of all users at a time on the clock of `handle`."""
        position, velocity = self._crowd.states(now_s)
        return m.GroundTruths(
            cycle_id=0, users=np.array(self.users), position=position, velocity=velocity)

    def status(self) -> Mapping[str, str]:
        """Return ``conflict.user_<n>`` while another node with the same number is served."""
        return {f'conflict.user_{user}': text for user, text in self._conflicts.items()}

    # Guards

    def peers_missing(self, event: PeersChanged, now_s: float) -> bool:
        """Whether a role that the users need is missing."""
        return bool(event.missing)

    def stale_beacon(self, event: m.Beacon, now_s: float) -> bool:
        """Whether a beacon is late or a duplicate."""
        granted = self.state is State.GRANTED and event.cycle_id == self._cycle_id
        return granted or event.attempt <= self._attempts.get(event.cycle_id, -1)

    def invites_others(self, event: m.Beacon, now_s: float) -> bool:
        """Whether a beacon invites none of the users."""
        return not self._invited(event)

    def _invited(self, beacon: m.Beacon) -> tuple[int, ...]:
        return self.users[bisect.bisect_left(self.users, beacon.first_user):
                          bisect.bisect_right(self.users, beacon.last_user)]

    def other_user(self, event: m.Grant | m.PilotRequest | m.Data, now_s: float) -> bool:
        """Whether a message is addressed to a user of another node."""
        return event.user not in self._mobilities

    def other_user_granted(self, event: m.Grant, now_s: float) -> bool:
        """Whether the acknowledged cycle is granted to a user of another node."""
        return self.other_user(event, now_s) and event.cycle_id == self._cycle_id

    def other_instance_granted(self, event: m.Grant, now_s: float) -> bool:
        """Whether the acknowledged cycle is granted to another node with the same number."""
        return self.other_instance(event, now_s) and event.cycle_id == self._cycle_id

    def other_instance(self, event: m.Grant | m.PilotRequest, now_s: float) -> bool:
        """Whether a message is addressed to another node with the same number."""
        return not m.same_instance(event.user_instance, self._instance)

    def other_granted(self, event: m.PilotRequest, now_s: float) -> bool:
        """Whether the cycle is granted to another user of this node."""
        return self.state is State.GRANTED and (event.cycle_id, event.user) not in self._truths

    def not_granted(self, event: m.Data, now_s: float) -> bool:
        """Whether the cycle was not granted to the user."""
        return (event.cycle_id, event.user) not in self._truths

    def wrong_cycle(self, event: m.Grant | m.PilotRequest | m.Data, now_s: float) -> bool:
        """Whether a message belongs to a cycle other than the one acknowledged last."""
        return event.cycle_id != self._cycle_id

    def late_grant(self, event: m.Grant, now_s: float) -> bool:
        """Whether the cycle was granted before and has ended."""
        return (event.cycle_id, event.user) in self._truths and self.state is not State.GRANTED

    def new_request(self, event: m.PilotRequest, now_s: float) -> bool:
        """Whether a request differs from the last one answered."""
        return self._sounded != (event.cycle_id, event.band, event.last_band)

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
        """Log once that another node with the same number is served."""
        text = (f'user {event.user}: two nodes have this number; the first one, '
                f'{started(event.user_instance)}, is served')
        known = event.user in self._conflicts
        self._conflicts[event.user] = text
        return [] if known else [LogMessage(text, warning=True)]

    def note_beacon(self, event: m.Beacon, now_s: float) -> None:
        """Store the attempt, so that a late beacon of the same cycle is recognised."""
        self._attempts.put(event.cycle_id, event.attempt)

    def acknowledge(self, event: m.Beacon, now_s: float) -> list[Action]:
        """Answer a beacon for each user that it invites."""
        self.note_beacon(event, now_s)
        self._cycle_id = event.cycle_id
        return [Send(m.Ack(cycle_id=event.cycle_id, user=user))
                for user in self._invited(event)]

    def publish_position(self, event: m.Grant | m.PilotRequest, now_s: float) -> list[Action]:
        """Publish the position that applies to the cycle."""
        self._conflicts.pop(event.user, None)
        key = event.cycle_id, event.user
        truth = self._truths.get(key) or self.ground_truth(event.user, now_s, event.cycle_id)
        self._truths.put(key, truth)
        return [Send(truth)]

    def send_pilots(self, event: m.PilotRequest, now_s: float) -> list[Action]:
        """Send the pilots of the bands, one for each frame."""
        self._sounded = event.cycle_id, event.band, event.last_band
        return [Send(m.Pilot(cycle_id=event.cycle_id, user=event.user, band=band,
                             symbols=np.ones(event.n_frames, complex)))
                for band in range(event.band, event.last_band + 1)]

    def send_uplink(self, event: m.Data, now_s: float) -> list[Action]:
        """Answer downlink data with the same amount of uplink data."""
        return [Send(m.Data(
            cycle_id=event.cycle_id, user=event.user, direction=m.Direction.UPLINK,
            stage=m.Stage.OFFERED, duration_s=event.duration_s, bits=event.bits))]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Row(Transition[State, UserSteps, EventT]):
    """A row of the table."""


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
    # A beacon to other users shows that the base station is active, and ends the cycle before.
    Row(source=(State.LISTENING,), event=m.Beacon, guard=Steps.invites_others,
        actions=(Steps.note_beacon,), restart_timeout=True),
    Row(source=(State.NO_BEACON,), event=m.Beacon, guard=Steps.invites_others,
        actions=(Steps.log_resumed, Steps.note_beacon), target=State.LISTENING),
    Row(source=(State.ACKNOWLEDGED,), event=m.Beacon, guard=Steps.invites_others,
        actions=(Steps.note_beacon,), target=State.LISTENING),
    Row(source=(State.GRANTED,), event=m.Beacon, guard=Steps.invites_others,
        actions=(Steps.note_beacon,), target=State.LISTENING, outcome=Outcome.ABANDONED),
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
        actions=(Steps.log_other_instance,), target=State.LISTENING, outcome=Outcome.NUMBER_TAKEN),
    Row(event=m.Grant, guard=Steps.other_instance, actions=(Steps.log_other_instance,),
        outcome=Outcome.NUMBER_TAKEN),
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
    Row(event=m.PilotRequest, guard=Steps.other_granted, outcome=Outcome.WRONG_USER),
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


class User(Steps):
    """The role of the users of a node, usually of one.

    A cycle serves one user, so that one state is enough for all users of the node.

    Parameters
    ----------
    mobilities
        By id, from 1: the position of each user as a function of time.
    timeouts_s
        Timeouts by state [s].
    instance
        Instance of the node; only the instance that a grant names answers it.
    """

    SENDS = (m.Ack, m.GroundTruth, m.GroundTruths, m.Pilot, m.Data)
    RECEIVES = (m.Beacon, m.Grant, m.PilotRequest, m.Data)

    STATES = State
    TABLE = TABLE
    EVENT_NAMES = {PeersChanged: 'peers', Timeout: 'timeout', m.Beacon: 'beacon', m.Grant: 'grant',
                   m.PilotRequest: 'pilot_request', m.Data: 'downlink'}
    BLOCKED_STATES = frozenset({State.DISCONNECTED, State.NO_BEACON})
