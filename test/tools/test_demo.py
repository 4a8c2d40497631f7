"""The demonstration: its command line, the nodes that it starts, and its report."""

import dataclasses
import signal
import types
from pathlib import Path
from unittest import mock

import pytest
from rclpy.node import Node

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.cycle_log import CycleRecord
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.positioning import Site
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.diagnostics import TABLE_PROGRESS, make_reporter
from rhs_isac_ros.ros.recording import read_networks
from rhs_isac_ros.ros.roster import FOLLOWING, ROSTER
from rhs_isac_ros.tools import demo

SITE = Path(__file__).parents[2] / 'config' / 'site.yaml'


def test_progress_is_printed_at_the_start_after_ten_cycles_and_at_the_end(monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    for complete in range(13):
        demo._show_progress(complete, 12)
    assert capsys.readouterr().err.splitlines() == [
        'network started with ROS_DOMAIN_ID=7, waiting for the first cycle',
        'cycle 10 of 12', 'cycle 12 of 12']


@pytest.mark.parametrize(('number', 'arguments', 'surfaces'), [
    (signal.SIGINT, [], []), (signal.SIGTERM, ['--site', str(SITE)], ['front', 'side']),
    (signal.SIGHUP, [], [])])
def test_a_signal_during_the_start_completes_the_recording(
        number, arguments, surfaces, tmp_path, monkeypatch):
    pytest.importorskip('mcap', reason='mcap is not installed')

    def interrupted(*_, **__):
        signal.raise_signal(number)
    # The environment of this process remains as it is.
    for module, name, replacement in (
            (demo, 'start_network', interrupted), (demo, 'private_domain', dict)):
        monkeypatch.setattr(module, name, replacement)
    monkeypatch.chdir(tmp_path)
    assert demo.main(['--record', 'run.mcap', *arguments]) == 0
    assert [file.name for file in tmp_path.iterdir()] == ['run.mcap']
    assert [*read_networks('run.mcap').surfaces] == surfaces


def test_a_recording_that_fails_has_an_exit_code(tmp_path, monkeypatch, capsys, full_disk):
    pytest.importorskip('mcap', reason='mcap is not installed')
    monkeypatch.setattr(demo, 'start_network', lambda *_, **__: signal.raise_signal(signal.SIGINT))
    monkeypatch.setattr(demo, 'private_domain', dict)
    monkeypatch.chdir(tmp_path)
    with full_disk(10):
        assert demo.main(['--record', 'run.mcap']) == 1
    out, err = capsys.readouterr()
    assert (out, err) == ('', 'demo: error: run.mcap.part: cannot be written: File too large; the '
                              'recording ends after 0 messages\n')
    # The same command again would replace the file.
    assert demo.main(['--record', 'run.mcap']) == 2
    assert 'run.mcap.part: cannot be written: File exists' in capsys.readouterr().err


def test_samples_that_cannot_be_written_have_an_exit_code(tmp_path, monkeypatch, capsys):
    """The process of the node ends as it would otherwise, and the network goes on."""
    error = 'samples: samples cannot be written: No space left on device; the recording has ended'

    def start(processes, *_, **__):
        processes._commands['channel'] = []
        (processes._logs / 'channel.log').write_text(
            f'[INFO] [1.0] [channel]: serving\n[ERROR] [2.0] [channel]: {error}\n')
        signal.raise_signal(signal.SIGINT)
    monkeypatch.setattr(demo, 'start_network', start)
    monkeypatch.setattr(demo, 'private_domain', dict)
    monkeypatch.chdir(tmp_path)
    lab = [f'--{name}={SITE.parent}/{file}' for name, file in (
        ('config', 'lab.yaml'), ('codebook', 'codebook_lab.yaml'))]
    assert demo.main([*lab, '--radio', 'waveform', '--samples', 'samples']) == 1
    assert capsys.readouterr().err == f'demo: error: {error}\n'


@pytest.mark.parametrize(('config', 'codebook', 'expected'), [
    ('lab_walk.yaml', None, 'codebook_lab_walk.yaml'), ('table1.yaml', None, 'codebook.yaml'),
    ('quick.yaml', None, 'codebook_quick.yaml'), (None, None, 'codebook.yaml'),
    ('table1.yaml', 'codebook_crlb.yaml', 'codebook_crlb.yaml')])
def test_the_default_codebook_lies_beside_the_scenario(config, codebook, expected):
    config, codebook = (name and SITE.parent / name for name in (config, codebook))
    assert demo.load_files(config, codebook)[1].samefile(SITE.parent / expected)


@pytest.mark.parametrize(('speed_mps', 'declared_mps', 'lines'), [
    (0.01, 0.0, 0), (1.5, 0.0, 1), (1.5, 1.0, 0)])
def test_undeclared_movement_is_one_line(speed_mps, declared_mps, lines, tmp_path, capsys):
    path = tmp_path / 'mine.yaml'
    path.write_text(f'frame_duration_s: 0.015\nmax_user_speed_mps: {speed_mps}\n'
                    f'user_speed_std_mps: {declared_mps}\n')
    demo.load_files(path, None)
    found = capsys.readouterr().err.splitlines()
    assert [line.partition(',')[0] for line in found] == lines * ['warning: user_speed_std_mps: 0']


class Started(dict):
    """The parameters of processes, by namespace and name."""

    def start(self, executable, name='', namespace='', **parameters):
        self[namespace, name or executable] = parameters


def test_each_node_has_the_given_parameters_that_it_knows():
    nodes = Started()
    demo.start_network(nodes, 2, Scenario(), seed=3, rest_s=None, prior='track')
    assert {name for _, name in nodes} == {*ROSTER, 'user_1', 'user_2'} - {'user'}
    assert nodes['', 'positioner'] == {'prior': 'track'}
    assert nodes['', 'bs'] == {'seed': 3}
    assert nodes['', 'user_2'] == {
        'user_id': 2, 'user_count': 1, 'mobility': 'random_walk', 'seed': 3,
        'speed_mps': Scenario().max_user_speed_mps}


def test_a_composed_network_has_the_same_parameters_in_one_process():
    nodes = Started()
    demo.start_network(nodes, 2, Scenario(), composed=True, seed=3, rest_s=None, speed_mps=1.0)
    assert nodes == {('', 'network'): {
        'users': 2, 'mobility': 'random_walk', 'seed': 3, 'speed_mps': 1.0}}


def test_a_site_has_users_at_the_first_surface_and_one_fusion():
    nodes = Started()
    demo.start_network(
        nodes, 30, Scenario(), together=True, surfaces=['front', 'side'], site_file='x.yaml')
    assert {name for space, name in nodes if space == 'front'} == {*ROSTER, 'users'} - {'user'}
    assert {name for space, name in nodes if space == 'side'} == {*FOLLOWING}
    assert [name for space, name in nodes if not space] == ['fusion']
    assert nodes['front', 'users']['user_count'] == 30
    assert {values['site_file'] for values in nodes.values()} == {'x.yaml'}


def test_the_report_has_a_line_for_each_cycle_and_statistics(make_cycles):
    rows = [row.split() for row in demo.table(make_cycles(3)).splitlines()[2:]]
    numbers = ['0.50', '0.20', '10.0', '20.0', '30.0', '40.0', '1.000', '0.000']
    assert [(row[0], row[1], row[8:]) for row in rows] == [
        ('2', '1', numbers), ('3', '2', numbers), ('4', '1', numbers)]
    assert rows[0][2:8] == ['6.00', '2.00', '0.50', '6.30', '2.40', '0.50']
    assert demo.summary(make_cycles(3), [CycleRecord(9, 4, outcome='user_gone')]).splitlines() == [
        '3 cycles of 2 users served, 1 given up; codebooks: 1',
        'position error: median 0.50 m, root mean square 0.50 m; median √CRLB 0.20 m',
        'cycle: median 100.0 ms; estimator: median 10.0 ms',
        'capacity: median 1.00 Mbit/s; loss: median 0.000 %, worst 0.000 %',
        'cycle 9 of user 4 given up: user_gone']


def test_the_report_of_a_site_has_the_errors_of_each_surface_and_the_handovers(
        bench, make_cycles):
    observer = bench.add(demo.SiteObserver, Site.from_yaml(SITE))
    for cycle in make_cycles(4, first=1):
        for message in (m.Beacon(cycle_id=cycle.cycle_id, attempt=0), cycle.truth, cycle.signals,
                        cycle.estimate, cycle.capacity, cycle.state):
            observer.observe(message, 0.0)
        # The side has no position in the first cycle, which is not reported, and in the third.
        for name, offset_m in (('front', 1.0), ('side', 2.0), ('fused', 0.5)):
            if name != 'side' or cycle.cycle_id in (2, 4):
                observer._keep(name, dataclasses.replace(
                    cycle.estimate, position=cycle.truth.position + [0, offset_m, 0]))
        observer._keep('side' if cycle.cycle_id == 4 else 'front', m.Data(
            cycle_id=cycle.cycle_id, user=cycle.user, direction=m.Direction.UPLINK,
            stage=m.Stage.DELIVERED, duration_s=0.1, bits=1.0))
    text, *lines = demo.site_lines(observer)
    assert [row.split() for row in text.splitlines()[2:]] == [
        ['2', '2', '8.00', '1.00', '0.50', '1.000', '2.000', '0.500', 'front'],
        ['3', '1', '10.00', '2.00', '0.50', '1.000', 'nan', '0.500', 'front'],
        ['4', '2', '12.00', '1.00', '0.50', '1.000', '2.000', '0.500', 'side']]
    assert lines == [
        'front: 3 positions, root mean square error 1.000 m',
        'side: 2 positions, root mean square error 2.000 m',
        'fused: 3 positions, root mean square error 0.500 m',
        'data: 2 over front, 1 over side; 1 handover']


def test_without_a_cycle_the_error_shows_the_warnings_of_all_nodes(monkeypatch):
    logs = {'bs': '[INFO] [bs]: waiting for positioner', 'channel': '[INFO] [channel]: serving',
            'positioner': '[INFO] [positioner]: begun\n[WARN] [positioner]: no estimator'}
    processes = types.SimpleNamespace(names=tuple(logs), ended=dict, log=logs.get)
    monkeypatch.setattr(demo, '_CYCLE_TIMEOUT_S', 0.0)
    monkeypatch.setattr(demo, 'EventsExecutor', mock.MagicMock())
    monkeypatch.setattr(demo, '_table_progress', lambda _: {})
    error = demo.watch(types.SimpleNamespace(complete=[]), processes, 1, lambda *_: None)
    assert error.splitlines()[1:] == [logs['bs'], '[WARN] [positioner]: no estimator']


def test_the_wait_continues_while_a_node_computes_a_table(monkeypatch, capsys):
    """The table of 64 by 64 elements takes longer than the time between two cycles may be."""
    clock = types.SimpleNamespace(now_s=0.0, monotonic=lambda: clock.now_s)
    progress, executor = {}, mock.MagicMock()

    def spin_once(timeout_sec):
        clock.now_s += 40.0
        if clock.now_s <= 400.0:
            progress['positioner'] = f'{clock.now_s / 4:.0f} %'
    executor().__enter__().spin_once = spin_once
    for name, replacement in (('time', clock), ('EventsExecutor', executor),
                              ('_table_progress', lambda _: progress)):
        monkeypatch.setattr(demo, name, replacement)
    processes = types.SimpleNamespace(names=('bs',), ended=dict, log=lambda _: '')
    assert 'no cycle within 60 s' in demo.watch(
        types.SimpleNamespace(complete=[]), processes, 1, lambda *_: None)
    assert clock.now_s == 480.0
    assert capsys.readouterr().err == 'positioner computes a table of templates\n'


def test_the_progress_of_tables_is_that_of_all_surfaces(bench):
    node = bench.add(Node, 'observer')
    progress = demo._table_progress(node)
    publish = []
    for space, share in (('front', '40 %'), ('side', '5 %')):
        report = Report(False, '', {TABLE_PROGRESS: share})
        publish.append(make_reporter(
            bench.add(Node, 'positioner', namespace=space), lambda report=report: report))
    bench.until(lambda: [one() for one in publish] and progress == {
        'front/positioner': '40 %', 'side/positioner': '5 %'}, 'both')
