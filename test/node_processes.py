"""Executables in processes of their own, and a node in this process that watches them."""

import collections
import contextlib
import math
import os
import signal
import subprocess
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from ament_index_python.packages import get_package_prefix
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from rclpy.signals import SignalHandlerOptions
from rclpy.type_support import check_for_type_support

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics

# Before rclpy reads them; the processes inherit them.
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
# Type supports load a parser that is older than this Python.
with warnings.catch_warnings():
    warnings.simplefilter('ignore', DeprecationWarning)
    check_for_type_support(ros.Beacon)

# Generous: a machine under load takes its time to start ten processes.
PATIENCE_S = 60.0
# Marks of an exception that nobody caught.
CRASH = ('Traceback', 'Exception in', 'Error occurred at', '[FATAL]', 'Segmentation')
EXECUTABLES = Path(get_package_prefix('rhs_isac_ros')) / 'lib' / 'rhs_isac_ros'


class Process:
    """One executable; what it prints goes to a file."""

    def __init__(self, executable, own, arguments, log):
        self._log = log
        with open(log, 'wb') as stream:
            self._popen = subprocess.Popen(
                [EXECUTABLES / executable, *own, '--ros-args', *arguments],
                stdin=subprocess.DEVNULL, stdout=stream, stderr=stream,
                env={**os.environ, 'ROS_LOG_DIR': str(log.parent)})

    @property
    def log(self):
        return self._log.read_text(encoding='utf-8', errors='replace')

    @property
    def running(self):
        return self._popen.poll() is None

    def signal(self, number):
        self._popen.send_signal(number)

    def wait(self):
        """Exit code, once it has ended."""
        try:
            return self._popen.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            # The executor has Python write where every thread stands.
            self._popen.send_signal(signal.SIGABRT)
            self._popen.wait()
            raise AssertionError(f'it does not end\n{self.log}') from None

    def end(self):
        """Wait for its end, and force it if it does not come."""
        try:
            self._popen.wait(10.0)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()


class Processes:
    """Starts executables; as a context, it leaves none of them behind."""

    def __init__(self, folder):
        self._folder = folder
        self._all = []

    def start(self, executable, *arguments, name='', namespace='/', own=(), **parameters):
        """Start an executable with options of its own, a node name, a namespace, parameters."""
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            arguments += ('-p', f'{key}:={text}')
        if name:
            arguments += ('-r', f'__node:={name}')
        if namespace != '/':
            arguments += ('-r', f'__ns:={namespace}')
        log = self._folder / f'{len(self._all)}_{name or executable}.log'
        process = Process(executable, own, arguments, log)
        self._all.append(process)
        return process

    def __enter__(self):
        return self

    def __exit__(self, *details):
        for process in self._all:
            process.signal(signal.SIGINT)
        for process in self._all:
            process.end()


class Watch:
    """Hears everything of one namespace, in this process."""

    def __init__(self, namespace='/'):
        self._context = Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node('watch', namespace=namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.heard = {kind: [] for kind in topics.NAMES}
        self._of_cycle = collections.defaultdict(list)
        # Cycles that were served, in their order.
        self.served = []
        self.poses = []
        # Functions to call with each message of a kind.
        self.hooks = {}
        for kind, name in topics.NAMES.items():
            self.node.create_subscription(
                convert.ros_type(kind), name,
                lambda message, kind=kind: self._hear(kind, message), qos.EXCHANGE)
        self.node.create_subscription(
            PoseWithCovarianceStamped, topics.POSITION, self.poses.append, qos.EXCHANGE)

    def _hear(self, kind, message):
        plain = convert.from_ros(kind, message)
        self.heard[kind].append(plain)
        self._of_cycle[kind, getattr(plain, 'cycle_id', None)].append(plain)
        if kind is m.ProtocolState and plain.outcome == 'served':
            self.served.append(plain)
        if kind in self.hooks:
            self.hooks[kind](plain)

    def _spin(self):
        """Hear for a moment: a condition that is asked after each message would fall behind."""
        end_s = time.monotonic() + 0.02
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left_s)

    def until(self, condition, what, processes=()):
        """Spin until a condition holds, and return its value."""
        end_s = time.monotonic() + PATIENCE_S
        while not (value := condition()):
            for process in processes:
                assert process.running, f'ended with {process.wait()}\n{process.log}'
            assert time.monotonic() < end_s, '\n'.join(
                [f'{what} does not come about', *(process.log for process in processes)])
            self._spin()
        return value

    def answer(self, client, request, processes=()):
        """Answer to what a function asks a client for; a lost answer is asked for again."""
        self.until(client.services_are_ready, 'the services', processes)
        futures, asked_s = [], -math.inf

        def answered():
            nonlocal asked_s
            if time.monotonic() > asked_s + 2.0:
                asked_s = time.monotonic()
                futures.append(request(client))
            return next((future for future in futures if future.done()), None)
        return self.until(answered, 'the answer', processes).result()

    def answering(self, *names):
        """Wait until nodes answer, so that they are past their start."""
        for name in names:
            client = AsyncParameterClient(self.node, name)
            self.answer(client, lambda client: client.list_parameters([], 1))

    def outlet(self, kind, listeners=1):
        """Publisher of a message, once it is connected."""
        publisher = self.node.create_publisher(
            convert.ros_type(kind), topics.NAMES[kind], qos.EXCHANGE)
        # This watch listens as well.
        self.until(lambda: publisher.get_subscription_count() > listeners, 'the listeners')
        return publisher

    def of_cycle(self, kind, cycle_id):
        return list(self._of_cycle[kind, cycle_id])

    @property
    def given_up(self):
        return [message for message in self.heard[m.ProtocolState]
                if message.outcome not in ('', 'served')]

    def until_served(self, n=1, user=None, processes=()):
        """Wait for the ends of n more cycles, of one user or of any, and return them."""
        before = len(self.served)

        def new():
            ends = [end for end in self.served[before:] if user in (None, end.user)]
            return ends if len(ends) >= n else None
        return self.until(new, f'{n} more cycles of user {user}', processes)

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture(scope='session')
def make_processes(tmp_path_factory):
    """Function that makes a context for processes, which end with it."""
    return lambda: Processes(tmp_path_factory.mktemp('logs'))


@pytest.fixture
def processes(make_processes):
    with make_processes() as processes:
        yield processes


@pytest.fixture(scope='module')
def module_processes(make_processes):
    with make_processes() as processes:
        yield processes


@pytest.fixture(scope='module')
def make_watch():
    """Function that makes a watch for a namespace."""
    with contextlib.ExitStack() as stack:
        def make(namespace='/'):
            watch = Watch(namespace)
            stack.callback(watch.close)
            return watch
        yield make


@pytest.fixture(scope='session')
def small_files(random_beams, tmp_path_factory):
    """Files of a scenario that is quick to compute and of two codebooks for it."""
    folder = tmp_path_factory.mktemp('small')
    fields = {'n_subbands': 2, 'n_frames': 3, 'n_feeds': 2, 'elements_per_side': 4}
    scenario = Scenario(**fields)
    (folder / 'scenario.yaml').write_text(yaml.safe_dump(fields), encoding='utf-8')
    for seed, name in enumerate(('first', 'second')):
        random_beams(scenario, np.random.default_rng(seed)).save(folder / f'{name}.yaml')
    return folder


@pytest.fixture(scope='session')
def crashed():
    """Function that returns the marks of a crash in a log."""
    return lambda log: [mark for mark in CRASH if mark in log]
