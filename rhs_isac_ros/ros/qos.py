"""The quality of service of every topic."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

# Handshakes and signals: each counts, none is of use to who joins later. The depth takes the
# pilots of a band, or the acks of many users, at once.
EXCHANGE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=128, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE)

# The present value of something: who joins later gets it.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL)
