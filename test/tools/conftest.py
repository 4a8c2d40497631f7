"""A network in another process, and the tools run in this one."""

import contextlib
import subprocess
from pathlib import Path

import pytest

from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.tools.session import Session

CONFIG = Path(__file__).parents[2] / 'config'
PATIENCE_S = 60.0


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
    """A session that knows the network: to discover it anew for each command takes its time."""
    with Session() as session:
        def is_there():
            assert not network.ended()
            return session.node.count_publishers('capacity')
        assert session.until(is_there, PATIENCE_S)
        session.discover(PATIENCE_S)
        yield session


@pytest.fixture
def say(shared_session, capsys, monkeypatch):
    """Function that calls a tool's main function and returns what it says, and its exit code."""
    monkeypatch.setattr(
        'rhs_isac_ros.tools.session.Session', lambda: contextlib.nullcontext(shared_session))

    def call(main, *arguments):
        code = main(arguments)
        out, err = capsys.readouterr()
        return out, err, code
    return call


@pytest.fixture
def hear(say):
    """The same where nothing may be wrong: what the tool says."""
    def call(main, *arguments):
        out, err, code = say(main, *arguments)
        assert (err, code) == ('', 0)
        return out
    return call


@pytest.fixture
def call_script(shared_session):
    """Function that runs a script in a shell line of its own and returns what it says."""
    def call(line):
        done = subprocess.run(
            ['bash', '-o', 'pipefail', '-c', line], cwd=CONFIG.parent, capture_output=True,
            text=True, timeout=PATIENCE_S, check=False)
        assert (done.returncode, done.stderr) == (0, '')
        return done.stdout
    return call
