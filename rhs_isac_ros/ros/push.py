"""Hands a codebook to the optimizer of a running network."""

import time

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.ros import topics

PATIENCE_S = 10.0


class PushError(RuntimeError):
    """A codebook was not taken."""


def push(node: Node, codebook: Codebook, patience_s: float = PATIENCE_S) -> None:
    """Set a codebook as the parameters of the optimizer in the node's namespace.

    This waits, and spins the node: it is for commands, not for callbacks.

    Parameters
    ----------
    node
        A node that nothing spins.
    codebook
        The codebook.
    patience_s
        How long to wait for the optimizer and for its answer [s].

    Raises
    ------
    PushError
        If there is no optimizer, it does not answer, or it refuses the codebook.
    """
    owner = f'{node.get_namespace().rstrip("/")}/{topics.OPTIMIZER_NODE}'
    client = AsyncParameterClient(node, topics.OPTIMIZER_NODE)
    parameters = [Parameter(name, value=value)
                  for name, value in codebook.to_parameters().items()]
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end_s, future = time.monotonic() + patience_s, None
    try:
        while future is None or not future.done():
            if time.monotonic() > end_s:
                what = 'no answer' if future else 'not there'
                raise PushError(f'{owner}: {what} within {patience_s:g} s, expected an optimizer')
            if future is None and client.services_are_ready():
                future = client.set_parameters_atomically(parameters)
            executor.spin_once(timeout_sec=0.1)
    finally:
        executor.remove_node(node)
        executor.shutdown()
    result = future.result().result
    if not result.successful:
        raise PushError(f'{owner}: refused: {result.reason}')
