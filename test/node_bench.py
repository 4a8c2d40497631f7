"""Nodes in the process of a test, which spins them itself in the domain of `node_processes`."""

import contextlib
import gc
import importlib
import sys
import time
import warnings

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.type_support import check_for_type_support
from ros_messages import from_ros, parameters

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE

# Type supports load a parser that uses deprecated modules.
with warnings.catch_warnings():
    warnings.simplefilter('ignore', DeprecationWarning)
    check_for_type_support(ros.Beacon)

# Generous: starting ten processes takes long on a loaded machine.
TIMEOUT_S = 240.0


class Bench:
    """A context with an executor; its nodes are destroyed with it."""

    def __init__(self, make_executor):
        self.context = Context()
        rclpy.init(args=[], context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        # An executor may require a standard error with a descriptor, which pytest may have
        # replaced.
        with contextlib.redirect_stderr(sys.__stderr__):
            self._executor = make_executor(context=self.context)
        self._nodes = []

    def add(self, kind, *args, values=None, **options):
        """Create a node with values of parameters, and include it in all later spinning."""
        if values:
            options['parameter_overrides'] = parameters(values)
        node = kind(*args, context=self.context, **options)
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def add_role(self, role, *args, **options):
        """Create the node of a role, whose class is named after it, as by `add`."""
        module = importlib.import_module(f'rhs_isac_ros.nodes.{role}')
        return self.add(getattr(module, f'{role.title().replace("_", "")}Node'), *args, **options)

    def remove(self, node):
        self._nodes.remove(node)
        self._executor.remove_node(node)
        node.destroy_node()

    def spin_once(self):
        """Spin once; as in a node's process, exceptions of callbacks are raised."""
        self._executor.spin_once(timeout_sec=0.01)

    def spin(self):
        """Spin between two checks of a condition."""
        # The queue may still hold a request to a node that was removed.
        with contextlib.suppress(InvalidHandle):
            self._executor.spin_once(timeout_sec=0.1)

    def until(self, condition, what='the condition', processes=()):
        """Spin until a condition holds and return its value; no process may end before."""
        end_s = time.monotonic() + TIMEOUT_S
        while not (value := condition()):
            for process in processes:
                assert process.running, f'ended with {process.wait()}\n{process.log}'
            assert time.monotonic() < end_s, '\n'.join(
                [f'{what}: not within {TIMEOUT_S:g} s', *(process.log for process in processes)])
            self.spin()
        return value

    def result(self, future):
        """Spin until a future is done and return its result."""
        self.until(future.done, 'the answer')
        return future.result()

    def publisher(self, node, kind, n_others=0):
        """Return a publisher of a message once it has more than `n_others` subscribers."""
        publisher = node.create_publisher(
            convert.ros_type(kind), topics.NAMES[kind], EXCHANGE)
        self.until(lambda: publisher.get_subscription_count() > n_others,
                   f'a subscriber of {kind.__name__}')
        return publisher

    def collect(self, node, kind):
        """Return a list that collects the messages of a kind, once there is a publisher."""
        received = []
        subscription = node.create_subscription(
            convert.ros_type(kind), topics.NAMES[kind],
            lambda message: received.append(from_ros(kind, message)), EXCHANGE)
        self.until(subscription.get_publisher_count, f'a publisher of {kind.__name__}')
        return received

    def close(self):
        for node in list(self._nodes):
            self.remove(node)
        self._executor.shutdown()
        rclpy.shutdown(context=self.context)
        # A node whose constructor failed is part of a reference cycle. If it were destroyed in the
        # middle of a later test, its participant could block the process.
        gc.collect()


@pytest.fixture
def bench():
    bench = Bench(EventsExecutor)
    yield bench
    bench.close()


@pytest.fixture(scope='module')
def module_bench():
    bench = Bench(EventsExecutor)
    yield bench
    bench.close()


@pytest.fixture(params=[EventsExecutor, SingleThreadedExecutor], ids=['events', 'single'])
def each_bench(request):
    """A bench with each executor that the nodes support."""
    bench = Bench(request.param)
    yield bench
    bench.close()


@pytest.fixture
def probe(bench):
    return bench.add(Node, 'probe')


@pytest.fixture(scope='session')
def bench_files(small, random_beams, tmp_path_factory):
    """Folder with the files of a small scenario and of two codebooks for it."""
    folder = tmp_path_factory.mktemp('small')
    write_files(folder, small.scenario, random_beams)
    return folder


def write_files(folder, scenario, random_beams):
    """Write the files of a scenario and of two codebooks for it."""
    scenario.to_yaml(folder / 'scenario.yaml')
    for seed, name in enumerate(('first', 'second')):
        random_beams(scenario, np.random.default_rng(seed)).save(folder / f'{name}.yaml')
