"""The users of a node, which answer beacons, send pilots and exchange data."""

import dataclasses

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import PeersChanged, Timeout
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.state_machine import EventT, Transition
from rhs_isac_ros.protocol.user_steps import State as State
from rhs_isac_ros.protocol.user_steps import UserSteps as Steps
from rhs_isac_ros.protocol.user_steps import timeouts as timeouts


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Row(Transition[State, Steps, EventT]):
    """A row of the table."""


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
