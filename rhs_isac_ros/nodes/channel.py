"""The executable ``channel``: the emulated radio channel and surface."""

from typing import Any

from rhs_isac_ros.protocol.channel import Channel, ImpairedChannel
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry
from rhs_isac_ros.support import streams


class ChannelNode(RoleNode[ImpairedChannel]):
    """The ROS node of the emulated channel, impairments included."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('channel', **node_options)
        values = self.values
        rng = streams.generator(values.seed, streams.AIR)
        impairments = self.make_settings(values)
        self.start(ImpairedChannel(
            Channel(self.scenario, values.seed, impairments), impairments, rng))
        self.get_logger().info(  # type: ignore[no-untyped-call]
            f'serving: {self.scenario.n_bands} bands, {self.scenario.n_elements} elements')


main = entry('channel', lambda: [ChannelNode()])
