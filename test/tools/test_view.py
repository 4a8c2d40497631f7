"""``scripts/view`` on a network in another process and on its recording, and in a browser."""

import dataclasses
import io
import os
import re
import signal
import socket
import subprocess
import sys
import time
import types
from pathlib import Path

import headless_browser
import numpy as np
import pytest
from rclpy.serialization import serialize_message

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import network_view
from rhs_isac_ros.monitoring.shapes import user_colour
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.recording import (
    CycleObserver,
    Recorder,
    RecordingError,
    read,
    schema,
    type_name,
)
from rhs_isac_ros.tools.replay import load
from rhs_isac_ros.tools.view import Posteriors, ViewNode, entries, main

CONFIG = Path(__file__).parents[2] / 'config'
SCRIPT = CONFIG.parent / 'scripts' / 'view'
CYCLES = 4
TIMEOUT_S = 120.0
# Components of the entities that change with the cycles.
CONTENTS = ('Scalar', 'Position3D', 'HalfSize3D', 'LineStrip2D', 'LineStrip3D', 'ImageBuffer',
            'Text')
# Dots of the charts have this size at least.
MIN_PIXELS = 20


def test_without_rerun_one_line_names_the_command_that_installs_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'rerun', None)
    assert main([]) == 1
    assert capsys.readouterr() == ('', (
        'view: error: view needs rerun, which is not installed '
        "(pip install 'rhs_isac_ros[view]'; in a clone: scripts/setup view)\n"))


@pytest.mark.parametrize(('arguments', 'reason'), [
    (['--save', 'view.txt'], "argument --save: 'view.txt', expected a name that ends with .rrd"),
    (['run.mcap', '--track-speed', '2'], 'argument --track-speed: expected together with --track'),
    (['--track'], 'arguments --track and --namespace: expected together with a recording'),
    (['--port', '65534'], 'argument --port: '),
    (['--cycles', '0'], 'argument --cycles: '),
    (['missing.mcap'], 'argument file: ')])
def test_an_invalid_argument_is_named(arguments, reason, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'run.mcap').touch()
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert reason in capsys.readouterr().err


@pytest.fixture(scope='module')
def rerun():
    return pytest.importorskip('rerun', reason='rerun-sdk is not installed (scripts/setup view)')


@pytest.fixture(scope='module')
def recording(rerun, shared_session, tmp_path_factory):
    """A recording of some cycles of two users."""
    pytest.importorskip('mcap', reason='mcap is not installed')
    path = tmp_path_factory.mktemp('recording') / 'run.mcap'
    recorder = Recorder(path, Scenario.from_yaml(CONFIG / 'quick.yaml'))
    observer = CycleObserver(recorder)
    shared_session._executor.add_node(observer)
    assert shared_session.spin_until(lambda: len(observer.log.complete) >= CYCLES, TIMEOUT_S)
    shared_session._executor.remove_node(observer)
    observer.destroy_node()
    recorder.close()
    return path


@pytest.fixture
def paths(rerun):
    """Function that returns the paths in a file, each with the number of its cycles."""
    def of(file):
        view = rerun.dataframe.load_recording(file).view(index='cycle', contents='/**')
        table = view.select().read_all()
        counts = {}
        for name in table.column_names:
            path, _, component = name.partition(':')
            # Styles are static: they fill all rows.
            if component in CONTENTS:
                counts[path.lstrip('/')] = sum(map(bool, table[name].to_pylist()))
        return counts
    return of


def test_a_running_network_is_shown(shared_session, monkeypatch):
    """Including the modes and the bound, which the view computes itself, in the background."""
    monkeypatch.setattr('rhs_isac_ros.tools.view._N_PHASES', 4)
    found = {}

    def write(entries):
        found.update((entry.path, entry.entity) for entry in entries)
    scenario = Scenario.from_yaml(CONFIG / 'quick.yaml')
    node = ViewNode(scenario, Posteriors(scenario), write)
    shared_session._executor.add_node(node)
    expected = {
        f'{network_view.MODES}/found', 'error/global_bound', 'capacity/actual', 'drops/all',
        network_view.LOG, network_view.POSITIONING, network_view.TRANSMISSION, *(
            f'{network_view.WORLD}/{part}' for part in (
                'region', 'board', 'beam', 'user_1/truth', 'user_2/estimate/ellipsoid',
                'user_1/modes'))}
    try:
        assert shared_session.spin_until(lambda: expected <= found.keys(), TIMEOUT_S), (
            expected - found.keys())
    finally:
        shared_session._executor.remove_node(node)
        node.destroy_node()
    assert not node.mismatch


def test_signals_wait_for_their_codebook_and_for_the_search_before_them(
        shared_session, monkeypatch, random_beams):
    scenario, searched, jobs = Scenario(), [], []
    codebook = random_beams(scenario, np.random.default_rng(0))

    class Prepared(dict):
        def add(self, codebook):
            self[codebook.id] = codebook

        def bound_m2(self, codebook):
            return 1.0

        def modes(self, received):
            searched.append(received.cycle_id)
    monkeypatch.setattr(endpoints, 'BackgroundWorker', lambda node: types.SimpleNamespace(
        run=lambda job, on_result: jobs.append(lambda: on_result(job())), close=lambda: None))
    node = ViewNode(scenario, Prepared(), list)
    try:
        for _ in range(2):
            node._on_codebook(codebook)
        for cycle_id in (3, 4):
            node._on_message(m.ReceivedSignals(
                cycle_id=cycle_id, user=1, codebook_id=codebook.id,
                signals=np.zeros((2, 8, 4), complex)))
            # The codebook, then its bound and the search.
            assert len(jobs) == cycle_id - 2
            jobs.pop(0)()
        while jobs:
            jobs.pop(0)()
    finally:
        node.destroy_node()
    assert searched == [3, 4]


def test_a_network_of_another_scenario_is_not_shown(shared_session):
    """Even if its messages have the sizes of the expected ones."""
    scenario = dataclasses.replace(
        Scenario.from_yaml(CONFIG / 'quick.yaml'), refractive_index=2.0)
    paths = set()
    node = ViewNode(scenario, Posteriors(scenario),
                    lambda entries: paths.update(entry.path for entry in entries))
    shared_session._executor.add_node(node)
    try:
        assert shared_session.spin_until(lambda: node.mismatch, TIMEOUT_S)
    finally:
        shared_session._executor.remove_node(node)
        node.destroy_node()
    assert f'expected {scenario.id}' in node.mismatch
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


def test_a_recording_is_shown_with_tracks_and_modes(recording, paths, tmp_path, capsys):
    file = tmp_path / 'view.rrd'
    assert main([str(recording), '--track', '--save', str(file)]) == 0
    assert capsys.readouterr() == (f'{file}\n', '')
    shown = paths(file)
    n_signals = sum(1 for _ in read(recording, ['/received_signals']))
    assert shown[f'{network_view.MODES}/found'] == n_signals
    assert shown['error/global_bound'] == len(load(recording).cycles)
    # A track begins with the second position.
    assert sum(shown.get(f'{network_view.WORLD}/user_{user}/track', 0)
               for user in (1, 2)) >= CYCLES - 2


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


def test_a_recording_of_another_scenario_is_named(recording, monkeypatch):
    monkeypatch.setattr('rhs_isac_ros.tools.view._N_PHASES', 4)
    scenario = dataclasses.replace(
        Scenario.from_yaml(CONFIG / 'quick.yaml'), refractive_index=2.0)
    with pytest.raises(RecordingError, match=f'recorded with scenario .*, expected {scenario.id}'):
        list(entries(recording, '/', scenario, Posteriors(scenario)))


def test_a_recording_of_another_surface_is_named(recording):
    with pytest.raises(RecordingError, match='run.mcap: /codebook: analog: shape .*, expected'):
        list(entries(recording, '/', Scenario(), Posteriors(Scenario())))


def test_a_malformed_codebook_of_a_recording_is_named(tmp_path):
    pytest.importorskip('mcap', reason='mcap is not installed')
    path = tmp_path / 'run.mcap'
    recorder = Recorder(path, Scenario())
    channel = recorder._writer.register_channel(
        topic='/codebook', message_encoding='cdr', schema_id=recorder._writer.register_schema(
            type_name(ros.Codebook), 'ros2msg', schema(ros.Codebook).encode()))
    recorder._writer_of(channel, 'codebook', None)(serialize_message(ros.Codebook()))
    recorder.close()
    with pytest.raises(RecordingError, match='/codebook: CodebookMessage.analog: 0 values'):
        list(entries(path, '/', Scenario(), Posteriors(Scenario())))


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
        socket.create_connection(('127.0.0.1', port), timeout=5.0).close()
        # A server for all addresses would accept this one, too.
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(('127.0.0.2', port), timeout=5.0)


def test_a_port_that_is_used_is_an_error_of_one_line(recording, capsys):
    with socket.socket() as other:
        other.bind(('127.0.0.1', 0))
        other.listen()
        port = other.getsockname()[1]
        assert main([str(recording), '--port', str(min(port, 65533))]) == 1
    assert 'Address already in use; choose others with --port' in capsys.readouterr().err


def pixels(png):
    from matplotlib.image import imread

    return np.rint(255 * imread(io.BytesIO(png))[..., :3]).astype(np.uint8)


def test_a_browser_shows_the_users_in_their_colours(served):
    """The dots of the charts have the colour of their user, which no empty viewer contains."""
    if headless_browser.executable() is None:
        pytest.skip('no Chromium is installed (apt install chromium)')
    assert re.fullmatch(r'http://localhost:\d+/\?url=ws://localhost:\d+', served)
    colours = [np.rint(255 * np.array(user_colour(user))).astype(np.uint8) for user in (1, 2)]
    with headless_browser.Browser(1000, 640) as browser:
        browser.open(served)
        end_s = time.monotonic() + TIMEOUT_S
        while True:
            picture = pixels(browser.picture())
            counts = [int((picture == colour).all(axis=-1).sum()) for colour in colours]
            if min(counts) >= MIN_PIXELS:
                break
            assert time.monotonic() < end_s, f'pixels in the colours of the users: {counts}'
    # The scene is on the left; it is not of one colour either.
    left = picture[:, :picture.shape[1] // 2].reshape(-1, 3)
    assert len(np.unique(left, axis=0)) > 100
