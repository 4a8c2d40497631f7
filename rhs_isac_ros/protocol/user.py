"""The users of a node, which answer beacons, send pilots and exchange data."""

import bisect
import enum
from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.model.mobility import Crowd, Mobility
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, LogMessage, Outcome, PeersChanged, Send, Timeout
from rhs_isac_ros.protocol.messages import started
from rhs_isac_ros.protocol.role import ANY, EventT, NewestDict, StateMachine, Transition

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


class Row(Transition[State, 'User', EventT]):
    """A row of the table."""


class User(StateMachine[State]):
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
    world_s
        Returns the time of the mobilities [s]; by default it is that of `handle`.
    """

    SENDS = (m.Ack, m.GroundTruth, m.GroundTruths, m.Pilot, m.Data)
    RECEIVES = (m.Beacon, m.Grant, m.PilotRequest, m.Data)

    STATES = State
    EVENT_NAMES = {PeersChanged: 'peers', Timeout: 'timeout', m.Beacon: 'beacon', m.Grant: 'grant',
                   m.PilotRequest: 'pilot_request', m.Data: 'downlink'}
    BLOCKED_STATES = frozenset({State.DISCONNECTED, State.NO_BEACON})

    def __init__(
            self, mobilities: Mapping[int, Mobility], timeouts_s: Mapping[State, float],
            instance: int = 0, world_s: Callable[[], float] | None = None) -> None:
        super().__init__(State.DISCONNECTED, timeouts_s)
        self.users, self._instance = tuple(sorted(mobilities)), instance
        # By user: describes the node with the same number that is served instead.
        self._conflicts: dict[int, str] = {}
        self._mobilities, self._world_s = mobilities, world_s
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
        position, velocity = self._mobilities[user].state(self._time_s(now_s))
        return m.GroundTruth(
            cycle_id=cycle_id, user=user, position=position, velocity=velocity)

    def ground_truths(self, now_s: float) -> m.GroundTruths:
        """Return the positions and velocities of all users at a time on the clock of `handle`."""
        position, velocity = self._crowd.states(self._time_s(now_s))
        return m.GroundTruths(
            cycle_id=0, users=np.array(self.users), position=position, velocity=velocity)

    def _time_s(self, now_s: float) -> float:
        return self._world_s() if self._world_s else now_s

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

    # Messages that are dropped in every state, before the rows of the table.
    DROPS = {
        m.PilotRequest: {other_user: None, other_instance: None,
                         wrong_cycle: Outcome.WRONG_CYCLE, other_granted: Outcome.WRONG_USER},
        m.Data: {not_delivered_downlink: None, other_user: None,
                 wrong_cycle: Outcome.WRONG_CYCLE, not_granted: None}}

    TABLE = (
        Row(ANY, PeersChanged, guard=peers_missing, actions=(log_missing_peers,),
            target=State.DISCONNECTED),
        Row((State.DISCONNECTED,), PeersChanged, actions=(log_connected,), target=State.LISTENING),
        Row(ANY, PeersChanged),

        Row((State.LISTENING,), Timeout, actions=(log_no_beacon,), target=State.NO_BEACON,
            outcome=Outcome.NO_BEACON),
        Row((State.ACKNOWLEDGED,), Timeout, target=State.LISTENING, outcome=Outcome.NOT_GRANTED),
        Row((State.GRANTED,), Timeout, target=State.LISTENING, outcome=Outcome.BS_SILENT),

        Row(ANY, m.Beacon, guard=stale_beacon, outcome=Outcome.STALE_BEACON),
        Row((State.DISCONNECTED,), m.Beacon),
        # A beacon to other users shows that the base station is active, and ends the cycle before.
        Row((State.LISTENING,), m.Beacon, guard=invites_others, actions=(note_beacon,),
            restart_timeout=True),
        Row((State.NO_BEACON,), m.Beacon, guard=invites_others, actions=(log_resumed, note_beacon),
            target=State.LISTENING),
        Row((State.ACKNOWLEDGED,), m.Beacon, guard=invites_others, actions=(note_beacon,),
            target=State.LISTENING),
        Row((State.GRANTED,), m.Beacon, guard=invites_others, actions=(note_beacon,),
            target=State.LISTENING, outcome=Outcome.ABANDONED),
        Row((State.LISTENING,), m.Beacon, actions=(acknowledge,), target=State.ACKNOWLEDGED),
        Row((State.NO_BEACON,), m.Beacon, actions=(log_resumed, acknowledge),
            target=State.ACKNOWLEDGED),
        Row((State.ACKNOWLEDGED,), m.Beacon, actions=(acknowledge,), restart_timeout=True),
        Row((State.GRANTED,), m.Beacon, actions=(acknowledge,), target=State.ACKNOWLEDGED,
            outcome=Outcome.ABANDONED),

        Row((State.ACKNOWLEDGED,), m.Grant, guard=other_user_granted, target=State.LISTENING),
        Row(ANY, m.Grant, guard=other_user),
        Row((State.ACKNOWLEDGED,), m.Grant, guard=other_instance_granted,
            actions=(log_other_instance,), target=State.LISTENING, outcome=Outcome.NUMBER_TAKEN),
        Row(ANY, m.Grant, guard=other_instance, actions=(log_other_instance,),
            outcome=Outcome.NUMBER_TAKEN),
        Row(ANY, m.Grant, guard=wrong_cycle, outcome=Outcome.WRONG_CYCLE),
        Row(ANY, m.Grant, guard=late_grant, outcome=Outcome.LATE_GRANT),
        # The base station may wait for longer than the user did.
        Row((State.LISTENING, State.ACKNOWLEDGED), m.Grant, actions=(publish_position,),
            target=State.GRANTED),
        Row((State.NO_BEACON,), m.Grant, actions=(log_resumed, publish_position),
            target=State.GRANTED),
        Row((State.GRANTED,), m.Grant),

        # A request that overtakes the grant implies it.
        Row((State.ACKNOWLEDGED,), m.PilotRequest, guard=new_request,
            actions=(publish_position, send_pilots), target=State.GRANTED),
        Row((State.GRANTED,), m.PilotRequest, guard=new_request, actions=(send_pilots,),
            restart_timeout=True),
        # The channel may have missed the pilots or the position.
        Row((State.GRANTED,), m.PilotRequest, actions=(publish_position, send_pilots),
            outcome=Outcome.ASKED_AGAIN, restart_timeout=True),

        Row((State.GRANTED,), m.Data, actions=(send_uplink,), target=State.LISTENING),
        Row((State.LISTENING,), m.Data, actions=(send_uplink,), outcome=Outcome.ASKED_AGAIN),
    )
