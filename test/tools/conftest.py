"""A network in another process, and the tools in this one."""

import contextlib
import subprocess
from pathlib import Path

import pytest

from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.tools.command import Session

CONFIG = Path(__file__).parents[2] / 'config'
TIMEOUT_S = 60.0


@pytest.fixture(scope='module')
def network(tmp_path_factory):
    """A running network of the small scenario, two users in one process."""
    logs = tmp_path_factory.mktemp('logs')
    with Processes(logs, {'ROS_LOG_DIR': str(logs)}) as processes:
        processes.start('network', scenario_file=CONFIG / 'quick.yaml',
                        codebook_file=CONFIG / 'codebook_quick.yaml')
        yield processes


@pytest.fixture(scope='module')
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


@pytest.fixture
def call(shared_session, capsys, monkeypatch):
    """Function that calls a tool's main function and returns output, errors and exit code."""
    monkeypatch.setattr(
        'rhs_isac_ros.tools.command.Session',
        lambda arguments: contextlib.nullcontext(shared_session))

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
