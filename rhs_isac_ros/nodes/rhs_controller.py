"""The executable ``rhs_controller``: the controller of the surface."""

from typing import Any

from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class RhsControllerNode(RoleNode[RhsController]):
    """The controller of the surface, which serves once it has a codebook."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('rhs_controller', **node_options)
        self.start(RhsController(self.library), needs_codebook=True)


main = entry('rhs_controller', lambda: [RhsControllerNode()])
