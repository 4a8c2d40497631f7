"""The executable ``channel``: the emulated radio channel and surface."""

import sys
import types
from typing import Any

from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.settings import Impairments
from rhs_isac_ros.ros.parameters import settings_of
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class ChannelNode(RoleNode[Channel]):
    """The ROS node of the emulated channel, impairments included."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('channel', **node_options)
        self.start(Channel(
            self.scenario, self.values.seed, self.make_settings(self.values)))
        self.get_logger().info(  # type: ignore[no-untyped-call]
            f'serving: {self.scenario.n_bands} bands, {self.scenario.n_elements} elements')

    def make_settings(self, values: types.SimpleNamespace) -> Impairments:
        """Return the impairments for parameter values."""
        return settings_of(Impairments, values)


main = entry('channel', lambda: [ChannelNode()])


if __name__ == '__main__':
    sys.exit(main())
