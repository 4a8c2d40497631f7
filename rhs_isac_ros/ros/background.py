"""Work that takes longer than a callback may."""

import collections
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from rclpy.node import Node

from rhs_isac_ros.ros.timers import steady_timer

Result = TypeVar('Result')
_SOON_S = 1e-6


class Background:
    """Does one piece of work after the other in a thread of its own.

    Results come back to the thread that spins the node, as if they were messages.

    Parameters
    ----------
    node
        The node that needs the results.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._open = True
        self._done: collections.deque[tuple[Future, Callable[[Any], None]]] = collections.deque()
        self._timer = steady_timer(node, _SOON_S, self._deliver)
        self._timer.cancel()
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix=node.get_name())

    def run(self, work: Callable[[], Result], then: Callable[[Result], None]) -> None:
        """Begin some work.

        Parameters
        ----------
        work
            Function to call in the other thread.
        then
            Called with its result where the node's callbacks are. What `work` raises is raised
            there instead.
        """
        def hand_over(future: Future) -> None:
            self._done.append((future, then))
            executor = self._node.executor
            if self._open and executor is not None:
                executor.create_task(self._wake)
        self._pool.submit(work).add_done_callback(hand_over)

    def close(self) -> None:
        """Wait for the work that has begun, and forget its result and the rest."""
        self._open = False
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _wake(self) -> None:
        # Only sets the timer: the executor of events dies of an error in a task, and a task may
        # outlive the node.
        if self._open:
            self._timer.reset()

    def _deliver(self) -> None:
        self._timer.cancel()
        while self._done:
            future, then = self._done.popleft()
            then(future.result())
