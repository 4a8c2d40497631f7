"""The executable ``receiver``: receives pilots with a surface that follows another one."""

from typing import Any

from rhs_isac_ros.protocol.receiver import Receiver
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class ReceiverNode(RoleNode[Receiver]):
    """The receiver of a surface without a base station, which serves once it has a codebook."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('receiver', **node_options)
        values = self.values
        self.start(Receiver(self.scenario, values.seed, self.make_settings(values)),
                   needs_codebook=True)


main = entry('receiver', lambda: [ReceiverNode()])
