"""Names of topics, services and frames. Most topic names are relative to the namespace.

Positions in messages are in the frame of the site, which the parameter ``frame_id`` names.
"""

import dataclasses
import types
from collections.abc import Mapping
from typing import Any

from rhs_isac_ros.protocol import messages as m

NAMES: Mapping[type[m.Message], str] = {
    m.Beacon: 'beacon',
    m.Ack: 'ack',
    m.Grant: 'grant',
    m.RhsCommand: 'rhs/command',
    m.RhsConfiguration: 'rhs/configuration',
    m.PilotRequest: 'pilot_request',
    m.Pilot: 'pilot',
    m.FeedSignals: 'feed_signals',
    m.ReceivedSignals: 'received_signals',
    m.PositionEstimate: 'position_estimate',
    m.Posterior: 'posterior',
    m.NoFix: 'no_fix',
    m.Beam: 'beam',
    m.Data: 'data',
    m.Capacity: 'capacity',
    m.CapacityStatistics: 'capacity_statistics',
    m.GroundTruth: 'ground_truth',
    m.GroundTruths: 'ground_truths',
    m.ProtocolState: 'protocol_state',
}

# Topics that carry no message of the protocol.
POSITION = 'position'
CODEBOOK = 'codebook'
# Absolute, because the diagnostic aggregator expects this name.
DIAGNOSTICS = '/diagnostics'
MARKERS = 'markers'
PRESENCE = 'presence'

# Estimated pose and odometry, true odometry, estimated and true path of a user.
POSE = 'users/user_{user}/pose'
ODOMETRY = 'users/user_{user}/odometry'
TRUE_ODOMETRY = 'users/user_{user}/true_odometry'
PATH = 'users/user_{user}/path'
TRUE_PATH = 'users/user_{user}/true_path'

# Transforms; absolute, as in tf2.
TF = '/tf'
TF_STATIC = '/tf_static'
# Simulated time; absolute, because rclpy expects this name.
CLOCK = '/clock'

# Action and services of the base station.
LOCATE = 'locate'
PAUSE = '~/pause'
RESUME = '~/resume'
STEP = '~/step'

# Node whose parameters hold the codebook.
OPTIMIZER_NODE = 'optimizer'
# Default of the parameter frame_id.
MAP_FRAME = 'map'
# Frame of the surface, and of messages without positions: the origin is the centre of the surface,
# x points outward and z points up. The namespace precedes this name and the next one.
RHS_FRAME = 'rhs_link'
# Frame at the estimated position of a user, with the axes of the frame frame_id.
USER_FRAME = 'user_{user}'


@dataclasses.dataclass(frozen=True)
class Frame:
    """The names of the frames of a site, of a surface and of its users."""

    name: str = MAP_FRAME
    # Prefix of the frames of the surface and the users: the namespace with a final slash, or ''.
    prefix: str = ''

    @classmethod
    def of(cls, node: Any, values: types.SimpleNamespace) -> 'Frame':
        """Return the frames given by ``frame_id`` and the namespace.

        Nodes that publish no positions do not have the parameter.
        """
        return cls(getattr(values, 'frame_id', MAP_FRAME),
                   f'{node.get_namespace().strip("/")}/'.lstrip('/'))

    @property
    def surface(self) -> str:
        """Name of the frame of the surface."""
        return f'{self.prefix}{RHS_FRAME}'

    def user(self, number: int) -> str:
        """Return the name of the frame of a user."""
        return f'{self.prefix}{USER_FRAME.format(user=number)}'
