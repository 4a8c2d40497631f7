"""The demonstration: its command line, the nodes that it starts, and its report."""

import signal
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Site
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.recording import read_networks
from rhs_isac_ros.ros.roster import FOLLOWING, ROSTER
from rhs_isac_ros.tools import demo
from rhs_isac_ros.tools.demo import SiteObserver, main, site_lines, start_network

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
    assert main(['--record', 'run.mcap', *arguments]) == 0
    assert [file.name for file in tmp_path.iterdir()] == ['run.mcap']
    assert [*read_networks('run.mcap').surfaces] == surfaces


class Started(dict):
    """The parameters of processes, by namespace and name."""

    def start(self, executable, name='', namespace='', **parameters):
        self[namespace, name or executable] = parameters


def test_each_node_has_the_given_parameters_that_it_knows():
    nodes = Started()
    start_network(nodes, 2, Scenario(), seed=3, rest_s=None, prior='track')
    assert {name for _, name in nodes} == {*ROSTER, 'user_1', 'user_2'} - {'user'}
    assert nodes['', 'positioner'] == {'prior': 'track'}
    assert nodes['', 'bs'] == {'seed': 3}
    assert nodes['', 'user_2'] == {
        'user_id': 2, 'user_count': 1, 'mobility': 'random_walk', 'seed': 3,
        'speed_mps': Scenario().max_user_speed_mps}


def test_a_site_has_users_at_the_first_surface_and_one_fusion():
    nodes = Started()
    start_network(
        nodes, 30, Scenario(), together=True, surfaces=['front', 'side'], site_file='x.yaml')
    assert {name for space, name in nodes if space == 'front'} == {*ROSTER, 'users'} - {'user'}
    assert {name for space, name in nodes if space == 'side'} == {*FOLLOWING}
    assert [name for space, name in nodes if not space] == ['fusion']
    assert nodes['front', 'users']['user_count'] == 30
    assert {values['site_file'] for values in nodes.values()} == {'x.yaml'}


def test_the_report_of_a_site_has_the_errors_of_each_surface_and_the_handovers(bench):
    site = Site.from_yaml(SITE)
    observer = bench.add(SiteObserver, site)
    for cycle_id in (1, 2, 3, 4):
        about = {'cycle_id': cycle_id, 'user': 1 + cycle_id % 2}
        estimates = [
            m.PositionEstimate(
                **about, codebook_id='cb', position=np.array([9.0, error_m, 0.0]),
                covariance_m2=np.eye(3), crlb_m2=0.04, estimator='bayes', latency_s=0.01)
            for error_m in (1.0, 2.0, 0.5)]
        for message in (
                m.Beacon(cycle_id=cycle_id, attempt=0),
                m.GroundTruth(**about, position=np.array([9.0, 0, 0]), velocity=np.zeros(3)),
                m.ReceivedSignals(**about, codebook_id='cb', signals=np.zeros((2, 8, 4), complex)),
                estimates[0],
                m.Capacity(**about, codebook_id='cb', band=0, expected_bps=1e6,
                           at_estimate_bps=1e6, actual_bps=1e6, perfect_bps=1e6, loss_bps=0.0,
                           loss_percent=0.0),
                m.ProtocolState(**about, phase=m.Phase.BEACONING, outcome='served',
                                began_s=np.zeros(4), elapsed_s=0.0)):
            observer.observe(message, 0.0)
        # The side has no position in the first cycle, which is not reported, and in the third.
        for name, estimate in zip(('front', 'side', 'fused'), estimates, strict=True):
            if name != 'side' or cycle_id in (2, 4):
                observer._keep(name, estimate)
        observer._keep('side' if cycle_id == 4 else 'front', m.Data(
            **about, direction=m.Direction.UPLINK, stage=m.Stage.DELIVERED,
            duration_s=0.1, bits=1.0))
    table, *lines = site_lines(observer)
    assert [row.split() for row in table.splitlines()[2:]] == [
        [cycle, user, '9.00', '0.00', '0.00', '1.000', side, '0.500', carrier]
        for cycle, user, side, carrier in (
            ('2', '1', '2.000', 'front'), ('3', '2', 'nan', 'front'), ('4', '1', '2.000', 'side'))]
    assert lines == [
        'front: 3 positions, root mean square error 1.000 m',
        'side: 2 positions, root mean square error 2.000 m',
        'fused: 3 positions, root mean square error 0.500 m',
        'data: 2 over front, 1 over side; 1 handover']
