"""The quality of service of every topic."""

from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from rhs_isac_ros.protocol import messages as m

# Handshakes and signals: each counts, none is of use to who joins later. The depth takes the
# pilots of a band, or the acks of many users, at once.
EXCHANGE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=128, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE)

# The present value of something: who joins later gets it.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL)

# The same of something that somebody must go on holding: who listens is told within a second when
# the holder dies, and not after the twenty that discovery takes.
HELD = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL, liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=1))

_LATCHED_MESSAGES = {m.CapacityStatistics}


def of(kind: type[m.Message]) -> QoSProfile:
    """Return the quality of service of a message's topic.

    Parameters
    ----------
    kind
        Class of the message.

    Returns
    -------
    rclpy.qos.QoSProfile
        `LATCHED` for what is the present value of something, else `EXCHANGE`.
    """
    return LATCHED if kind in _LATCHED_MESSAGES else EXCHANGE
