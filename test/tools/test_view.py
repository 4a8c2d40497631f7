"""``scripts/view`` on a network in another process and on its recording."""

import dataclasses
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import network_view
from rhs_isac_ros.monitoring.network_view import RECEIVES
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.recording import RecordingError, read
from rhs_isac_ros.tools import command
from rhs_isac_ros.tools.view import ViewNode, entries, main

CONFIG = Path(__file__).parents[2] / 'config'
SCRIPT = CONFIG.parent / 'scripts' / 'view'
SCENARIO = Scenario.from_yaml(CONFIG / 'quick.yaml')
OTHER = dataclasses.replace(SCENARIO, refractive_index=2.0)
TIMEOUT_S = 120.0


def test_without_rerun_one_line_names_the_command_that_installs_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'rerun', None)
    assert main([]) == 1
    assert capsys.readouterr() == ('', (
        'view: error: view needs rerun, which is not installed '
        "(pip install 'rhs_isac_ros[view]'; in a clone: scripts/setup view)\n"))


@pytest.mark.parametrize(('arguments', 'reason'), [
    (['--save', 'view.txt'], "argument --save: 'view.txt', expected a name that ends with .rrd"),
    (['--namespace', '/lab'], 'argument --namespace: expected together with a recording'),
    (['--port', '65534'], 'argument --port: '),
    (['--cycles', '0'], 'argument --cycles: '),
    (['missing.mcap'], 'argument file: ')])
def test_an_invalid_argument_is_named(arguments, reason, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert reason in capsys.readouterr().err


@pytest.fixture(scope='module')
def rerun():
    return pytest.importorskip('rerun', reason='rerun-sdk is not installed (scripts/setup view)')


@pytest.fixture
def recording(rerun, run):
    return run.path


@pytest.fixture
def paths(rerun):
    """Function that returns the paths in a file, each with the number of its cycles."""
    rerun_file = pytest.importorskip('rerun_file')
    return lambda file: {path: len(cycles.keys() - {0})
                         for path, cycles in rerun_file.read(file).items()}


def test_a_running_network_is_shown(spin_until):
    found = set()
    node = ViewNode(SCENARIO, lambda entries: found.update(entry.path for entry in entries))
    expected = {
        f'{network_view.MODES}/found', 'capacity/actual', 'drops/all',
        network_view.LOG, network_view.POSITIONING, network_view.TRANSMISSION, *(
            f'{network_view.WORLD}/{part}' for part in (
                'surface/region', 'surface/board', 'surface/beam', 'user_1/truth',
                'user_2/estimate/ellipsoid', 'user_1/modes'))}
    spin_until(node, lambda: expected <= found)
    assert not node.mismatch


def test_a_network_of_another_scenario_is_not_shown(spin_until):
    """Even if its messages have the sizes of the expected ones."""
    paths = set()
    node = ViewNode(OTHER, lambda entries: paths.update(entry.path for entry in entries))
    spin_until(node, lambda: node.mismatch)
    assert f'expected {OTHER.id}' in node.mismatch
    assert 'capacity/actual' not in paths


def test_the_cycles_of_a_running_network_are_written(
        rerun, built_scripts, shared_session, paths, tmp_path):
    done = subprocess.run(
        [SCRIPT, '--config', CONFIG / 'quick.yaml', '--save', 'live.rrd', '--cycles', '5'],
        cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'live.rrd\n', '')
    assert [path.name for path in tmp_path.iterdir()] == ['live.rrd']
    shown = paths(tmp_path / 'live.rrd')
    assert shown[network_view.LOG] >= 5
    assert {path.partition('/')[0] for path in shown} >= {'error', 'capacity', 'latency'}


def test_a_recording_is_shown_with_modes(recording, run, paths, tmp_path, capsys):
    file = tmp_path / 'view.rrd'
    assert main([str(recording), '--save', str(file)]) == 0
    assert capsys.readouterr() == (f'{file}\n', '')
    shown = paths(file)
    n_posteriors = sum(1 for _ in read(recording, ['/posterior']))
    assert shown[f'{network_view.MODES}/found'] == n_posteriors
    assert len(run.cycles) <= shown['error/crlb'] <= n_posteriors


def test_all_cycles_are_shown_in_their_order_if_the_clock_of_a_recording_went_back(
        run, monkeypatch):
    found = list(command.recorded(run.path, '/', SCENARIO, RECEIVES))

    def logged(messages):
        monkeypatch.setattr(command, 'recorded', lambda *_: iter(messages))
        return [entry.entity.text for entry in entries(run.path, '/', SCENARIO)
                if entry.path == network_view.LOG]
    # Readers sort by time. Within a cycle, too, some messages then come before its beacon.
    middle = [index for index, (message, _) in enumerate(found)
              if isinstance(message, m.PositionEstimate)][1]
    assert len(expected := logged(found)) >= 2
    assert logged([*found[middle:], *found[:middle]]) == expected


def test_a_recording_without_the_namespace_is_an_error(recording, tmp_path, capsys):
    assert main([str(recording), '--namespace', '/lab', '--save', str(tmp_path / 'v.rrd')]) == 2
    assert 'no cycle in the namespace /lab' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_a_network_the_view_names_domain_and_namespace_and_writes_no_file(
        rerun, built_scripts, tmp_path):
    with subprocess.Popen(
            [SCRIPT, '--save', 'view.rrd', '--ros-args', '-r', '__ns:=/nowhere'], cwd=tmp_path,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        warning = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=TIMEOUT_S)
    reason = f'no cycle in the domain {os.environ["ROS_DOMAIN_ID"]} and the namespace /nowhere'
    assert warning.endswith(f'{reason}; still waiting\n')
    assert (process.returncode, out) == (1, '')
    assert err == f'view: error: view.rrd is not written: {reason}\n'
    assert not list(tmp_path.iterdir())


def test_a_recording_of_another_scenario_is_named(recording):
    with pytest.raises(RecordingError, match=f'recorded with scenario .*, expected {OTHER.id}'):
        list(entries(recording, '/', OTHER))


def is_free(port):
    with socket.socket() as probe:
        try:
            probe.bind(('', port))
        except OSError:
            return False
    return True


@pytest.fixture
def served(recording, built_scripts):
    """Address of a view of the recording, on free ports; a signal ends it."""
    port = next(port for port in range(9100, 9900, 3)
                if all(map(is_free, range(port, port + 3))))
    with subprocess.Popen([SCRIPT, recording, '--port', str(port)], stdout=subprocess.PIPE,
                          text=True, env={**os.environ, 'PYTHONUNBUFFERED': '1'}) as process:
        try:
            yield process.stdout.readline().strip()
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(TIMEOUT_S) == 0


def test_the_viewer_listens_on_the_loopback_address_alone(served):
    for port in map(int, re.findall(r':(\d+)', served)):
        socket.create_connection(('127.0.0.1', port), timeout=240.0).close()
        # A server for all addresses would accept this one, too.
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(('127.0.0.2', port), timeout=240.0)


def test_a_port_that_is_used_is_an_error_of_one_line(recording, capsys):
    with socket.socket() as other:
        other.bind(('127.0.0.1', 0))
        other.listen()
        port = other.getsockname()[1]
        assert main([str(recording), '--port', str(min(port, 65533))]) == 1
    assert 'Address already in use; choose others with --port' in capsys.readouterr().err
