"""The quality of service of all topics."""

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_registry import MAX_USERS

# For handshakes and signals, which must all arrive and are useless to late joiners. The depth
# holds the acks of the users of a beacon, and messages that arrive during a computation.
EXCHANGE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=128, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE)

# For acks: all users answer the beacon of a base station to which they are new.
ACKS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=MAX_USERS, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE)

# For the same messages, received by an observer of the whole network: its queue must hold those
# of several seconds in which a busy machine does not run the observer.
OBSERVATION = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=4096, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE)

# For a current value, which late joiners receive as well.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL)

# For `LATCHED` values of many publishers, of which a subscription keeps one each.
PRESENCES = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=128, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL)

# For the positions of robots, whose drivers and simulators often publish best effort.
SENSOR = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE)

_LATCHED_MESSAGES = {m.CapacityStatistics}


def profile_for(kind: type[m.Message], exchange: QoSProfile = EXCHANGE) -> QoSProfile:
    """Return `LATCHED` for messages that represent a current value, otherwise `exchange`.

    Acks need a deeper queue than `EXCHANGE`.
    """
    if kind is m.Ack and exchange is EXCHANGE:
        return ACKS
    return LATCHED if kind in _LATCHED_MESSAGES else exchange
