"""The executable ``channel``: the emulated world."""

import sys
from typing import Any

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry

RECEIVES = (m.GroundTruth, m.RhsConfiguration, m.Pilot, m.Beam, m.Data)


class ChannelNode(RoleNode):
    """Air, multipath, surface and on-board propagation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('channel', (m.FeedSignals, m.Data), **node_options)
        self.start(Channel(self.scenario, self.values.seed), RECEIVES)


main = entry(lambda: [ChannelNode()])


if __name__ == '__main__':
    sys.exit(main())
