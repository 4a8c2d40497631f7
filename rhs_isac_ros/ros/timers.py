"""Timers that neither simulated time nor a corrected wall clock can stop."""

from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.timer import Timer


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Create a timer on the steady clock, as the roles' deadlines are.

    Parameters
    ----------
    node
        The node that owns it.
    period_s
        Its period [s].
    callback
        What it calls.

    Returns
    -------
    rclpy.timer.Timer
        The timer, running.
    """
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
