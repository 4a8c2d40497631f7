"""The hops of a cycle as ping-pong in bare rclpy: a lower bound on the duration of the cycle."""

import subprocess
import sys
import time

import numpy as np
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from rhs_isac_msgs.msg import FeedSignals
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert
from rhs_isac_ros.ros.endpoints import EXCHANGE
from rhs_isac_ros.ros.run import run

# Messages of a cycle in order. Those of all bands are sent in parallel and count once.
CHAIN = ('beacon', 'ack', 'rhs/command', 'rhs/configuration', 'pilot_request', 'pilot',
         'feed_signals', 'received_signals', 'position_estimate', 'beam', 'rhs/configuration',
         'data', 'data', 'data', 'data')
ROUND_TRIPS = 2000


def ping_pong(scenario: Scenario, composed: bool = False) -> np.ndarray:
    """Measure round trips between two nodes, float64 [N] [s].

    Parameters
    ----------
    composed
        Whether both nodes run in this process, rather than one in another process.
    """
    feeds = np.ones((scenario.n_frames, scenario.n_subbands, scenario.n_feeds), complex)
    message = deserialize_message(convert.to_bytes(
        m.FeedSignals(cycle_id=1, user=1, band=0, signals=feeds), 0), FeedSignals)
    times_s: list[float] = []
    node = Node('ping')
    publisher = node.create_publisher(FeedSignals, 'benchmark/ping', EXCHANGE)

    def on_pong(_: FeedSignals) -> None:
        times_s.append(time.perf_counter() - on_pong.sent_s)
        on_pong.sent_s = time.perf_counter()
        publisher.publish(message)

    node.create_subscription(
        FeedSignals, 'benchmark/pong', on_pong, EXCHANGE,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))
    executor = EventsExecutor()
    nodes = [node, *make_pong()] if composed else [node]
    for each in nodes:
        executor.add_node(each)
    other = None if composed else subprocess.Popen([sys.executable, __file__])
    try:
        while not (publisher.get_subscription_count() and node.count_publishers('benchmark/pong')):
            executor.spin_once(timeout_sec=0.1)
        while len(times_s) < ROUND_TRIPS:
            before = len(times_s)
            if before == 0:
                on_pong.sent_s = time.perf_counter()
                publisher.publish(message)
            executor.spin_once(timeout_sec=1.0)
    finally:
        if other is not None:
            other.terminate()
            other.wait()
        executor.shutdown()
        for each in nodes:
            each.destroy_node()
    return np.array(times_s[ROUND_TRIPS // 10:])


def make_pong() -> list[Node]:
    """Return a node that echoes each message."""
    node = Node('pong')
    publisher = node.create_publisher(FeedSignals, 'benchmark/pong', EXCHANGE)
    node.create_subscription(
        FeedSignals, 'benchmark/ping', publisher.publish, EXCHANGE,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))
    return [node]


if __name__ == '__main__':
    sys.exit(run(make_pong, []))
