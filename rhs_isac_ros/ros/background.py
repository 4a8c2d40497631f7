"""Background execution of jobs that would block a callback for too long."""

import collections
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from rclpy.node import Node

from rhs_isac_ros.ros.endpoints import steady_timer

_Result = TypeVar('_Result')
_IMMEDIATE_S = 1e-6


class BackgroundWorker:
    """A thread that runs jobs one after the other.

    Results are delivered in the thread that spins the node, as messages are.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._is_open = True
        self._done: collections.deque[tuple[Future[Any], Callable[[Any], None]]] = (
            collections.deque())
        self._timer = steady_timer(node, _IMMEDIATE_S, self._deliver)
        self._timer.cancel()
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix=node.get_name())

    def run(self, job: Callable[[], _Result], on_result: Callable[[_Result], None]) -> None:
        """Queue a job.

        Parameters
        ----------
        on_result
            Called with the result in the thread that spins the node. An exception
            raised by the job is re-raised there instead.
        """
        def hand_over(future: Future[_Result]) -> None:
            self._done.append((future, on_result))
            executor = self._node.executor
            if self._is_open and executor is not None:
                executor.create_task(self._wake)
        self._pool.submit(job).add_done_callback(hand_over)

    def close(self) -> None:
        """Wait for the running job, cancel the others and discard all results."""
        self._is_open = False
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _wake(self) -> None:
        # The task only starts the timer: an exception in a task would stop the events executor,
        # and a task may outlast the node.
        if self._is_open:
            self._timer.reset()

    def _deliver(self) -> None:
        self._timer.cancel()
        while self._done:
            future, on_result = self._done.popleft()
            on_result(future.result())
