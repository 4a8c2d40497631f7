"""Parameter services that set the parameters that belong together as a whole."""

from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService


class GroupParameterService(ParameterService):
    """The parameter services of a node of which some parameters belong together.

    The service ``set_parameters`` of rclpy sets the parameters of a request one by one. ``ros2
    param load`` uses this service. Here, the parameters of the group in one request are set
    together, or not at all.

    Parameters
    ----------
    node
        A node that was created with ``start_parameter_services=False``.
    prefix
        Prefix of the names of the group.
    """

    def __init__(self, node: Node, prefix: str) -> None:
        super().__init__(node)  # type: ignore[no-untyped-call]
        self._prefix = prefix

    # Overrides the callback of rclpy, which creates the services in its constructor.
    def _set_parameters_callback(
            self, request: SetParameters.Request,
            response: SetParameters.Response) -> SetParameters.Response:
        parameters = [Parameter.from_parameter_msg(message) for message in request.parameters]
        group = [p for p in parameters if p.name.startswith(self._prefix)]
        group_result = self._set(group) if group else None
        response.results = [group_result if p in group else self._set([p]) for p in parameters]
        return response

    def _set(self, parameters: list[Parameter]) -> Any:
        try:
            node = self._get_node()  # type: ignore[no-untyped-call]
            return node.set_parameters_atomically(parameters)
        except ParameterNotDeclaredException as error:
            return SetParametersResult(successful=False, reason=str(error))
