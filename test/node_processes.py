"""Executables in child processes, and a node in this process that observes them."""

import collections
import contextlib
import math
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix
from forked import Forked
from node_bench import TIMEOUT_S, Bench, write_files
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from ros_messages import parameters

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import OBSERVATION
from rhs_isac_ros.ros.environment import claim_domain
from rhs_isac_ros.ros.parameters import NODES
from rhs_isac_ros.ros.processes import with_parent

# Set before rclpy reads them; the child processes inherit them.
os.environ['ROS_DOMAIN_ID'] = claim_domain()
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
# Time without a response after which a request is repeated, which may then be handled twice [s].
REQUEST_S = 10.0
# Texts that show an uncaught exception.
CRASH_TEXTS = ('Traceback', 'Exception in', 'Error occurred at', '[FATAL]', 'Segmentation')
EXECUTABLES = Path(get_package_prefix('rhs_isac_ros')) / 'lib' / 'rhs_isac_ros'
# A step of a cycle is repeated every 0.25 s, as by default, but for longer on a busy machine.
STEPS = {'step_timeout_s': 10.0, 'retries': 39}


def messages_of_cycle(n_bands):
    """Return the number of messages of each class in a served cycle without repetitions."""
    return {m.Grant: 1, m.ReceivedSignals: 1, m.PositionEstimate: 1, m.Beam: 1, m.Capacity: 1,
            m.CapacityStatistics: 1, m.GroundTruth: 1, m.RhsCommand: n_bands,
            m.RhsConfiguration: n_bands + 1, m.PilotRequest: 1, m.Pilot: n_bands,
            m.FeedSignals: n_bands, m.Data: 4, m.ProtocolState: 4}


class Process:
    """A process of an executable, whose output goes to a file."""

    def __init__(self, executable, options, arguments, log, as_program, attributes):
        self._log = log
        command = [str(EXECUTABLES / executable), *map(str, options), '--ros-args',
                   *map(str, arguments)]
        environment = {**os.environ, 'ROS_LOG_DIR': str(log.parent)}
        log.touch()
        assert not (as_program and attributes)
        if not as_program:
            self._popen = Forked(command, log, environment, attributes)
            return
        with open(log, 'wb') as stream:
            self._popen = subprocess.Popen(
                with_parent(command), stdin=subprocess.DEVNULL, stdout=stream, stderr=stream,
                env=environment)

    @property
    def log(self):
        return self._log.read_text(encoding='utf-8', errors='replace')

    @property
    def running(self):
        return self._popen.poll() is None

    @property
    def open_files(self):
        """Names of the open files."""
        return [os.readlink(file) for file in Path(f'/proc/{self._popen.pid}/fd').iterdir()]

    def signal(self, number):
        self._popen.send_signal(number)

    def wait(self):
        """Return the exit code once the process has ended."""
        try:
            return self._popen.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            # On SIGABRT, Python prints the stacks of all threads.
            self._popen.send_signal(signal.SIGABRT)
            self._popen.wait()
            raise AssertionError(f'the process does not end\n{self.log}') from None

    def end(self):
        """Wait for the end of the process, and kill it after a timeout."""
        try:
            self._popen.wait(10.0)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()


class Processes:
    """A context manager that starts executables and ends them on exit."""

    def __init__(self, folder):
        self._folder = folder
        self._all = []

    def start(self, executable, *arguments, name='', namespace='/', options=(),
              as_program=False, attributes=None, **parameters):
        """Start an executable with command line options and ROS parameters.

        By default, it is a copy of a process that has imported it, whose module gets `attributes`;
        a program takes longer.
        """
        known = {parameter.name for parameter in NODES[executable]}
        steps = {key: value for key, value in STEPS.items() if key in known}
        for key, value in (steps | parameters).items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            arguments += ('-p', f'{key}:={text}')
        if name:
            arguments += ('-r', f'__node:={name}')
        if namespace != '/':
            arguments += ('-r', f'__ns:={namespace}')
        log = self._folder / f'{len(self._all)}_{name or executable}.log'
        process = Process(executable, options, arguments, log, as_program, attributes)
        self._all.append(process)
        return process

    def __enter__(self):
        return self

    def __exit__(self, *details):
        for process in self._all:
            process.signal(signal.SIGINT)
        for process in self._all:
            process.end()


class Watch(Bench):
    """An observer in this process that receives all messages of a namespace."""

    def __init__(self, namespace='/'):
        super().__init__(EventsExecutor)
        self.node = self.add(Node, 'watch', namespace=namespace)
        self.received = {kind: [] for kind in topics.NAMES}
        self._of_cycle = collections.defaultdict(list)
        # Final states of cycles that were served, in order of arrival.
        self.ends = []
        # Functions by message class, called with each message.
        self.hooks = {}
        # Clients of parameters by node.
        self._clients = {}
        for kind, name in topics.NAMES.items():
            self.node.create_subscription(
                convert.ros_type(kind), name,
                lambda message, kind=kind: self._receive(kind, message), OBSERVATION, raw=True)

    def _receive(self, kind, serialized):
        plain = convert.from_bytes(kind, serialized)
        self.received[kind].append(plain)
        self._of_cycle[kind, getattr(plain, 'cycle_id', None)].append(plain)
        if kind is m.ProtocolState and plain.outcome == 'served':
            self.ends.append(plain)
        if kind in self.hooks:
            self.hooks[kind](plain)

    def spin(self):
        """Spin briefly: checking a condition after each message would take too long."""
        end_s = time.monotonic() + 0.02
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left_s)

    def call(self, client, request, processes=()):
        """Return the response to a request of a client; lost requests are repeated."""
        ready = getattr(client, 'services_are_ready', None) or client.service_is_ready
        self.until(ready, 'the services', processes)
        futures, requested_s = [], -math.inf

        def response():
            nonlocal requested_s
            if time.monotonic() > requested_s + REQUEST_S:
                requested_s = time.monotonic()
                futures.append(request(client))
            return next((future for future in futures if future.done()), None)
        return self.until(response, 'the response', processes).result()

    def set_parameters(self, node, values, processes=()):
        """Set parameters of a node together and return the result."""
        if node not in self._clients:
            self._clients[node] = AsyncParameterClient(self.node, node)
        return self.call(self._clients[node], lambda client: client.set_parameters_atomically(
            parameters(values)), processes).result

    def wait_for_nodes(self, *names):
        """Wait until the parameter services of nodes respond, so that they have started."""
        for name in names:
            client = AsyncParameterClient(self.node, name)
            self.call(client, lambda client: client.list_parameters([], 1))

    def publisher(self, kind, n_others=1):
        """Return a publisher of a message once it has other subscribers than this observer."""
        return super().publisher(self.node, kind, n_others)

    def of_cycle(self, kind, cycle_id):
        return list(self._of_cycle[kind, cycle_id])

    def _received(self, ends):
        """Return the ends of cycles of which messages of each class have arrived.

        DDS discovers each topic on its own: an observer may receive the end of a cycle before it
        knows the other topics, and messages of one topic before earlier ones of another.
        """
        kinds = messages_of_cycle(1)
        return [end for end in ends if all(self._of_cycle[kind, end.cycle_id] for kind in kinds)]

    @property
    def served(self):
        """Final states of the served cycles of which all messages have arrived, in order."""
        return self._received(self.ends)

    @property
    def given_up(self):
        """Final states of cycles that failed; signals without a position are no failure."""
        return [message for message in self.received[m.ProtocolState]
                if message.outcome not in ('', 'served', 'no_fix')]

    def until_served(self, n=1, user=None, processes=()):
        """Wait for n more served cycles, of one user or of any, and return their final states."""
        before = len(self.ends)

        def new_ends():
            ends = [end for end in self._received(self.ends[before:]) if user in (None, end.user)]
            return ends if len(ends) >= n else None
        return self.until(new_ends, f'{n} more cycles of user {user}', processes)


@pytest.fixture(scope='session')
def make_processes(tmp_path_factory):
    """Return a function that creates a context manager of processes."""
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
    """Return a function that creates an observer of a namespace."""
    with contextlib.ExitStack() as stack:
        def make(namespace='/'):
            watch = Watch(namespace)
            stack.callback(watch.close)
            return watch
        yield make


@pytest.fixture(scope='session')
def small_files(random_beams, tmp_path_factory):
    """Folder with the files of a small scenario and of two codebooks for it."""
    folder = tmp_path_factory.mktemp('small')
    # Twelve measurements rarely show whether a user is inside: all users are taken to be.
    write_files(folder, Scenario(
        n_subbands=2, n_frames=3, n_feeds=2, elements_per_side=4, outside_probability=0.0),
        random_beams)
    return folder


@pytest.fixture(scope='session')
def crashed():
    """Return a function that returns the texts in a log that show a crash."""
    return lambda log: [text for text in CRASH_TEXTS if text in log]
