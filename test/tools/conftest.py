"""A network in another process, and the tools in this one."""

import contextlib
import subprocess
import time
import types
from pathlib import Path

import numpy as np
import pytest
from rclpy.experimental.events_executor import EventsExecutor

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.ros.recording import Recorder, schema, type_name
from rhs_isac_ros.ros.session import Session

CONFIG = Path(__file__).parents[2] / 'config'
TIMEOUT_S = 120.0
CYCLES = 4


@pytest.fixture(scope='session')
def make_cycles(example):
    """Function that returns served cycles of users in turn, who walk through the region.

    The errors are 0.5 m, and their bounds 0.2 m.
    """
    def make(n, n_users=2, first=2):
        cycles = []
        for k in range(n):
            about = {'cycle_id': first + k, 'user': 1 + k % n_users}
            truth = np.array([6.0 + 8 * k / n, 3.0 - about['user'] % 5, 0.5])
            cycles.append(CompleteCycle(
                **about,
                state=example(m.ProtocolState, **about, outcome='served', elapsed_s=0.1,
                              began_s=np.array([0, 0.01, 0.03, 0.06])),
                truth=example(m.GroundTruth, **about, position=truth),
                signals=example(m.ReceivedSignals, **about, codebook_id='cb'),
                estimate=m.PositionEstimate(
                    **about, codebook_id='cb', position=truth + [0.3, 0.4, 0],
                    covariance_m2=np.array([[0.6, 0.2, 0.05], [0.2, 0.3, 0.0], [0.05, 0.0, 0.1]]),
                    crlb_m2=0.04, estimator='bayes', latency_s=0.01),
                capacity=example(m.Capacity, **about, codebook_id='cb', actual_bps=1e6)))
        return cycles
    return make


@pytest.fixture(scope='session')
def write_recording():
    """Function that writes messages to a recording of the small scenario, 0.1 s apart.

    `elsewhere` contains the namespaces of kinds of messages that are not in `namespace`.
    """
    def write(path, messages, namespace='', elsewhere=None):
        from mcap.writer import Writer
        names = {**topics.NAMES, convert.CodebookMessage: topics.CODEBOOK}
        writer, channels = Writer(str(path)), {}
        writer.start()
        writer.add_metadata(
            'scenario', {'yaml': (CONFIG / 'quick.yaml').read_text(encoding='utf-8')})
        for number, message in enumerate(messages):
            kind, own = type(message), convert.ros_type(type(message))
            if kind not in channels:
                channels[kind] = writer.register_channel(
                    f'{(elsewhere or {}).get(kind, namespace)}/{names[kind]}', 'cdr',
                    writer.register_schema(
                        type_name(own), 'ros2msg', schema(own).encode()))
            time_ns = number * 10**8
            identity = message.sender, message.scenario_id
            writer.add_message(channels[kind], time_ns, convert.to_bytes(
                message, time_ns, identity), time_ns)
        writer.finish()
        return path
    return write


@pytest.fixture(scope='package')
def network(tmp_path_factory):
    """A running network of the small scenario, two users in one process."""
    logs = tmp_path_factory.mktemp('logs')
    with Processes(logs, {'ROS_LOG_DIR': str(logs)}) as processes:
        # Most tests need no new cycles, which take CPU time. On a busy machine, an estimate may
        # take seconds.
        processes.start('network', scenario_file=CONFIG / 'quick.yaml', rest_s=1.0,
                        codebook_file=CONFIG / 'codebook_quick.yaml', step_timeout_s=10.0)
        yield processes


@pytest.fixture(scope='package')
def shared_session(network):
    """A session that has discovered the network, so that not every command has to."""
    with Session() as session:
        def present():
            assert not network.ended()
            # Transmission and positioner connect to their topics last.
            return (session.node.count_publishers('capacity')
                    and session.node.count_subscribers('received_signals'))
        assert session.spin_until(present, TIMEOUT_S)
        session.discover(TIMEOUT_S)
        yield session


@pytest.fixture(scope='package')
def spin_until(shared_session):
    """Function that spins a node until a condition holds, and then destroys it."""
    def spin(node, condition):
        shared_session._executor.add_node(node)
        try:
            assert shared_session.spin_until(condition, TIMEOUT_S)
        finally:
            shared_session._executor.remove_node(node)
            node.destroy_node()
    return spin


@pytest.fixture(scope='package')
def run(shared_session, tmp_path_factory):
    """A recording of some cycles of two users, and those that it has whole, as observed live."""
    pytest.importorskip('mcap', reason='mcap is not installed')
    path = tmp_path_factory.mktemp('recording') / 'run.mcap'
    recorder = Recorder(path, Scenario.from_yaml(CONFIG / 'quick.yaml'))
    observer = CycleObserver(recorder)
    # In the order of arrival; the executor of the session takes the topics in turn.
    executor, end_s = EventsExecutor(), time.monotonic() + TIMEOUT_S
    executor.add_node(observer)
    # Recorder and observer have separate queues, so the last message may be missing in one.
    while len(observer.complete) <= CYCLES:
        executor.spin_once(timeout_sec=0.1)
        assert time.monotonic() < end_s
    executor.shutdown()
    observer.destroy_node()
    recorder.close()
    return types.SimpleNamespace(path=path, cycles=observer.complete[:-1])


@pytest.fixture
def call(shared_session, capsys, monkeypatch):
    """Function that calls a tool's main function and returns output, errors and exit code."""
    monkeypatch.setattr(
        'parts.verbs.Session',
        lambda arguments: contextlib.nullcontext(shared_session))
    # A busy machine may take longer than the tools allow.
    for name in ('param._DISCOVERY_TIMEOUT_S', 'param._SERVICE_TIMEOUT_S',
                 'topic._DISCOVERY_TIMEOUT_S'):
        monkeypatch.setattr(f'parts.{name}', TIMEOUT_S)
    # Requests are repeated as often.
    monkeypatch.setattr('rhs_isac_ros.ros.session._N_REQUESTS', int(TIMEOUT_S))

    def result(main, *arguments):
        code = main(arguments)
        out, err = capsys.readouterr()
        return out, err, code
    return result


@pytest.fixture
def output_of(call):
    """Function that calls a tool's main function, which must succeed, and returns its output."""
    def output(main, *arguments):
        out, err, code = call(main, *arguments)
        assert (err, code) == ('', 0)
        return out
    return output


@pytest.fixture
def run_script(built_scripts, shared_session):
    """Function that runs a command line in a shell, which must succeed, and returns its output."""
    def output(line):
        done = subprocess.run(
            ['bash', '-o', 'pipefail', '-c', line], cwd=CONFIG.parent, capture_output=True,
            text=True, timeout=TIMEOUT_S, check=False)
        assert (done.returncode, done.stderr) == (0, '')
        return done.stdout
    return output
