"""The executable ``channel``: the emulated world."""

import sys
from typing import Any

from rhs_isac_ros.model import streams
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.impairments import Impaired, Impairments
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry

SENDS = (m.FeedSignals, m.Data)
RECEIVES = (m.GroundTruth, m.RhsConfiguration, m.Pilot, m.Beam, m.Data)


class ChannelNode(RoleNode):
    """Air, multipath, surface and on-board propagation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('channel', SENDS, **node_options)
        values = self.values
        ideal = Channel(self.scenario, values.seed)
        impairments = Impairments(
            values.loss_probability, values.double_probability, values.delay_s, values.jitter_s)
        rng = streams.generator(values.seed, streams.AIR)
        self.start(
            ideal if impairments == Impairments() else Impaired(ideal, impairments, rng),
            RECEIVES)


main = entry(lambda: [ChannelNode()])


if __name__ == '__main__':
    sys.exit(main())
