"""Nodes of one process, spun by the test itself, on a domain of this process."""

import contextlib
import dataclasses
import os
import time
import warnings

import numpy as np
import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.type_support import check_for_type_support

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.ros import convert, qos, topics

# Before rclpy reads them.
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'

# Type supports load a parser that is older than this Python.
with warnings.catch_warnings():
    warnings.simplefilter('ignore', DeprecationWarning)
    check_for_type_support(ros.Beacon)

PATIENCE_S = 30.0


class Bench:
    """A context with its own executor; the nodes end with the test."""

    def __init__(self, make_executor):
        self.context = Context()
        rclpy.init(args=[], context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        self._executor = make_executor(context=self.context)
        self._nodes = []

    def add(self, kind, *args, **options):
        """Make a node, spun from now on."""
        node = kind(*args, context=self.context, **options)
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def remove(self, node):
        self._nodes.remove(node)
        self._executor.remove_node(node)
        node.destroy_node()

    def until(self, condition, what='the condition'):
        """Spin until a condition holds, and return its value."""
        end_s = time.monotonic() + PATIENCE_S
        while not (value := condition()):
            assert time.monotonic() < end_s, f'{what} does not come about'
            # A request that a removed node had not answered yet is still in the queue.
            with contextlib.suppress(InvalidHandle):
                self._executor.spin_once(timeout_sec=0.1)
        return value

    def result(self, future):
        """Spin until a future is done, and return its result."""
        self.until(future.done, 'the answer')
        return future.result()

    def outlet(self, node, kind):
        """Publisher of a message, as soon as somebody listens."""
        publisher = node.create_publisher(
            convert.ros_type(kind), topics.NAMES[kind], qos.EXCHANGE)
        self.until(publisher.get_subscription_count, f'a listener of {kind.__name__}')
        return publisher

    def hear(self, node, kind):
        """List that fills with the messages of a kind, as soon as somebody publishes."""
        heard = []
        subscription = node.create_subscription(
            convert.ros_type(kind), topics.NAMES[kind],
            lambda message: heard.append(convert.from_ros(kind, message)), qos.EXCHANGE)
        self.until(subscription.get_publisher_count, f'a publisher of {kind.__name__}')
        return heard

    def close(self):
        for node in list(self._nodes):
            self.remove(node)
        self._executor.shutdown()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def bench():
    bench = Bench(EventsExecutor)
    yield bench
    bench.close()


@pytest.fixture(params=[EventsExecutor, SingleThreadedExecutor], ids=['events', 'single'])
def each_bench(request):
    """A bench on each executor with which the nodes are to work."""
    bench = Bench(request.param)
    yield bench
    bench.close()


@pytest.fixture
def probe(bench):
    return bench.add(Node, 'probe')


@pytest.fixture(scope='session')
def small_files(small, random_beams, tmp_path_factory):
    """Files of a small scenario and of two codebooks for it."""
    folder = tmp_path_factory.mktemp('small')
    fields = {key: list(value) if isinstance(value, tuple) else value
              for key, value in dataclasses.asdict(small.scenario).items()}
    (folder / 'scenario.yaml').write_text(yaml.safe_dump(fields), encoding='utf-8')
    for seed, name in enumerate(('first', 'second')):
        codebook = random_beams(small.scenario, np.random.default_rng(seed))
        codebook.save(folder / f'{name}.yaml')
    return folder
