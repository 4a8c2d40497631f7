"""The base station, which sends beacons, then selects, positions and serves a user per cycle."""

from rhs_isac_ros.protocol import base_station_table
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station_states import State
from rhs_isac_ros.protocol.base_station_steps import BaseStationSteps


class BaseStation(BaseStationSteps):
    """The role of the base station.

    Parameters
    ----------
    rng
        Source of randomness for the policy ``random``.
    receiver
        Callable that takes (codebook, feeds [N_B, F, N_SB, K], user, cycle_id, whether to add
        noise) and returns the received signals, complex128 [N_B, N_SB, F].
    first_cycle_id
        Id of the first cycle. After a restart, it must exceed all ids used before, so that
        messages still in transit are recognised as stale.
    """

    SENDS = (m.Beacon, m.Grant, m.RhsCommand, m.PilotRequest, m.ReceivedSignals, m.Data,
             m.ProtocolState)
    RECEIVES = (m.Ack, m.RhsConfiguration, m.FeedSignals, m.PositionEstimate, m.NoFix, m.Beam,
                m.Data)

    STATES = State
    TABLE = base_station_table.TABLE
    EVENT_NAMES = base_station_table.EVENT_NAMES
    BLOCKED_STATES = frozenset({State.WAITING})
