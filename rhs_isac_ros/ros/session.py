"""A node that a command spins itself while it waits, such as for the response to a request."""

import contextlib
import os
import signal
import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from rclpy.utilities import try_shutdown

from rhs_isac_ros.ros.environment import is_secure
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.ros.run import init, starting
from rhs_isac_ros.support.exits import on_end_signals

# Period of polling the graph [s], because changes to the graph do not wake the executor.
_POLL_PERIOD_S = 0.02
# Discovery is complete when the graph has not changed for this time [s]. With DDS security,
# discovery pauses while keys are exchanged.
_SETTLE_S = 1.0 if is_secure() else 0.4
# Number of equal requests until one has a response.
_N_REQUESTS = 5


class Session(contextlib.AbstractContextManager['Session']):
    """A context manager with a node, which its methods spin."""

    def __init__(self, arguments: Sequence[str] = ('',)) -> None:
        init(arguments)
        on_end_signals(signal.default_int_handler)
        with starting():
            self.node = Node(f'_rhs_isac_cli_{os.getpid()}', **WITHOUT_SERVICES)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def __exit__(self, *_: object) -> None:
        """Destroy the node and shut the context down."""
        self._executor.shutdown()
        self.node.destroy_node()
        try_shutdown()

    def spin_until(self, condition: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Spin until a condition holds or `timeout_s` has passed; return whether it holds."""
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while not condition():
            if end_s is not None and time.monotonic() >= end_s:
                return False
            self._executor.spin_once(timeout_sec=_POLL_PERIOD_S)
        return True

    def discover(self, timeout_s: float) -> None:
        """Spin until the graph has other nodes and has settled, or `timeout_s` has passed."""
        graph, changed_s = self._graph(), time.monotonic()

        def settled() -> bool:
            nonlocal graph, changed_s
            previous, graph = graph, self._graph()
            if graph != previous:
                changed_s = time.monotonic()
            return (len(self.node.get_node_names()) > 1
                    and time.monotonic() - changed_s > _SETTLE_S)
        self.spin_until(settled, timeout_s)

    def _graph(self) -> list[Any]:
        return sorted([*self.node.get_topic_names_and_types(),
                       *self.node.get_node_names_and_namespaces()], key=repr)

    def response(self, request: Callable[[], Future], timeout_s: float) -> Any:
        """Send a request, and return the response, or None if none arrives within `timeout_s` [s].

        DDS may lose a response to a client that it has just discovered, so the request is
        repeated; repetitions must have no further effect.
        """
        futures: list[Future] = []
        for _ in range(_N_REQUESTS):
            futures.append(request())
            if self.spin_until(lambda: any(map(Future.done, futures)), timeout_s / _N_REQUESTS):
                return next(filter(Future.done, futures)).result()
        return None
