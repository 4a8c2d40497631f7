"""The executable ``channel``: the emulated world."""

import sys
import types
from typing import Any

from rhs_isac_ros.model import streams
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.impairments import ImpairedChannel, Impairments
from rhs_isac_ros.ros.parameters import settings_of
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class ChannelNode(RoleNode):
    """Air, multipath, surface and on-board propagation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('channel', Channel.SENDS, **node_options)
        values = self.values
        rng = streams.generator(values.seed, streams.AIR)
        self.start(ImpairedChannel(
            Channel(self.scenario, values.seed), self.settings(values), rng), Channel.RECEIVES)

    def settings(self, values: types.SimpleNamespace) -> Impairments:
        """Return what the air is to do to messages.

        Parameters
        ----------
        values
            The parameters, by name.

        Returns
        -------
        Impairments
            The settings.
        """
        return settings_of(Impairments, values)


main = entry(lambda: [ChannelNode()])


if __name__ == '__main__':
    sys.exit(main())
