"""Transfer of a codebook to the optimizer of a running network."""

import time

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.ros import topics

TIMEOUT_S = 10.0


class PushError(RuntimeError):
    """The optimizer did not accept a codebook."""


def push(node: Node, codebook: Codebook, timeout_s: float = TIMEOUT_S) -> None:
    """Set a codebook as the parameters of the optimizer in the namespace of the node.

    This function blocks and spins the node, so it must not be called from a callback.

    Parameters
    ----------
    timeout_s
        Maximum time to wait for the optimizer and for its response [s].

    Raises
    ------
    PushError
        If there is no optimizer, if it does not respond, or if it rejects the codebook.
    """
    optimizer = f'{node.get_namespace().rstrip("/")}/{topics.OPTIMIZER_NODE}'
    client = AsyncParameterClient(node, topics.OPTIMIZER_NODE)
    parameters = [Parameter(name, value=value)
                  for name, value in codebook.to_parameters().items()]
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end_s, future = time.monotonic() + timeout_s, None
    try:
        while future is None or not future.done():
            if time.monotonic() > end_s:
                reason = 'no response' if future else 'not found'
                raise PushError(f'{optimizer}: {reason} within {timeout_s:g} s')
            if future is None and client.services_are_ready():
                future = client.set_parameters_atomically(parameters)
            executor.spin_once(timeout_sec=0.1)
    finally:
        executor.remove_node(node)
        executor.shutdown()
    result = future.result().result
    if not result.successful:
        raise PushError(f'{optimizer}: codebook rejected: {result.reason}')
