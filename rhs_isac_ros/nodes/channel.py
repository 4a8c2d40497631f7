"""The executable ``channel``: emulates the radio channel and the surface."""

from typing import Any

from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class ChannelNode(RoleNode[Channel]):
    """The ROS node of the emulated channel and its impairments."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('channel', **node_options)
        self.start(Channel(
            self.scenario, self.values.seed, self.make_settings(self.values)))
        self.get_logger().info(  # type: ignore[no-untyped-call]
            f'serving: {self.scenario.n_bands} bands, {self.scenario.n_elements} elements')


main = entry('channel', lambda: [ChannelNode()])
